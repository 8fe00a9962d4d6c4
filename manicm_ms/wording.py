"""Words of messages that depend on numbers."""

from __future__ import annotations


def counted(number: int, what: str) -> str:
    """Return "1 episode", "2 episodes", "2 policies": `what` is the singular of a noun with a regular plural."""
    if number == 1:
        return f"1 {what}"
    return f"{number} {what[:-1]}ies" if what.endswith(("cy", "ty", "ry")) else f"{number} {what}s"
