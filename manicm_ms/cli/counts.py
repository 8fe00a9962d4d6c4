"""Whole numbers on the command line: each option says the least that it takes, and less is refused before any work."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, get_type_hints

from manicm_ms.errors import ConfigError


@dataclass(frozen=True)
class AtLeast:
    """Marks an option of a command, by `Annotated`, with the least value that it takes."""

    value: int


Count = Annotated[int, AtLeast(1)]
"""How many of something that there must be one of."""
OptionalCount = Annotated[int | None, AtLeast(1)]
"""The same where leaving it out has a meaning of its own, which 0 has not."""
CountOrNone = Annotated[int, AtLeast(0)]
"""How many of something that there may be none of."""
Seed = Annotated[int, AtLeast(0)]
"""A seed: numpy and the simulators take none below 0."""


def least_values(command: Callable[..., Any]) -> dict[str, int]:
    """Return option -> least value of the options of `command` that are marked with one."""
    hints = get_type_hints(command, include_extras=True)
    marks = {name: getattr(hint, "__metadata__", ()) for name, hint in hints.items()}
    return {name: mark.value for name, those in marks.items() for mark in those if isinstance(mark, AtLeast)}


def checked(command: Callable[..., Any]) -> Callable[..., Any]:
    """Return `command` with a check of its counts, which raises ConfigError naming the option, before it is run."""
    least = least_values(command)

    @functools.wraps(command)
    def run(*args: Any, **options: Any) -> Any:
        for name, value in least.items():
            given = options.get(name)
            if given is not None and given < value:
                raise ConfigError(f"--{name.replace('_', '-')} must be at least {value}, got {given}")
        return command(*args, **options)

    return run
