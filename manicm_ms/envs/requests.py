"""What a caller asks of a vector environment, checked before a simulator hears of it."""

from __future__ import annotations

import difflib
import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from manicm_ms.errors import ConfigError

RESET_MASK = "reset_mask"
Seeds = int | Sequence[int | None] | None


def reset_mask(options: dict[str, Any] | None, num_envs: int) -> NDArray[np.bool_]:
    """Return which rows `reset(options=...)` starts anew, (N,) bool.

    Raises:
        ConfigError: an option that does not exist, a mask of another form, or one that names no row.
    """
    if options is not None and not isinstance(options, dict):
        raise ConfigError(f"options must be a dictionary, as in {{'{RESET_MASK}': mask}}, got {options!r}")
    unknown = [key for key in options or {} if key != RESET_MASK]
    if unknown:
        near = difflib.get_close_matches(str(unknown[0]), [RESET_MASK], cutoff=0.4)
        hint = f"did you mean {RESET_MASK!r}?" if near else f"{RESET_MASK!r} is the only one"
        raise ConfigError(f"reset knows no option {unknown[0]!r}: {hint}")
    asked = (options or {}).get(RESET_MASK)
    if asked is None:
        return np.ones(num_envs, dtype=bool)
    mask = np.asarray(torch.as_tensor(asked).cpu())
    if mask.shape != (num_envs,) or mask.dtype != bool:
        raise ConfigError(f"{RESET_MASK} must be ({num_envs},) bool, got {mask.shape} {mask.dtype}")
    if not mask.any():
        raise ConfigError(f"{RESET_MASK} names no row: make at least one entry True, or do not call reset")
    return mask


class SeedStreams:
    """The seeds of N rows: those that a caller gives and, where none is given, streams that go on from them.

    Row k's stream begins with the last seed that row k was given, so `reset(seed=5)` fixes all later calls of `reset()`
    as well; before the first seed it begins with entropy of the system.

    Args:
        num_envs: N.
        limit: seeds lie in [0, limit).
        env_id: named in errors.
    """

    def __init__(self, num_envs: int, limit: int, env_id: str) -> None:
        self._limit, self._env_id = limit, env_id
        self._streams = [np.random.default_rng() for _ in range(num_envs)]

    def next(self, seed: Seeds, rows: NDArray[np.bool_]) -> list[int]:
        """Return N seeds, one a row; those of rows that are not in `rows` (N,) bool mean nothing.

        Args:
            seed: one seed from which the rows count up; or N, None where the row's stream goes on; or None for all.
            rows: which rows begin an episode; the others' streams stay as they are.

        Raises:
            ConfigError: seeds that are no whole numbers, out of range, or another number of them.
        """
        asked = self._asked(seed)
        seeds = []
        for k, given in enumerate(asked):
            if given is not None and rows[k]:
                self._streams[k] = np.random.default_rng(given)
            if given is None:
                given = int(self._streams[k].integers(2**31)) if rows[k] else 0
            seeds.append(given)
        return seeds

    def _asked(self, seed: Seeds) -> list[int | None]:
        n = len(self._streams)
        if seed is None:
            return [None] * n
        if isinstance(seed, (list, tuple, range)) or getattr(seed, "ndim", 0) == 1:
            listed = list(seed)  # type: ignore[arg-type]
            if len(listed) != n:
                raise ConfigError(f"{len(listed)} seeds for num_envs={n}: give one a row")
            return [None if one is None else self._checked(one) for one in listed]
        first = self._checked(seed)
        return [self._checked(first + k) for k in range(n)]

    def _checked(self, seed: Any) -> int:
        try:
            if isinstance(seed, (bool, np.bool_)):
                raise TypeError
            number = operator.index(seed)
        except TypeError:
            raise ConfigError(f"seed {seed!r} is no whole number: {self._range}") from None
        if not 0 <= number < self._limit:
            raise ConfigError(f"seed {number} is out of range: {self._range}")
        return number

    @property
    def _range(self) -> str:
        return f"{self._env_id} takes whole numbers from 0 to {self._limit - 1}"
