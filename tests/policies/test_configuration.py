"""Configurations: sections that are merged, overridden, read from YAML and checked, and what a method makes of them."""

import copy
from dataclasses import dataclass
from typing import Literal

import pytest
from policy_specs import CHUNK, make_spec

from manicm_ms.errors import ConfigError, UnknownNameError
from manicm_ms.policies.configuration import (
    at,
    lookup,
    lookup_or_none,
    merged,
    parse_overrides,
    read_yaml,
    section,
    typed,
)
from manicm_ms.policies.methods import METHODS, Method, make_policy
from manicm_ms.spec import ChunkSpec
from manicm_ms.training.presets import TEACHER_PRESETS

BASE = {
    "head": {"name": "diffusion", "num_inference_steps": 10, "clip_range": 1.0},
    "backbone": {"name": "unet1d", "down_dims": [64, 128]},
}


@dataclass(frozen=True)
class Kettle:
    """A part of an imaginary policy."""

    litres: float
    name_of_maker: str = "copper"
    cups: int = 4
    whistles: bool = False
    sizes: tuple[int, ...] = (1, 2)
    shares: tuple[float, ...] = (0.5,)
    limit: int | None = None

    def __post_init__(self):
        if self.cups < 1:
            raise ConfigError(f"cups must be at least 1, got {self.cups}")


# ---- merging --------------------------------------------------------------------------------------------------------


def test_sections_are_merged_key_by_key_and_both_stay_as_they_are():
    base, changes = copy.deepcopy(BASE), {"head": {"clip_range": 2.0}, "encoder": {"name": "dp3"}}
    result = merged(base, changes)
    assert result == {
        "head": {"name": "diffusion", "num_inference_steps": 10, "clip_range": 2.0},
        "backbone": BASE["backbone"],
        "encoder": {"name": "dp3"},
    }
    result["backbone"]["down_dims"].append(256)
    result["encoder"]["name"] = "other"
    assert base == BASE
    assert changes == {"head": {"clip_range": 2.0}, "encoder": {"name": "dp3"}}


def test_a_section_that_names_another_part_begins_anew():
    assert merged(BASE, {"head": {"name": "flow", "steps": 3}})["head"] == {"name": "flow", "steps": 3}
    assert merged(BASE, {"head": {"name": "flow"}})["head"] == {"name": "flow"}


def test_a_section_that_names_the_same_part_goes_on():
    changed = merged(BASE, {"head": {"name": "diffusion", "clip_range": 2.0}})["head"]
    assert changed == {"name": "diffusion", "num_inference_steps": 10, "clip_range": 2.0}


def test_a_text_in_place_of_a_section_is_the_name_of_its_part():
    assert merged(BASE, {"head": "flow"})["head"] == {"name": "flow"}
    assert merged(BASE, {"head": "diffusion"})["head"] == BASE["head"]
    assert merged({"frame": "base"}, {"frame": "tcp"}) == {"frame": "tcp"}


def test_a_value_takes_the_place_of_a_section_and_a_section_that_of_a_value():
    assert merged(BASE, {"backbone": None})["backbone"] is None
    assert merged({"backbone": None}, {"backbone": {"name": "unet1d"}}) == {"backbone": {"name": "unet1d"}}


def test_what_stands_at_a_path_is_found_or_not():
    assert lookup(BASE, "head.clip_range") == 1.0
    assert at("head.clip_range", 1.0) == {"head": {"clip_range": 1.0}}
    assert lookup_or_none(BASE, "head.clip_range") == 1.0
    for path in ("head.sigma", "tail.sigma", "head.clip_range.low"):
        assert lookup_or_none(BASE, path) is None
        with pytest.raises(KeyError):
            lookup(BASE, path)


