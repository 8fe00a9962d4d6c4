"""Names of a benchmark's methods: a kind, overrides in brackets, a teacher behind a colon."""

from __future__ import annotations

import hashlib
import re
from typing import NamedTuple

from manicm_ms.errors import ConfigError

_BRACKETS = r"\[([^\[\]]*)\]"
_NAME = re.compile(rf"([^\[\]:]*)(?:{_BRACKETS})?(?::([^\[\]:]*(?:{_BRACKETS})?))?")
_UNSAFE = re.compile(r"[^\w.,=+-]")
_LONGEST = 100  # characters; a folder's name may have 255, and that of a student holds its teacher's


class MethodName(NamedTuple):
    """A name, read.

    Attributes:
        kind: what it is.
        overrides: KEY=VALUE, each key once, in the order of the keys.
        teacher: the name of what it is made from; "" where it says nothing of it.
    """

    kind: str
    overrides: tuple[str, ...] = ()
    teacher: str = ""

    def __str__(self) -> str:
        brackets = f"[{';'.join(self.overrides)}]" if self.overrides else ""
        return f"{self.kind}{brackets}{':' if self.teacher else ''}{self.teacher}"


def read_name(text: str) -> MethodName:
    """Return what a name says; `str` of it is the same for all spellings of one method.

    Raises ConfigError where it is not of the form METHOD, METHOD[KEY=VALUE;...] or either with :TEACHER behind it.
    """
    match = _NAME.fullmatch(text.strip())
    if match is None:
        raise ConfigError(
            f"a method is written NAME, NAME[KEY=VALUE;KEY=VALUE] or NAME:TEACHER, as in "
            f"simple_dp3[head.prediction_type=epsilon]; got {text!r}"
        )
    kind, overrides, teacher = match[1].strip(), match[2], match[3]
    return MethodName(kind, _sorted(overrides or "", text), str(read_name(teacher)) if teacher else "")


def _sorted(text: str, name: str) -> tuple[str, ...]:
    found: dict[str, str] = {}
    for word in filter(None, (word.strip() for word in text.split(";"))):
        key, equals, value = (part.strip() for part in word.partition("="))
        if not equals or not key or key in found:
            raise ConfigError(f"brackets of a method hold KEY=VALUE, each key once, between semicolons; got {name!r}")
        found[key] = value
    return tuple(f"{key}={value}" for key, value in sorted(found.items()))


def folder_name(name: MethodName) -> str:
    """Return a folder's name for a method, without its teacher: readable, and another one for every other method."""
    text = "+".join([name.kind, *name.overrides])
    safe = _UNSAFE.sub("_", text)
    if safe == text and len(safe) <= _LONGEST:
        return safe
    return f"{safe[:_LONGEST]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"
