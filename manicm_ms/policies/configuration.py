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
import re
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import yaml

from manicm_ms.errors import ConfigError, UnknownNameError

NAME = "name"
"""Key of a section that says which part its other keys are of."""

Config = TypeVar("Config")
Nested = Mapping[str, Any]
"""Sections, or the fields of one."""


def merged(base: Nested, changes: Nested) -> dict[str, Any]:
    """Return `base` with `changes`, section by section; both stay as they are.

    A section that names another part than before begins anew: fields of the U-Net mean nothing to a mixer. A section
    that is a text instead of a mapping is that part's name.
    """
    result = copy.deepcopy(dict(base))
    for key, value in changes.items():
        old = result.get(key)
        if isinstance(value, str) and isinstance(old, Mapping):
            value = {NAME: value}
        if isinstance(value, Mapping) and isinstance(old, Mapping):
            same = value.get(NAME, old.get(NAME)) == old.get(NAME)
            result[key] = merged(old if same else {}, value)
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
        raise ConfigError(f"{path} is no YAML ({' '.join(str(error).split())}): correct it") from error
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    except RecursionError as error:
        raise ConfigError(f"{path} is nested too deeply: write sections and their fields") from error
    if not isinstance(value, dict) or not all(isinstance(key, str) for key in value):
        raise ConfigError(f"{path} holds no sections: write, for example, `head: {{num_inference_steps: 4}}`")
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
    """Return `value` as the annotation `hint` has it; raise ConfigError where it is something else."""
    options = get_args(hint) if get_origin(hint) not in (tuple, None) else (hint,)
    for option in options:
        fitting = _fitting(value, option)
        if fitting is not None or (value is None and option in (type(None), None)):
            return fitting
    raise ConfigError(f"{path} takes {_called(hint)}, got {value!r}")


def _fitting(value: Any, hint: Any) -> Any:
    """Return `value` as the plain type or tuple `hint`, or None where it does not fit."""
    if get_origin(hint) is tuple:
        inner = get_args(hint)[0]
        items = [_fitting(item, inner) for item in value] if isinstance(value, list | tuple) else [None]
        if not isinstance(value, list | tuple) and (one := _fitting(value, inner)) is not None:
            items = [one]  # `--set backbone.down_dims=64` names one stage
        return None if any(item is None for item in items) else tuple(items)
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(hint, type) and isinstance(value, hint) and (hint is bool or not isinstance(value, bool)):
        return value
    return None


def _called(hint: Any) -> str:
    if get_origin(hint) is tuple:
        return f"several values, each {_called(get_args(hint)[0])}"
    if args := get_args(hint):
        return " or ".join(_called(a) for a in args)
    names = {int: "a whole number", float: "a number", str: "a word", bool: "true or false", type(None): "null"}
    return names.get(hint, getattr(hint, "__name__", str(hint)))