# ---- overrides ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("head.x=4", 4),
        ("head.x=0.1", 0.1),
        ("head.x=-2", -2),
        ("head.x=1.0e-3", 1e-3),
        ("head.x=true", True),
        ("head.x=null", None),
        ("head.x=", None),
        ("head.x=tcp", "tcp"),
        ("head.x = tcp ", "tcp"),
        ("head.x='4'", "4"),
        ("head.x=a=b", "a=b"),
        ("head.x=64,128", [64, 128]),
        ("head.x=64, 128,", [64, 128]),
        ("head.x=64,", [64]),
        ("head.x=a,0.5,null", ["a", 0.5, None]),
    ],
)
def test_an_override_says_a_scalar_or_several(word, value):
    assert parse_overrides([word]) == {"head": {"x": value}}


def test_later_overrides_win_and_different_ones_add_up():
    words = ["head.a=1", "head.b=2", "head.a=3", "backbone.down_dims=8,16", "seed=5"]
    assert parse_overrides(words) == {"head": {"a": 3, "b": 2}, "backbone": {"down_dims": [8, 16]}, "seed": 5}
    assert parse_overrides([]) == {}
    assert parse_overrides(["head.a=1", "head=flow", "head.b=2"]) == {"head": {"a": 1, "name": "flow", "b": 2}}
    assert parse_overrides(["head=ddpm", "head.a=1", "head=flow"]) == {"head": {"name": "flow"}}


@pytest.mark.parametrize("word", ["head.x", "=4", "head.=4", ".x=4", "head..x=4", "", " =4"])
def test_what_is_no_key_and_value_is_refused_with_an_example(word):
    with pytest.raises(ConfigError, match=r"KEY=VALUE, as in head\.num_inference_steps=4; got ") as refused:
        parse_overrides([word])
    assert repr(word) in str(refused.value)


@pytest.mark.parametrize(
    "value", ["[4]", "{a: 1}", "[", "!!python/name:os.system x", "&a 4", "*a", "a: b", "{", "1, [2", "[" * 5000]
)
def test_a_value_that_is_no_scalar_is_refused(value):
    with pytest.raises(ConfigError, match=r"the value of 'head\.x=") as refused:
        parse_overrides([f"head.x={value}"])
    assert "\n" not in str(refused.value)


# ---- files ----------------------------------------------------------------------------------------------------------


def written(tmp_path, text):
    path = tmp_path / "config.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def test_a_file_holds_sections(tmp_path):
    text = "head: {num_inference_steps: 4}\nbackbone:\n  down_dims: [64, 128]\n  # a remark\n  name: unet1d\n"
    assert read_yaml(written(tmp_path, text)) == {
        "head": {"num_inference_steps": 4},
        "backbone": {"down_dims": [64, 128], "name": "unet1d"},
    }


BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join([f'*{former}'] * 9)}]\n"
    for former, name in zip("abcdefghi", "bcdefghij", strict=True)
)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "head:\n  clip: !!python/object/apply:os.system ['true']\n",
            "line 2 has the tag .*os.system: write plain values",
        ),
        ("head: !!str 4\n", "line 1 has the tag"),
        ("a: 1\nb: &x 2\n", "line 2 has an anchor or an alias: write the values out"),
        ("a: *x\n", "line 1 has an anchor or an alias"),
        (BOMB, "line 1 has an anchor"),
        ("- 1\n- 2\n", "has no sections: write"),
        ("4\n", "has no sections"),
        ("", "has no sections"),
        ("4: {a: 1}\n", "has the key 4: keys are words"),
        ("a: [1, 2\n", "is not valid YAML .*: correct it"),
        ("a: 1\n b: 2\n", "is not valid YAML"),
        ("a: 1\x00\n", "is not valid YAML"),
        ("a: 1\n---\nb: 2\n", "is not valid YAML"),
        (b"\xff\xfe\x00a", "cannot be read .*: name a YAML file"),
        ("a: " + "[" * 5000, "nested too deeply"),
    ],
)
def test_a_file_that_cannot_be_is_refused_in_one_line_that_names_it(tmp_path, text, message):
    path = written(tmp_path, text)
    with pytest.raises(ConfigError, match=message) as refused:
        read_yaml(path)
    assert str(refused.value).startswith(str(path))
    assert "\n" not in str(refused.value)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"there is no configuration file .*nowhere\.yaml: check the path"):
        read_yaml(tmp_path / "nowhere.yaml")
    with pytest.raises(ConfigError, match=r"cannot be read .*: name a YAML file"):
        read_yaml(tmp_path)


