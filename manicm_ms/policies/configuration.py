"""Configurations of policies: nested, tagged sections that are merged, overridden by dotted keys and checked.

A section holds the fields of one part; its `name`, where there is a choice, says which part::

    {"encoder": {"name": "dp3", "point_features": 64},
     "backbone": {"name": "unet1d", "down_dims": [64, 128, 256]},
     "head": {"name": "diffusion", "num_inference_steps": 10}}

`backbone.down_dims` names the field of that section. The same keys stand in a method's row, in an override of the
command line, in a YAML file and in a checkpoint's config.json.
"""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import yaml

from manicm_ms.errors import ConfigError, UnknownNameError

NAME = "name"
"""Key of a section that says which part its other keys are of."""
PARTS = ("encoder", "backbone", "head")
"""Sections that have one."""

Config = TypeVar("Config")
Nested = Mapping[str, Any]
"""Sections, or the fields of one."""


def merged(base: Nested, changes: Nested) -> dict[str, Any]:
    """Return `base` with `changes`, section by section; both stay as they are.

    A section that names another part than before begins anew: fields of the U-Net mean nothing to a mixer. A text in
    place of a part's section (`PARTS`) is that part's name.
    """
    result = copy.deepcopy(dict(base))
    for key, value in changes.items():
        old = result.get(key)
        if key in PARTS:
            old, value = ({NAME: v} if isinstance(v, str) else v for v in (old, value))
        if isinstance(value, Mapping) and isinstance(old, Mapping):
            other = NAME in value and NAME in old and value[NAME] != old[NAME]
            result[key] = merged({} if other else old, value)
        else:
            result[key] = copy.deepcopy(value)
    return result


def lookup(config: Nested, path: str) -> Any:
    """Return what stands at a dotted path; raise KeyError where nothing does."""
    value: Any = config
    for key in path.split("."):
        if not isinstance(value, Mapping):
            raise KeyError(path)
        value = value[key]
    return value


def lookup_or_none(config: Nested, path: str) -> Any:
    """Return what stands at a dotted path, or None where nothing does."""
    try:
        return lookup(config, path)
    except KeyError:
        return None


def at(path: str, value: Any) -> dict[str, Any]:
    """Return the nested mapping that holds `value` at a dotted path, and nothing else."""
    for key in reversed(path.split(".")):
        value = {key: value}
    return value


def parse_overrides(words: Sequence[str]) -> dict[str, Any]:
    """Return what overrides as `head.num_inference_steps=4` or `backbone.down_dims=64,128` say, later ones last.

    Values are YAML scalars (`4`, `0.1`, `null`, `tcp`), or several of them separated by commas.

    Raises:
        ConfigError: one is not of the form KEY=VALUE, or its value is no scalar.
    """
    result: dict[str, Any] = {}
    for word in words:
        path, equals, text = word.partition("=")
        path, text = path.strip(), text.strip()
        if not equals or not all(path.split(".")):
            raise ConfigError(f"an override is written KEY=VALUE, as in head.num_inference_steps=4; got {word!r}")
        parts = (
            [_scalar(part, word) for part in text.split(",") if part.strip()] if "," in text else _scalar(text, word)
        )
        result = merged(result, at(path, parts))
    return result


def _scalar(text: str, word: str) -> Any:
    try:
        value = yaml.load(text, Loader=PlainLoader)
    except (yaml.YAMLError, ConfigError, RecursionError) as error:
        raise ConfigError(f"the value of {word!r} cannot be read: write a number, a word or null") from error
    if isinstance(value, dict | list):
        raise ConfigError(f"the value of {word!r} is neither number nor word: separate several by commas")
    return value


class PlainLoader(yaml.SafeLoader):
    """Reads mappings, lists and scalars, and nothing that points elsewhere: an alias can stand for a billion values."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Refuse anchors, aliases and tags, and go on."""
        event = self.peek_event()
        line = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None) is not None:
            raise ConfigError(f"line {line} has an anchor or an alias: write the values out")
        if getattr(event, "tag", None) is not None:
            raise ConfigError(f"line {line} has the tag {event.tag}: write plain values")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        """Return a mapping; refuse keys that are no words, and one that stands there twice."""
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        line = node.start_mark.line + 1
        if bad := [key for key in keys if not isinstance(key, str)]:
            raise ConfigError(f"the mapping that begins in line {line} has the key {bad[0]!r}: keys are words")
        if twice := [key for k, key in enumerate(keys) if key in keys[:k]]:
            raise ConfigError(f"the mapping that begins in line {line} has the key {twice[0]!r} twice")
        return super().construct_mapping(node, deep=deep)


