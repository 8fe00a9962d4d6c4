"""What several commands share: options, and the command line as it was given."""

from __future__ import annotations

import shlex
import sys
from typing import Any, Literal

from manicm_ms.cli.messages import PROGRAM
from manicm_ms.errors import ManicmError

Backend = Literal["auto", "cpu", "gpu"]


def at_least_one(values: tuple[Any, ...], what: str) -> tuple[Any, ...]:
    """Return `values`; raise ManicmError where there are none."""
    if not values:
        raise ManicmError(f"name at least one {what}")
    return values


def this_command() -> str:
    """Return the command line as the user gave it, for provenance."""
    return shlex.join([PROGRAM, *sys.argv[1:]])