# ---- fields ---------------------------------------------------------------------------------------------------------


def test_a_section_becomes_a_dataclass_and_what_it_lacks_takes_its_default():
    kettle = section(Kettle, {"litres": 2, "sizes": [3, 4, 5], "limit": 7, "whistles": True}, "kettle")
    assert kettle == Kettle(2.0, sizes=(3, 4, 5), limit=7, whistles=True)
    assert isinstance(kettle.litres, float)
    assert isinstance(kettle.sizes, tuple)
    assert section(Kettle, {"litres": 1.5, "limit": None, "shares": [1, 0.5]}, "kettle") == Kettle(
        1.5, shares=(1.0, 0.5)
    )


@pytest.mark.parametrize(("key", "nearest"), [("cup", "kettle.cups"), ("sises", "kettle.sizes")])
def test_an_unknown_field_is_answered_with_the_nearest(key, nearest):
    with pytest.raises(UnknownNameError, match=rf"unknown configuration key 'kettle\.{key}': did you mean '{nearest}'"):
        section(Kettle, {"litres": 1.0, key: 3}, "kettle")


def test_a_field_without_a_default_is_needed_and_the_dataclass_may_refuse_a_value():
    with pytest.raises(ConfigError, match=r"^kettle lacks litres$"):
        section(Kettle, {"cups": 3}, "kettle")
    with pytest.raises(ConfigError, match="cups must be at least 1, got 0"):
        section(Kettle, {"litres": 1.0, "cups": 0}, "kettle")


@pytest.mark.parametrize(
    ("key", "value", "wanted"),
    [
        ("cups", True, "a whole number"),
        ("cups", 2.0, "a whole number"),
        ("cups", "2", "a whole number"),
        ("cups", None, "a whole number"),
        ("cups", [2], "a whole number"),
        ("litres", "much", "a finite number"),
        ("litres", False, "a finite number"),
        ("litres", None, "a finite number"),
        ("name_of_maker", 3, "a word"),
        ("whistles", 1, "true or false"),
        ("sizes", [1, "x"], "several values, each a whole number"),
        ("sizes", [1, True], "several values, each a whole number"),
        ("sizes", "x", "several values, each a whole number"),
        ("sizes", None, "several values, each a whole number"),
        ("sizes", {"a": 1}, "several values, each a whole number"),
        ("limit", "all", "a whole number or null"),
        ("limit", {"a": 1}, "a whole number or null"),
    ],
)
def test_a_value_of_another_type_is_refused_with_its_path(key, value, wanted):
    with pytest.raises(ConfigError) as refused:
        section(Kettle, {"litres": 1.0, key: value}, "kettle")
    assert str(refused.value) == f"kettle.{key} takes {wanted}, got {value!r}"


@pytest.mark.parametrize(
    ("value", "hint", "expected"),
    [
        (3, float, 3.0),
        (3, int, 3),
        ([3, 4], tuple[int, ...], (3, 4)),
        ((3, 4), tuple[float, ...], (3.0, 4.0)),
        (3, tuple[int, ...], (3,)),
        ([], tuple[int, ...], ()),
        (None, int | None, None),
        (0, int | None, 0),
        (False, bool, False),
        ("", str, ""),
        (None, tuple[int, ...] | None, None),
        ([1], tuple[int, ...] | None, (1,)),
    ],
)
def test_a_value_is_given_as_its_annotation_has_it(value, hint, expected):
    got = typed(value, hint, "x")
    assert got == expected
    assert type(got) is type(expected)


