"""Experts: what a demonstrator looks like, and the registry in which each task enters its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from manicm_ms.errors import UnknownNameError
from manicm_ms.registry import TASKS, Registry
from manicm_ms.spec import EnvSpec


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

EXPERTS: Registry[ExpertFactory] = Registry("expert for env id", package=TASKS, group=TASKS)


def require_style(style: str | None, styles: Sequence[str]) -> str:
    """Return `style`, or the first of `styles` for None; raise UnknownNameError for one that is not there."""
    chosen = styles[0] if style is None else style
    if chosen not in styles:
        raise UnknownNameError("expert style", chosen, styles)
    return chosen


RowPolicy = Callable[[NDArray[np.float64]], NDArray[np.floating]]
"""(S,) privileged state of one row -> its action (Da,), not yet clipped."""


class RowwiseExpert:
    """Plays every row by a function of its present state alone, as the published policies of other suites do.

    Args:
        policy: the function.
        name: see `Expert`.
        style: see `Expert`.
    """

    def __init__(self, policy: RowPolicy, name: str, style: str) -> None:
        self._policy, self.name, self.style = policy, name, style
        self.styles: tuple[str, ...] = (style,)

    def reset(self, state: torch.Tensor, seeds: Sequence[int], mask: torch.Tensor) -> None:
        """See `Expert.reset`: there is nothing to remember."""
        del state, seeds, mask

    def act(self, state: torch.Tensor) -> torch.Tensor:
        """See `Expert.act`."""
        rows = state.cpu().numpy().astype(np.float64)
        actions = np.clip(np.stack([self._policy(row) for row in rows]), -1.0, 1.0)
        return torch.from_numpy(actions.astype(np.float32)).to(state.device)


@dataclass(frozen=True)
class RowwiseExpertFactory:
    """Builds `RowwiseExpert`s; an `ExpertFactory`.

    Attributes:
        load: returns the policy; raises ManicmError where what it is made of is not here.
        name: see `Expert`.
        styles: its one style.
    """

    load: Callable[[], RowPolicy]
    name: str
    styles: tuple[str, ...]

    def __call__(self, spec: EnvSpec, num_envs: int, device: torch.device, style: str | None) -> RowwiseExpert:
        """See `ExpertFactory`."""
        del spec, num_envs, device
        chosen = require_style(style, self.styles)
        return RowwiseExpert(self.load(), self.name, chosen)
