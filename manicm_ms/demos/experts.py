"""Experts: what a demonstrator looks like, and the registry in which each task enters its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import torch

from manicm_ms.errors import UnknownNameError
from manicm_ms.registry import Registry
from manicm_ms.types import EnvSpec


class Expert(Protocol):
    """Plays N rows of a task from privileged state.

    Rows are independent: what a row does follows from its own state and seed alone, not from N, its
    place in the batch or its neighbours. So the same seed gives the same demonstration whatever the
    number of environments.

    Attributes:
        name: which expert made a demonstration; kept with the data.
        style: the style that this one plays, one of `styles`.
        styles: the styles it can play, the default one first.
    """

    name: str
    style: str
    styles: tuple[str, ...]

    def reset(self, state: torch.Tensor, seeds: Sequence[int], mask: torch.Tensor) -> None:
        """Begin a new episode in the rows of `mask`; the other rows go on.

        Args:
            state: (N, S) float32 privileged state after the environment's reset.
            seeds: N seeds; those of rows outside the mask are ignored.
            mask: (N,) bool.
        """
        ...

    def act(self, state: torch.Tensor) -> torch.Tensor:
        """Return the actions (N, Da) float32 in [-1, 1] for the privileged state (N, S)."""
        ...


ExpertFactory = Callable[[EnvSpec, int, torch.device, str | None], Expert]
"""Builds an expert from `(spec, num_envs, device, style)`; a style of None means the default one."""

EXPERTS: Registry[ExpertFactory] = Registry("expert for env id", package="manicm_ms.tasks")


def require_style(style: str | None, styles: Sequence[str]) -> str:
    """Return `style`, or the first of `styles` for None; raise UnknownNameError for one that is not there."""
    chosen = styles[0] if style is None else style
    if chosen not in styles:
        raise UnknownNameError("expert style", chosen, styles)
    return chosen