# ---- methods --------------------------------------------------------------------------------------------------------


def test_a_size_is_what_each_part_says_of_it():
    row = METHODS.get("simple_dp3")
    published, quick, smoke = (row.configuration(size) for size in ("paper", "quick", "smoke"))
    assert published["backbone"]["down_dims"] == (128, 256, 384)
    assert quick["backbone"] == {"name": "unet1d", "down_dims": (64, 128, 256), "resnets_per_stage": 1, "mid_blocks": 1}
    assert smoke["backbone"]["down_dims"] == (32, 64)
    assert published["inputs"] == {"cloud_crop": {}, "points": {}, "cloud_frame": {}}
    assert quick["inputs"] == {"cloud_crop": {}, "points": {"max_points": 128}, "cloud_frame": {"frame": "auto"}}
    assert smoke["inputs"]["points"] == {"max_points": 64}
    assert [c["normalizer"] for c in (published, quick)] == [{}, {"min_state_range": 0.02}]
    assert quick["head"] == {"name": "diffusion"}
    assert METHODS.get("dp3").configuration("quick")["backbone"] == {"name": "unet1d", "down_dims": (64, 128, 256)}


def test_changes_go_over_the_size_and_the_row_stays_as_it_is():
    row = METHODS.get("simple_dp3")
    before = copy.deepcopy((row.backbone, row.inputs))
    changes = {
        "backbone": {"down_dims": (16, 32)},
        "inputs": {"points": {"acting": "random"}},
        "head": {"prediction_type": "epsilon"},
        "normalizer": {"min_state_range": 0.5},
    }
    config = row.configuration("quick", changes)
    assert config["backbone"] == {"name": "unet1d", "down_dims": (16, 32), "resnets_per_stage": 1, "mid_blocks": 1}
    assert config["inputs"] == {
        "cloud_crop": {},
        "points": {"max_points": 128, "acting": "random"},
        "cloud_frame": {"frame": "auto"},
    }
    assert config["head"] == {"name": "diffusion", "prediction_type": "epsilon"}
    assert config["normalizer"] == {"min_state_range": 0.5}
    assert (row.backbone, row.inputs) == before


def test_another_part_than_the_rows_takes_its_own_size_and_none_of_the_rows_fields():
    row = Method(
        sentence="", reference="", encoder="dp3", backbone={"name": "some_mixer", "depth": 3}, head="diffusion",
        objective="averaged", nfe=10, chunk=ChunkSpec(2, 4, 3),
    )  # fmt: skip
    for named in ("unet1d", {"name": "unet1d"}):
        assert row.configuration("quick", {"backbone": named})["backbone"] == {
            "name": "unet1d",
            "down_dims": (64, 128, 256),
        }
    changed = row.configuration("smoke", {"backbone": {"name": "unet1d", "mid_blocks": 1}})["backbone"]
    assert changed == {"name": "unet1d", "down_dims": (32, 64), "mid_blocks": 1}
    again = METHODS.get("simple_dp3").configuration("quick", {"backbone": "unet1d"})["backbone"]
    assert again == METHODS.get("simple_dp3").configuration("quick")["backbone"], "named as it was, nothing changes"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"backbone": {"name": "unet2d"}}, "unknown backbone 'unet2d': did you mean 'unet1d'"),
        ({"encoder": "dp4"}, "unknown encoder 'dp4': did you mean 'dp3'"),
        ({"head": "difusion"}, "unknown head 'difusion': did you mean 'diffusion'"),
        ({"inputs": {"point": {}}}, "unknown input transform 'point': did you mean 'points'"),
    ],
)
def test_a_part_that_does_not_exist_is_answered_with_the_nearest(changes, message):
    with pytest.raises(UnknownNameError, match=message):
        METHODS.get("simple_dp3").configuration("paper", changes)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("inputs.points=random", "inputs.points takes keys of its own, got 'random'"),
        ("inputs.points=3", "inputs.points takes keys of its own, got 3"),
        ("inputs=3", "inputs takes the fields of each transform"),
        ("normalizer=3", "normalizer takes keys of its own, got 3"),
        ("normalizer=minmax", "normalizer"),
        ("encoder=3", "encoder takes keys of its own, got 3"),
        ("head.name=3", "head.name takes a word, got 3"),
        ("head.name=flow,diffusion", "head.name takes a word"),
        ("head.name=null", "head.name takes a word, got None"),
        ("backbone=null", "the head 'diffusion' needs a backbone: name one of "),
        ("head=null", "head has no name; name one of "),
    ],
)
def test_a_section_that_is_no_section_is_refused_with_its_path(override, message):
    with pytest.raises((ConfigError, UnknownNameError), match=message):
        make_policy("simple_dp3", make_spec(), CHUNK, parse_overrides([override]), size="smoke")


