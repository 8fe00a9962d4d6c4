"""Commands that reach the robot late: a queue of actions for each row."""

from __future__ import annotations

import torch
from torch import Tensor


class ActionDelay:
    """Hands out, component by component, the action of some control steps ago.

    With a delay of d the action given at step k is played at step k + d; until then the row plays what it was
    started with.

    Args:
        num_rows: n.
        dim: Da, components of an action.
        longest: the longest delay, control steps.
        device: where actions live.
    """

    def __init__(self, num_rows: int, dim: int, longest: int, device: torch.device | str = "cpu") -> None:
        self._queue = torch.zeros(num_rows, longest + 1, dim, device=device)  # the newest first
        self._delay = torch.zeros(num_rows, 1, dim, dtype=torch.int64, device=device)

    def start(self, rows: Tensor, delay: Tensor, resting: Tensor) -> None:
        """Begin episodes in `rows`; the other rows go on.

        Args:
            rows: (k,) int64.
            delay: (k, Da) int64, control steps.
            resting: (k, Da), the action that a row plays until its first one arrives.
        """
        rows = rows.to(self._queue.device)
        self._queue[rows] = resting.to(self._queue)[:, None]
        self._delay[rows] = delay.to(self._delay)[:, None]

    def push(self, actions: Tensor) -> Tensor:
        """Take the actions (n, Da) of this step; return those that arrive in it (n, Da)."""
        self._queue = torch.cat([actions[:, None], self._queue[:, :-1]], dim=1)
        return torch.gather(self._queue, 1, self._delay)[:, 0]

    def pending(self) -> Tensor:
        """Return the sum of the actions that were given and have not arrived yet, (n, Da)."""
        age = torch.arange(self._queue.shape[1], device=self._queue.device)[:, None]
        return (self._queue * (age < self._delay)).sum(dim=1)
