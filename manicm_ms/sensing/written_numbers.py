"""Numbers as people and other programs write them into text files."""

from __future__ import annotations

import re
from typing import Any

_POINT = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_COMMA = re.compile(r"[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?")


def as_number(value: Any) -> Any:
    """Return the number that a text spells, and anything else as it is.

    YAML reads 1e-3 and "640" as texts: it wants a point and a sign in an exponent. Whole numbers become ints.
    """
    text = value.strip() if isinstance(value, str) else ""
    if not _POINT.fullmatch(text):
        return value
    return int(text) if text.lstrip("+-").isdigit() else float(text)


def point_for_comma(text: Any) -> str | None:
    """Return a number that is written with a decimal comma as one with a point, or None for anything else."""
    stripped = text.strip() if isinstance(text, str) else ""
    return stripped.replace(",", ".") if _COMMA.fullmatch(stripped) else None