def test_lengths_are_those_of_the_size_with_changes_in_place():
    row = METHODS.get("dp3")
    assert row.chunk_of("paper") == ChunkSpec(2, 4, 2)
    assert row.chunk_of("quick") == row.chunk_of("smoke") == ChunkSpec(2, 4, 3)
    assert row.chunk_of("quick", {"horizon": 8, "n_action_steps": 7}) == ChunkSpec(2, 8, 7)
    with pytest.raises(UnknownNameError, match=r"did you mean 'chunk\.horizon'"):
        row.chunk_of("quick", {"horizn": 8})
    with pytest.raises(ConfigError, match=r"chunk\.horizon takes a whole number, got 4\.0"):
        row.chunk_of("quick", {"horizon": 4.0})


@pytest.mark.parametrize(("text", "value"), [("1e-3", 1e-3), ("-2E5", -2e5), ("1.5e2", 150.0), ("e3", "e3")])
def test_a_number_with_an_exponent_is_a_number(text, value, tmp_path):
    assert parse_overrides([f"training.learning_rate={text}"]) == {"training": {"learning_rate": value}}
    (tmp_path / "a.yaml").write_text(f"training: {{learning_rate: {text}}}\n")
    assert read_yaml(tmp_path / "a.yaml") == {"training": {"learning_rate": value}}


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("backbone.n_groups=0", "n_groups must be at least 1"),
        ("backbone.n_groups=-8", "n_groups must be at least 1"),
        ("backbone.down_dims=0", "down_dims must be at least 1"),
        ("backbone.down_dims=-8,16", "down_dims must be at least 1"),
        ("backbone.kernel_size=-1", "kernel_size must be at least 1"),
        ("head.beta_schedule=nope", "diffusers has no beta_schedule 'nope'"),
        ("head.clip_range=-1", "clip_range must be above 0"),
        ("encoder.point_features=0", "point_features must be at least 1"),
    ],
)
def test_values_out_of_range_are_refused_before_anything_is_built(override, message):
    with pytest.raises(ConfigError, match=message):
        METHODS.get("simple_dp3").configuration("smoke", parse_overrides([override]))


def test_a_part_that_is_named_keeps_the_fields_that_are_given_before_and_after():
    wide = {"name": "mixer", "width": 64}
    for words in (["backbone=mixer", "backbone.width=64"], ["backbone.width=64", "backbone=mixer"]):
        assert parse_overrides(words) == {"backbone": wide}
        config = METHODS.get("simple_dp3").configuration("smoke", parse_overrides(words))
        assert config["backbone"] == {**wide, "blocks": 2}
    in_file = merged({"backbone": "mixer"}, {"backbone": {"width": 64}})
    assert in_file == {"backbone": wide}
    assert merged(in_file, {"backbone": "unet1d"}) == {"backbone": {"name": "unet1d"}}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"betas": 0.9}, "training.betas takes 2 values, each a finite number, got 0.9"),
        ({"betas": [0.9, 0.99, 0.999]}, "training.betas takes 2 values"),
        ({"learning_rate": float("nan")}, "training.learning_rate takes a finite number"),
        ({"clip_norm": float("inf")}, "training.clip_norm takes a finite number or null"),
    ],
)
def test_numbers_that_are_none_and_wrong_counts_are_refused(values, message):
    with pytest.raises(ConfigError, match=message):
        TEACHER_PRESETS.get("quick").with_changes({"training": values})


