"""Episode logic over a simulator: histories, action chunks, time limits, frozen rows, crashed rows."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from manicm_ms.envs.simulator import Simulator, StepResult
from manicm_ms.errors import ManicmError
from manicm_ms.spec import ChunkSpec

_DIVERGED = "the simulation diverged: the observation holds NaN or infinity"


class ActionChunk:
    """Plays action chunks in n rows and renders only the frames that a policy will read.

    For To = 2, Ta = 3 one `step` does this (r: rendered)::

        action      a0   a1   a2
        frame     f0   f1   f2   f3
        rendered            r    r

    A row that ends inside a chunk stops there: its last frame is rendered, its other actions are not played, and
    it stays as it is until it is reset. A row whose observation is not finite has crashed: it is terminated without
    success, with the reason in `errors`, and keeps its last finite history. Where the simulator raises, all rows that
    were playing, or were to be reset, have crashed; at the first reset, which has no frame to show, the error goes on.

    Args:
        simulator: the n rows.
        n_obs_steps: To, frames of history returned.
        n_action_steps: Ta, actions of a chunk.
    """

    def __init__(self, simulator: Simulator, n_obs_steps: int = 1, n_action_steps: int = 1) -> None:
        self.simulator = simulator
        self.n_obs_steps, self.n_action_steps = n_obs_steps, n_action_steps
        n, device = simulator.num_rows, simulator.device
        self.terminated = torch.ones(n, dtype=torch.bool, device=device)  # nothing can be stepped before a reset
        self.truncated = torch.zeros_like(self.terminated)
        self.success_once = torch.zeros_like(self.terminated)
        self.elapsed = torch.zeros(n, dtype=torch.int64, device=device)
        self.clipped = torch.zeros_like(self.elapsed)
        self.errors: list[str | None] = [None] * n
        self._info: dict[str, Tensor] = {}
        self._history: dict[str, Tensor] = {}

    @classmethod
    def from_spec(cls, simulator: Simulator, chunk: ChunkSpec | None) -> ActionChunk:
        """Build for `chunk`, or for single frames and single actions where it is None."""
        if chunk is None:
            return cls(simulator)
        return cls(simulator, chunk.n_obs_steps, chunk.n_action_steps)

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Start new episodes in `rows` (k,) int64; return all rows' histories (n, To, ...) and info (n,).

        Raises ManicmError, and at the first reset whatever the simulator raises.
        """
        failed = self._start(rows, seeds)
        for flags in (self.terminated, self.truncated, self.success_once):
            flags[rows] = False
        for counts in (self.elapsed, self.clipped):
            counts[rows] = 0
        for row in rows.tolist():
            self.errors[row] = None
        for name, values in self._info.items():
            self._info[name] = values.index_fill(0, rows, 0)
        fresh = torch.zeros_like(self.terminated).index_fill(0, rows, True)
        for row, reason in failed.items():
            fresh[row] = False
            self._crash(torch.zeros_like(fresh).index_fill(0, torch.as_tensor(row, device=fresh.device), True), reason)
        frame = self._first_frame(fresh)
        if frame is not None:
            self._restart_history(frame, fresh.nonzero().flatten())
            self._crash(fresh & ~_finite(frame), _DIVERGED)
        return dict(self._history), self.info()

    def _start(self, rows: Tensor, seeds: Sequence[int]) -> dict[int, str]:
        """Reset the simulator's rows, where that fails one by one; return why a row could not be, row -> reason."""
        try:
            self.simulator.reset(rows, seeds)
        except ManicmError:  # the machine's or the user's trouble: the next seed would meet it again
            raise
        except Exception as error:
            if not self._history:
                raise
            if len(rows) == 1:
                return {int(rows[0]): _reason(error)}
            failed: dict[int, str] = {}
            for k, seed in enumerate(seeds):
                failed |= self._start(rows[k : k + 1], [seed])
            return failed
        return {}

    def _first_frame(self, fresh: Tensor) -> dict[str, Tensor] | None:
        """Observe after a reset; return None where that fails, and the rows `fresh` (n,) bool have crashed."""
        try:
            return self.simulator.observe()
        except ManicmError:
            raise
        except Exception as error:
            if not self._history:
                raise
            self._crash(fresh, _reason(error))
            return None

    def step(self, actions: Tensor) -> tuple[dict[str, Tensor], Tensor, dict[str, Tensor]]:
        """Play actions (n, Ta, Da); return histories (n, To, ...), summed rewards (n,) and info (n,)."""
        active = ~(self.terminated | self.truncated)
        reward = torch.zeros(len(active), device=self.simulator.device)
        for k in range(self.n_action_steps):
            if not active.any():
                break
            action = actions[:, k]
            self.clipped += (action.abs() > 1).sum(dim=1) * active
            try:
                result = self.simulator.step(action.clamp(-1, 1))
                ended = self._account(result, active)
                if k >= self.n_action_steps - self.n_obs_steps or ended.any():
                    ended |= self._read(active)
            except Exception as error:  # whatever the simulator raises ends these episodes, not the run
                self._crash(active, _reason(error))
                break
            reward += torch.where(active & torch.isfinite(result.reward), result.reward, 0.0)
            active = active & ~ended
        return dict(self._history), reward, self.info()

    def info(self) -> dict[str, Tensor]:
        """Return per-row facts (n,): those of the task and success_once, elapsed_steps, clipped."""
        own = {"success_once": self.success_once, "elapsed_steps": self.elapsed, "clipped": self.clipped}
        task = self._info or {"success": torch.zeros_like(self.terminated)}
        return {name: values.clone() for name, values in (task | own).items()}

    def _account(self, result: StepResult, active: Tensor) -> Tensor:
        """Take over what a step brought in the active rows; return which of them ended, (n,) bool."""
        self.elapsed += active
        self.terminated |= active & result.terminated
        self.truncated |= active & ~self.terminated & (self.elapsed >= self.simulator.spec.max_episode_steps)
        for name, values in result.info.items():
            before = self._info.get(name, torch.zeros_like(values))
            self._info[name] = torch.where(active, values, before)
        self.success_once |= self._info["success"]
        return active & (self.terminated | self.truncated)

    def _read(self, active: Tensor) -> Tensor:
        """Observe, and append the frame to the histories of the active rows; return which crashed by it, (n,) bool."""
        frame = self.simulator.observe()
        crashed = active & ~_finite(frame)
        self._push(frame, active & ~crashed)
        self._crash(crashed, _DIVERGED)
        return crashed

    def _crash(self, crashed: Tensor, reason: str) -> None:
        if not crashed.any():
            return
        self.terminated |= crashed
        self.truncated &= ~crashed
        self._info["success"] = self._info.get("success", torch.zeros_like(crashed)) & ~crashed
        self.success_once &= ~crashed
        for row in crashed.nonzero().flatten().tolist():
            self.errors[row] = reason

    def _restart_history(self, frame: dict[str, Tensor], rows: Tensor) -> None:
        for key, values in frame.items():
            repeated = values[:, None].expand(-1, self.n_obs_steps, *values.shape[1:])
            if key not in self._history:
                self._history[key] = repeated.clone()
            history = self._history[key].clone()  # what was handed out before must not change under its reader
            history[rows] = repeated[rows]
            self._history[key] = history

    def _push(self, frame: dict[str, Tensor], active: Tensor) -> None:
        for key, values in frame.items():
            old = self._history[key]
            new = torch.cat([old[:, 1:], values[:, None]], dim=1)
            self._history[key] = torch.where(active.view(-1, *[1] * values.dim()), new, old)


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"


def _finite(frame: dict[str, Tensor]) -> Tensor:
    """Return which rows of a frame hold finite numbers only, (n,) bool."""
    parts = [torch.isfinite(v).flatten(1).all(dim=1) for v in frame.values() if v.is_floating_point()]
    n, device = next((len(v), v.device) for v in frame.values())
    return torch.stack(parts).all(dim=0) if parts else torch.ones(n, dtype=torch.bool, device=device)