# YAML 1.1 takes 1e-3 for a word; users, and YAML 1.2, for a number.
PlainLoader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?[0-9]+(\.[0-9]*)?[eE][-+]?[0-9]+$"), list("-+0123456789")
)


def read_yaml(path: Path) -> dict[str, Any]:
    """Return the nested configuration that a YAML file holds.

    Raises:
        ConfigError: there is no such file, it is no YAML, holds tags, anchors or aliases, or is no mapping.
    """
    path = Path(path)
    try:
        value = yaml.load(path.read_text(encoding="utf-8"), Loader=PlainLoader)
    except FileNotFoundError as error:
        raise ConfigError(f"there is no configuration file {path}: check the path") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path} cannot be read ({error}): name a YAML file") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path} is not valid YAML ({' '.join(str(error).split())}): correct it") from error
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    except RecursionError as error:
        raise ConfigError(f"{path} is nested too deeply: write sections and their fields") from error
    if not isinstance(value, dict):
        raise ConfigError(f"{path} has no sections: write, for example, `head: {{num_inference_steps: 4}}`")
    return value


def section(kind: type[Config], values: Nested, path: str) -> Config:
    """Return the dataclass `kind` with these values; what they lack takes its default.

    Args:
        kind: a dataclass whose annotations say which types are taken.
        values: field -> value, possibly from JSON: lists become tuples, whole numbers floats where one is wanted.
        path: of the section, for messages.

    Raises:
        UnknownNameError: no such field; it names the nearest one.
        ConfigError: a value of another type, a field that is missing, or a value that the dataclass itself refuses.
    """
    known = {f.name: f for f in fields(kind)}  # type: ignore[arg-type]
    for name in values:
        if name not in known:
            raise UnknownNameError("configuration key", f"{path}.{name}", [f"{path}.{k}" for k in known])
    hints = get_type_hints(kind)
    given = {name: typed(value, hints[name], f"{path}.{name}") for name, value in values.items()}
    if missing := [n for n, f in known.items() if n not in given and f.default is f.default_factory is MISSING]:
        raise ConfigError(f"{path} lacks {', '.join(missing)}")
    return kind(**given)


def typed(value: Any, hint: Any, path: str) -> Any:
    """Return `value` as the annotation `hint` has it; raise ConfigError where it is something else.

    Known are bool, int, float, str, `Literal`, lists and tuples of them, and unions with None or each other.
    """
    for option in get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,):
        fits, fitting = _fitting(value, option)
        if fits:
            return fitting
    raise ConfigError(f"{path} takes {_called(hint)}, got {value!r}")


def _fitting(value: Any, hint: Any) -> tuple[bool, Any]:
    """Return whether `value` fits an annotation that is no union, and the value as that type."""
    if hint in (None, type(None)):
        return value is None, None
    if get_origin(hint) is Literal:
        return value in get_args(hint), value
    if get_origin(hint) in (tuple, list):
        return _fitting_sequence(value, get_origin(hint), get_args(hint))
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if isinstance(value, float) and not math.isfinite(value):
        return False, None
    return isinstance(hint, type) and isinstance(value, hint) and (hint is bool or not isinstance(value, bool)), value


def _fitting_sequence(value: Any, kind: type, inner: tuple[Any, ...]) -> tuple[bool, Any]:
    items = value if isinstance(value, list | tuple) else [value]  # `--set backbone.down_dims=64` names one stage
    any_length = kind is list or inner[-1] is Ellipsis
    hints = [inner[0]] * len(items) if any_length else list(inner)
    if len(hints) != len(items):
        return False, None
    each = [_fitting(item, hint) for item, hint in zip(items, hints, strict=True)]
    return all(fits for fits, _ in each), kind(item for _, item in each)


def _called(hint: Any) -> str:
    if get_origin(hint) in (tuple, list):
        inner = get_args(hint)
        count = "several values" if get_origin(hint) is list or inner[-1] is Ellipsis else f"{len(inner)} values"
        return f"{count}, each {_called(inner[0])}"
    if get_origin(hint) is Literal:
        return f"one of {', '.join(map(str, get_args(hint)))}"
    if args := get_args(hint):
        return " or ".join(_called(a) for a in args)
    names = {int: "a whole number", float: "a finite number", str: "a word", bool: "true or false", type(None): "null"}
    return names.get(hint, getattr(hint, "__name__", str(hint)))
