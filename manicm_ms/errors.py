"""Errors that show the way out: what was asked, what exists, and what to try.

Every error that a user can cause derives from `ManicmError`; the command line prints its one line
and ends with exit status 2, without a traceback.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_MOST_LISTED = 20  # names that an error lists in full ...
_MOST_SHOWN = 6  # ... and how many of the nearest where there are more


class ManicmError(Exception):
    """Base of all errors caused by input or surroundings rather than by a defect of the package."""


class UnknownNameError(ManicmError):
    """A name that no registry entry answers to."""

    def __init__(self, kind: str, asked: str, known: Iterable[str], present_name: str | None = None) -> None:
        names = sorted(known)
        near = difflib.get_close_matches(asked, names, n=_MOST_SHOWN, cutoff=0.4)
        hint = f"did you mean {near[0]!r}? " if near else ""
        if present_name is not None:
            hint = f"it is called {present_name!r} here; "
        shown = names if len(names) <= _MOST_LISTED else (near or names)[:_MOST_SHOWN]
        rest = f" and {len(names) - len(shown)} more" if len(shown) < len(names) else ""
        super().__init__(f"unknown {kind} {asked!r}: {hint}known: {', '.join(shown) or 'none'}{rest}")
        self.kind, self.asked, self.known = kind, asked, names


class DuplicateNameError(ManicmError):
    """Two registrations under one name."""

    def __init__(self, kind: str, name: str) -> None:
        super().__init__(f"{kind} {name!r} is registered twice: give one of the two another name")


class ConfigError(ManicmError):
    """A configuration whose fields do not fit together or are out of range."""


def require_at_least(least: int, **values: int) -> None:
    """Raise ConfigError naming the first of `values` that is below `least`."""
    for name, value in values.items():
        if value < least:
            raise ConfigError(f"{name} must be at least {least}, got {value}")


class ActionError(ManicmError):
    """An action that has the wrong shape or is not finite."""


class NotFiniteError(ManicmError):
    """An observation that no policy can act on, or an action, that holds NaN or infinity.

    Attributes:
        rows: of the batch, those that are meant; the others are sound.
    """

    def __init__(self, message: str, rows: tuple[int, ...]) -> None:
        super().__init__(message)
        self.rows = rows


class SpecMismatchError(ManicmError):
    """A data set, checkpoint or environment whose specs do not fit each other."""


class NotComparableError(ManicmError):
    """Policies that were not played in the same environment from the same start states."""

    def __init__(self, difference: str) -> None:
        super().__init__(f"not comparable: {difference}")


class StoreError(ManicmError):
    """A demonstration store that is missing, broken, locked or of another origin."""


class ExpertFileError(ManicmError):
    """An expert's weights that are missing, altered, or in a form that is not read."""


class CheckpointError(ManicmError):
    """A checkpoint folder that is missing, incomplete, altered or foreign."""


class UserPolicyError(ManicmError):
    """A policy of the user's own cannot be loaded, or does not return what an evaluation needs."""


class OutputExistsError(ManicmError):
    """An output folder that already holds another run."""


class NoSpaceError(ManicmError):
    """Too little free space to write what is about to be written."""


class RenderDeviceError(ManicmError):
    """No Vulkan device that SAPIEN, or no OpenGL that MuJoCo, can render with."""


class BackendError(ManicmError):
    """A simulation backend that this machine cannot run."""


class CameraError(ManicmError):
    """A camera's description or a depth image that cannot be used."""


class ManicmWarning(UserWarning):
    """Base of all warnings: something is allowed and yet probably not what was meant; one line with its cause."""


class CameraWarning(ManicmWarning):
    """A camera whose numbers can hardly be those of one camera and one resolution."""


class TrainingDivergedError(ManicmError):
    """A training whose loss became NaN or infinite."""


class CalibrationError(ManicmError):
    """Images or robot poses from which no camera pose can be solved."""


class TaskWarning(ManicmWarning):
    """A task file of the user's that cannot be imported and is left out."""
