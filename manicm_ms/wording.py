"""Words of messages that depend on numbers."""

from __future__ import annotations


def counted(number: int, what: str) -> str:
    """Return "1 episode", "2 episodes": `what` is the singular of a noun with a regular plural."""
    return f"{number} {what}{'' if number == 1 else 's'}"
