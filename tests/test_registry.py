"""Names are found, near misses suggested, duplicates refused."""

import sys
import warnings
from types import ModuleType

import pytest

from manicm_ms import registry as registry_module
from manicm_ms.errors import DuplicateNameError, TaskWarning, UnknownNameError
from manicm_ms.registry import Registry


@pytest.fixture
def fruits():
    registry: Registry[int] = Registry("fruit")
    registry.add("apple", 1, tags=("red",))
    registry.add("pear", 2, tags=("green",))
    return registry


def test_get_and_tags(fruits):
    assert fruits.get("pear") == 2
    assert fruits.names() == ("apple", "pear")
    assert fruits.names(tag="green") == ("pear",)


def test_an_entry_knows_its_name(fruits):
    apple, pear = object(), object()
    objects = Registry("object")
    objects.add("apple", apple)
    assert objects.name_of(apple) == "apple"
    assert objects.name_of(pear) is None
    assert fruits.name_of(2) == "pear"


def test_near_miss_is_suggested(fruits):
    with pytest.raises(UnknownNameError, match=r"unknown fruit 'aple': did you mean 'apple'\? known: apple, pear"):
        fruits.get("aple")


def test_duplicates_are_refused(fruits):
    with pytest.raises(DuplicateNameError):
        fruits.add("apple", 3)
    assert fruits.get("apple") == 1


# ---- files of the user's own ----------------------------------------------------------------------------------------

GOOD = "from fruit_registry import FRUITS\nFRUITS.add({name!r}, 1)\n"
BROKEN = {
    "syntax": ("x = 1\ndef (:\n", 2, "SyntaxError: invalid syntax"),
    "missing": (
        GOOD.format(name="half") + "\nimport no_such_module\n",
        4,
        "ModuleNotFoundError: No module named 'no_s",
    ),
    "raises": ("def f():\n    return {}['key']\nf()\n", 2, "KeyError: 'key'"),
    "leaves": ("import sys\nsys.exit(3)\n", 2, "SystemExit: 3"),
    "taken": (GOOD.format(name="shipped"), 2, "DuplicateNameError: fruit 'shipped' is registered twice"),
}


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package with one module of its own, and a folder of the user's beside it; returns registry and that folder."""
    own, users = tmp_path / "fruits_of_a_test", tmp_path / "users"
    own.mkdir()
    users.mkdir()
    (own / "__init__.py").write_text(f"__path__.append({str(users)!r})\n")
    (own / "shipped.py").write_text(GOOD.format(name="shipped"))
    monkeypatch.syspath_prepend(str(tmp_path))
    holder = ModuleType("fruit_registry")
    holder.FRUITS = Registry("fruit", package=own.name)
    monkeypatch.setitem(sys.modules, holder.__name__, holder)
    yield holder.FRUITS, users, own
    for name in [name for name in sys.modules if name.startswith(own.name)]:
        del sys.modules[name]
    registry_module._left_out.clear()


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_file_is_named_with_its_line_and_the_others_go_on(package, kind):
    fruits, users, own = package
    text, line, what = BROKEN[kind]
    (users / f"{kind}.py").write_text(text)
    (users / "zest.py").write_text(GOOD.format(name="zest"))
    with pytest.warns(TaskWarning) as told:
        assert fruits.names() == ("shipped", "zest"), "and nothing of what the broken file had entered"
    (warning,) = told
    assert str(warning.message).startswith(f"{users / kind}.py, line {line}: {what}")
    assert str(warning.message).endswith("; what it registers is left out")
    assert "\n" not in str(warning.message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # said once, though experts are discovered after environments
        assert Registry("skin", package=own.name).names() == ()


def test_a_broken_file_of_the_package_itself_is_a_defect(package):
    fruits, _, own = package
    (own / "shipped.py").write_text("import no_such_module\n")
    with pytest.raises(ModuleNotFoundError):
        fruits.names()


def test_modules_of_installed_packages_are_found_by_their_entry_points(package, tmp_path):
    _, _, own = package
    (tmp_path / "their_fruits.py").write_text(GOOD.format(name="theirs"))
    (tmp_path / "their_broken_fruits.py").write_text("import no_such_module\n")
    info = tmp_path / "their_fruits-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: their-fruits\nVersion: 1.0\n")
    points = ("[fruits.of_a_test]", "good = their_fruits", "bad = their_broken_fruits", "gone = no_such_fruits.module")
    (info / "entry_points.txt").write_text("\n".join(points))
    fruits = Registry("fruit", package=own.name, group="fruits.of_a_test")
    sys.modules["fruit_registry"].FRUITS = fruits
    with pytest.warns(TaskWarning) as told:
        assert fruits.names() == ("shipped", "theirs")
    lines = sorted(str(warning.message) for warning in told)
    assert lines[0].startswith(f"{tmp_path / 'their_broken_fruits.py'}, line 1: ModuleNotFoundError")
    assert lines[1].startswith("no_such_fruits.module, line 1: ModuleNotFoundError")
    for name in ("their_fruits", "their_broken_fruits"):
        sys.modules.pop(name, None)


@pytest.fixture
def outside(package, tmp_path, monkeypatch):
    """A registry whose own entries lie in one package, and a user's beside the modules of another."""
    _, users, own = package
    parts = tmp_path / "parts_of_a_test"
    parts.mkdir()
    (parts / "__init__.py").touch()
    (parts / "core.py").write_text(GOOD.format(name="core"))
    (own / "shipped.py").write_text("raise AssertionError('a module of that package itself is none of ours')\n")
    registry = Registry("fruit", package=parts.name, outside=own.name)
    sys.modules["fruit_registry"].FRUITS = registry
    yield registry, users, own
    for name in [name for name in sys.modules if name.startswith(parts.name)]:
        del sys.modules[name]


def test_a_users_module_is_imported_only_where_a_name_is_not_ours(outside):
    fruits, users, own = outside
    (users / "zest.py").write_text(GOOD.format(name="zest"))
    assert fruits.get("core") == 1
    assert f"{own.name}.zest" not in sys.modules
    assert fruits.get("zest") == 1
    assert fruits.names() == ("core", "zest")


def test_the_names_of_a_registry_are_those_of_the_users_modules_too(outside):
    fruits, users, _ = outside
    (users / "zest.py").write_text(GOOD.format(name="zest"))
    assert fruits.names() == ("core", "zest")
    with pytest.raises(UnknownNameError, match="did you mean 'zest'"):
        fruits.get("zests")


def test_a_users_broken_module_costs_what_is_ours_nothing(outside):
    fruits, users, _ = outside
    (users / "broken.py").write_text("import no_such_module\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert fruits.get("core") == 1
    with pytest.warns(TaskWarning, match=r"broken\.py, line 1: .*; what it registers is left out$") as told:
        assert fruits.names() == ("core",)
    assert len(told) == 1