def test_steps_and_epochs_replace_one_another():
    passes = TEACHER_PRESETS.get("quick").with_changes({"training": {"epochs": 5}})
    assert (passes.steps, passes.epochs) == (None, 5)
    assert TEACHER_PRESETS.get("paper").with_changes({"training": {"steps": 5000}}).epochs is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("head: {nfe: 1}\nhead: {nfe: 2}\n", "begins in line 1 has the key 'head' twice"),
        ("inputs: {1: {}}\n", "has the key 1: keys are words"),
        ("3: {}\n", "has the key 3: keys are words"),
    ],
)
def test_keys_that_are_no_words_or_stand_twice_are_refused(text, message, tmp_path):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_yaml(tmp_path / "a.yaml")


@pytest.mark.parametrize(
    ("hint", "value", "wanted"),
    [
        (Literal["a", "b"], "a", "a"),
        (list[int], [3], [3]),
        (list[int], 3, [3]),
        (tuple[float, float], [1, 2.5], (1.0, 2.5)),
    ],
)
def test_annotations_of_a_users_part(hint, value, wanted):
    assert typed(value, hint, "head.x") == wanted


def test_a_literal_names_what_it_takes():
    with pytest.raises(ConfigError, match=r"head\.x takes one of a, b, got 'c'"):
        typed("c", Literal["a", "b"], "head.x")


@pytest.mark.parametrize(
    ("method", "changes", "message"),
    [
        ("simple_dp3", {"head": "gmm"}, "the head 'gmm' runs no backbone: set backbone=null"),
        ("bc_gmm_3d", {"backbone": {"down_dims": [32, 64]}}, "there is none that down_dims could be of"),
        ("simple_dp3", {"inputs": "points"}, "inputs takes the fields of each transform"),
        ("pocket_dp3", {"backbone": {"width": 33}}, "width must be even"),
        ("simple_dp3", {"hed": {}}, "did you mean 'head'"),
    ],
)
def test_messages_say_what_to_do(method, changes, message):
    with pytest.raises((ConfigError, UnknownNameError), match=message):
        METHODS.get(method).configuration("smoke", changes)


def test_sizes_that_no_machine_holds_are_one_line():
    huge = {"backbone": {"down_dims": [8_000_000_000, 8_000_000_000]}}
    with pytest.raises(ConfigError, match="simple_dp3 cannot be built with these sizes"):
        make_policy("simple_dp3", make_spec(), config=huge)


@pytest.mark.parametrize(
    "wrong", [{"head": {"widths": 3}}, {"inputs": {"points": 3}}, {"chunk": (1, 1, 1)}, {"head": None}]
)
def test_a_row_of_another_form_is_refused_where_it_is_written(wrong):
    row = {"sentence": "", "reference": "", "encoder": "dp3", "head": "gmm", "objective": "plain", "nfe": 1}
    with pytest.raises(ConfigError, match="of a method is"):
        Method(**{**row, "chunk": ChunkSpec(1, 1, 1), **wrong})


@pytest.mark.parametrize("method", METHODS.names())
def test_a_row_says_how_often_its_network_is_evaluated(method):
    row = METHODS.get(method)
    assert make_policy(method, make_spec(), size="smoke", seed=0).nfe == row.nfe
