"""Register once, discover everywhere: named entries with tags, duplicates refused, near misses suggested."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import os
import pkgutil
import sys
import traceback
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

from manicm_ms.errors import ConfigError, DuplicateNameError, TaskWarning, UnknownNameError

T = TypeVar("T")

TASKS = "manicm_ms.tasks"
"""The package of tasks, which users add theirs to. It is named here alone and imported at the first look-up: tasks
import the registries in which they enter themselves, and what holds a registry imports no task."""

_entered: list[tuple[Registry[Any], str, str]] = []
"""Registry, name and module of every entry: what a module had entered before it failed is taken out again."""
_importing: list[str] = []
"""Modules that are not ours and are being imported just now, the innermost last."""
_left_out: set[str] = set()
"""Modules that cannot be imported: several registries discover the same package, but one warning is enough."""


class Registry(Generic[T]):
    """Maps names to entries of one kind (environments, policies, presets, ...).

    Args:
        kind: what an entry is called in an error message, for example "env id".
        package: dotted name of a package whose modules are imported once, before the first look-up,
            so that their decorators run; None where all entries are registered by their importer.
        group: entry-point group of installed packages whose modules are imported then too; None for no such group.
        outside: package of which a user's own modules are imported too, where `package` holds no such name; None where
            users cannot add to it.
    """

    def __init__(
        self, kind: str, package: str | None = None, group: str | None = None, outside: str | None = None
    ) -> None:
        self.kind = kind
        self._package, self._group, self._outside = package, group, outside
        self._entries: dict[str, T] = {}
        self._tags: dict[str, frozenset[str]] = {}
        self._former: dict[str, str] = {}

    def add(self, name: str, entry: T, tags: Iterable[str] = (), former: Iterable[str] = ()) -> T:
        """Enter `entry` under `name`; raise DuplicateNameError where the name is taken.

        Args:
            name: what it is looked up by.
            entry: what is registered.
            tags: groups that it belongs to.
            former: names that it has, or had, elsewhere; asking for one of them is answered by `name`.
        """
        module = _registering_module()
        if module in _importing:
            self._discover_own()  # else a name of ours would be free, and our own module would be refused later
        if name in self._entries:
            raise DuplicateNameError(self.kind, name)
        self._entries[name] = entry
        self._tags[name] = frozenset(tags)
        self._former.update(dict.fromkeys(former, name))
        _entered.append((self, name, module))
        return entry

    def _remove(self, name: str) -> None:
        del self._entries[name], self._tags[name]
        self._former = {former: present for former, present in self._former.items() if present != name}

    def register(self, name: str, tags: Iterable[str] = ()) -> Callable[[Any], Any]:
        """Return a decorator that enters what it decorates under `name`."""

        def decorate(entry: Any) -> Any:
            return self.add(name, entry, tags)

        return decorate

    def get(self, name: str) -> T:
        """Return the entry called `name`; raise UnknownNameError with the nearest known name."""
        self._discover()
        if name not in self._entries:
            self._discover_outside()
        return self.get_registered(name)

    def get_registered(self, name: str) -> T:
        """Return the entry called `name` among those registered so far, without importing anything else."""
        if name not in self._entries:
            raise UnknownNameError(self.kind, name, self._entries, self._former.get(name))
        return self._entries[name]

    def names(self, tag: str | None = None) -> tuple[str, ...]:
        """Return the known names in order of registration, only those carrying `tag` if it is given."""
        self._discover()
        self._discover_outside()
        return tuple(n for n in self._entries if tag is None or tag in self._tags[n])

    def tags(self, name: str) -> frozenset[str]:
        """Return the tags of the entry called `name`."""
        self.get(name)
        return self._tags[name]

    def name_of(self, entry: T) -> str | None:
        """Return the name that an entry of this registry has, or None where it has none."""
        return next((name for name, known in self._entries.items() if known is entry), None)

    def _discover(self) -> None:
        package = self._package
        self._discover_own()
        if package is not None:
            for name, ours in _modules(package):
                if not ours:
                    _import_or_leave_out(name)
            if self._outside is None:
                self._discover_outside()

    def _discover_own(self) -> None:
        if self._package is None:
            return
        package, self._package = self._package, None
        for name, ours in _modules(package):
            if ours:
                importlib.import_module(name)

    def _discover_outside(self) -> None:
        """Import what is not ours: modules of the user's own, and those of installed packages."""
        if self._outside is not None:
            package, self._outside = self._outside, None
            for name, ours in _modules(package):
                if not ours:
                    _import_or_leave_out(name)
        if self._group is not None:
            group, self._group = self._group, None
            for point in importlib.metadata.entry_points(group=group):
                _import_or_leave_out(point.module)


def _modules(package: str) -> list[tuple[str, bool]]:
    """Return the modules of a package, each with whether it lies in the package's own folder."""
    found = importlib.import_module(package)
    return [
        (f"{package}.{module.name}", module.module_finder.path == found.__path__[0])  # type: ignore[union-attr]
        for module in pkgutil.iter_modules(found.__path__)
    ]


def _import_or_leave_out(name: str) -> None:
    """Import a module that is not ours; one that cannot be imported is named in one line, once, and left out."""
    if name in _left_out:
        return
    _importing.append(name)
    try:
        importlib.import_module(name)
    except (Exception, SystemExit) as error:  # whatever it is, it is that file's: the others go on
        for item in [item for item in _entered if item[2] == name]:
            item[0]._remove(item[1])
            _entered.remove(item)
        _left_out.add(name)
        file, line, what = where_it_failed(error, _origin(name))
        warnings.warn(f"{file}, line {line}: {what}; what it registers is left out", TaskWarning, stacklevel=2)
    finally:
        _importing.pop()


def _registering_module() -> str:
    """Return the name of the module whose code calls a registry."""
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__") == __name__:
        frame = frame.f_back
    return str(frame.f_globals.get("__name__"))


def _origin(name: str) -> str:
    """Return the file of a module, or its name where there is none."""
    try:
        spec = importlib.util.find_spec(name)
    except ImportError:  # the package that holds it
        return name
    return spec.origin if spec and spec.origin else name


def where_it_failed(error: BaseException, origin: str) -> tuple[str, int, str]:
    """Return file, line and words of what stopped the import of the file `origin`."""
    if isinstance(error, SyntaxError):
        return error.filename or origin, error.lineno or 1, f"{type(error).__name__}: {error.msg}"
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.filename == origin]
    return origin, (frames[-1].lineno if frames else None) or 1, f"{type(error).__name__}: {error}"


def outside_folders(variable: str, beside: Sequence[str]) -> list[str]:
    """Return the folders that the environment variable names (separated as those of PATH), for a package's `__path__`.

    Processes started later inherit the variable, so that they find the same modules.

    Args:
        variable: name of the environment variable; unset or empty names no folder.
        beside: folders that the package has already.

    Raises:
        ConfigError: one is no folder, or holds a module whose name is taken, which would never be imported.
    """
    folders = [str(Path(name).resolve()) for name in os.environ.get(variable, "").split(os.pathsep) if name]
    known = {module.name: module.module_finder.path for module in pkgutil.iter_modules(list(beside))}  # type: ignore[union-attr]
    for folder in folders:
        if not Path(folder).is_dir():
            raise ConfigError(f"{variable} names {folder}, which is no folder: correct or unset it")
        for module in pkgutil.iter_modules([folder]):
            if module.name in known:
                raise ConfigError(
                    f"{variable}: {folder} holds {module.name}.py, and so does {known[module.name]}: rename one of them"
                )
            known[module.name] = folder
    return folders
