"""`check_vec_env`: the contract of `VecEnv`, checked on a real environment, one named property at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from manicm_ms.envs.vec_env import make_vec
from manicm_ms.envs.vector import Info, Obs, VecEnv
from manicm_ms.errors import ActionError, ConfigError, ManicmError
from manicm_ms.spec import AGENT_POS, DEPTH, IMAGE, POINT_CLOUD, STATE, ChunkSpec

_STEPS = 6
_SEEDS = (11, 12)
_EVERY_KEY = (POINT_CLOUD, AGENT_POS, STATE, DEPTH, IMAGE)


@dataclass(frozen=True)
class Property:
    """Whether one check passed.

    Attributes:
        name: the check, in a few words.
        passed: whether it holds.
        detail: what was seen where it does not, or why it was not looked at.
    """

    name: str
    passed: bool
    detail: str = ""


class ViolationError(Exception):
    """A check that failed."""


class NotApplicableError(Exception):
    """A check that does not apply to the environment's backend."""


def _require(holds: bool | Tensor, otherwise: str) -> None:
    if not holds:  # no assert: the check must also work under python -O
        raise ViolationError(otherwise)


class _Checks:
    """One environment id under examination; each method named in `PROPERTIES` raises ViolationError or returns."""

    def __init__(self, env_id: str, backend: str) -> None:
        self._env_id, self._backend = env_id, backend
        self.env = self._make(2, obs=_EVERY_KEY)
        self._episode: list[Obs] = []

    def _make(self, num_envs: int, **options: object) -> VecEnv:
        return make_vec(self._env_id, num_envs, self._backend, **options)  # type: ignore[call-overload]

    def _actions(self, env: VecEnv, steps: int = _STEPS) -> Tensor:
        """Return the same smooth random actions (steps, N, Da) for every row, whatever N."""
        generator = torch.Generator().manual_seed(0)
        actions = torch.rand(steps, 1, env.env_spec.action.dim, generator=generator) * 1.6 - 0.8
        return actions.expand(-1, env.num_envs, -1).contiguous().to(env.device)

    def _play(self, env: VecEnv, seeds: tuple[int, ...]) -> list[Obs]:
        frames = [env.reset(seed=list(seeds))[0]]
        frames += [env.step(action)[0] for action in self._actions(env)]
        return frames

    def _comparable(self, frames: list[Obs]) -> list[Obs]:
        """Return those frames of an episode that its seed decides bit for bit.

        All on a CPU; in the rows of a GPU batch, which share a scene, the first one (docs/decisions/0010).
        """
        return frames if self.env.backend == "cpu" else frames[:1]

    # ---- the properties ---------------------------------------------------------------------------------------

    def plays(self) -> None:
        """First: the others look at what it played."""
        self._episode = self._play(self.env, _SEEDS)

    def spaces_hold(self) -> None:
        """Shapes, dtypes and device are those of the spaces."""
        for frame in self._episode:
            for key, values in frame.items():
                space = self.env.observation_space[key]  # type: ignore[index]
                _require(tuple(values.shape) == space.shape, f"{key} is {tuple(values.shape)}, its space {space.shape}")
                dtype = values.numpy(force=True).dtype
                _require(dtype == space.dtype, f"{key} is {dtype}, its space {space.dtype}")
                _require(values.device.type == self.env.device.type, f"{key} lies on {values.device}")

    def observations_finite(self) -> None:
        """No NaN, no infinity."""
        for frame in self._episode:
            for key, values in frame.items():
                _require(torch.isfinite(values.float()).all(), f"{key} holds NaN or infinity")

    def same_seed_same_episode(self) -> None:
        """Playing the same seeds again gives the same frames."""
        again = self._comparable(self._play(self.env, _SEEDS))
        _assert_equal(self._comparable(self._episode), again, "a second run of the same seeds")

    def seed_decides_whatever_num_envs(self) -> None:
        """A seed gives the same frames alone in another process as beside others."""
        alone = self._make(1, obs=_EVERY_KEY)
        try:
            second = [{k: v[1:] for k, v in frame.items()} for frame in self._comparable(self._episode)]
            played = self._comparable(self._play(alone, _SEEDS[1:]))
            _assert_equal(second, played, "the second seed alone, in another environment,")
        finally:
            alone.close()

    def other_seed_other_start(self) -> None:
        """Two seeds start differently."""
        first = self._episode[0]
        _require(any(not torch.equal(v[0], v[1]) for v in first.values()), "two seeds gave one and the same start")

    def observations_vary(self) -> None:
        """Proprioception answers to actions."""
        moved = self._episode[-1][AGENT_POS] - self._episode[0][AGENT_POS]
        _require(moved.abs().max() > 1e-4, "agent_pos does not answer to actions")

    def observations_share_no_memory(self) -> None:
        """What was handed out does not change when the environment goes on."""
        kept = {k: v.clone() for k, v in self.env.reset(seed=list(_SEEDS))[0].items()}
        held, _ = self.env.reset(seed=list(_SEEDS))
        self.env.step(self._actions(self.env)[0])
        _assert_equal([kept], [held], "an observation handed out earlier")

    def partial_reset_leaves_others(self) -> None:
        """Rows outside the mask keep their observation and their count."""
        self.env.reset(seed=list(_SEEDS))
        before = self.env.step(self._actions(self.env)[0])[0]
        mask = np.array([True, False])
        after, info = self.env.reset(seed=[_SEEDS[0], 99], options={"reset_mask": mask})
        _assert_equal([_row(before, 1)], [_row(after, 1)], "the row that was not reset")
        _assert_equal([_row(self._episode[0], 0)], [_row(after, 0)], "the row that was reset")
        _require(info["elapsed_steps"].tolist() == [0, 1], f"elapsed_steps is {info['elapsed_steps'].tolist()}")

    def unreset_row_goes_on(self) -> None:
        """The row left alone by a partial reset continues as if nothing had happened."""
        if self.env.backend != "cpu":
            raise NotApplicableError("not looked at: rows of a gpu batch repeat their start, not their episode")
        actions = self._actions(self.env)
        self.env.reset(seed=list(_SEEDS))
        for k in range(3):
            self.env.step(actions[k])
        self.env.reset(seed=[7, 7], options={"reset_mask": np.array([True, False])})
        last: Obs = {}
        for k in range(3, _STEPS):
            last = self.env.step(actions[k])[0]
        _assert_equal([_row(self._episode[-1], 1)], [_row(last, 1)], "the row that was not reset")

    def bad_actions_refused(self) -> None:
        """NaN and wrong shapes raise ActionError, in one line."""
        self.env.reset(seed=list(_SEEDS))
        good = self._actions(self.env)[0]
        nan = good.clone()
        nan[1, 0] = torch.nan
        for name, action in {"NaN": nan, "a missing row": good[:1], "a missing entry": good[:, :-1]}.items():
            try:
                self.env.step(action)
            except ActionError as error:
                _require("\n" not in str(error), f"the message about {name} has more than one line")
                continue
            raise ViolationError(f"an action with {name} was accepted")

    def bad_resets_refused(self) -> None:
        """Unknown options, masks of nobody and seeds out of range raise ConfigError, and harm nothing."""
        self.env.reset(seed=list(_SEEDS))
        bad: dict[str, dict[str, Any]] = {
            "an unknown option": {"options": {"mask": np.array([True, False])}},
            "a mask of nobody": {"options": {"reset_mask": np.array([False, False])}},
            "a negative seed": {"seed": -1},
            "a seed that is no whole number": {"seed": [0, 0.5]},
        }
        for name, request in bad.items():
            try:
                self.env.reset(**request)
            except ConfigError as error:
                _require("\n" not in str(error), f"the message about {name} has more than one line")
                continue
            raise ViolationError(f"a reset with {name} was accepted")
        *_, info = self.env.step(self._actions(self.env)[0])
        _require(info["elapsed_steps"].tolist() == [1, 1], "a refused reset has changed a row")

    def last_seed_decides_later_resets(self) -> None:
        """Resets without a seed go on from the last one, and differ from each other."""
        first, again = [[self.env.reset(seed=seed)[0] for seed in (_SEEDS[0], None, None)] for _ in range(2)]
        _assert_equal(first, again, "an episode without a seed, after the same seed,")
        _require(any(not torch.equal(v, first[2][k]) for k, v in first[1].items()), "two such episodes start alike")

    def out_of_range_clipped_and_counted(self) -> None:
        """Entries beyond [-1, 1] act as the limit does, and are counted."""
        big = self._actions(self.env)[0].clone()
        big[:, 0] = 5.0
        limit = big.clamp(-1, 1)
        self.env.reset(seed=list(_SEEDS))
        clipped, *_, info = self.env.step(big)
        self.env.reset(seed=list(_SEEDS))
        plain = self.env.step(limit)[0]
        if self.env.backend == "cpu":  # elsewhere one and the same step need not end alike to the last bit
            _assert_equal([plain], [clipped], "an action out of range")
        _require(info["clipped"].tolist() == [1, 1], f"info['clipped'] is {info['clipped'].tolist()}, not [1, 1]")

    def info_complete(self) -> None:
        """Every info holds the documented names, shapes and dtypes."""
        _, reset_info = self.env.reset(seed=list(_SEEDS))
        *_, info = self.env.step(self._actions(self.env)[0])
        for facts in (reset_info, info):
            _check_info(facts, self.env.num_envs)

    def chunk_equals_single_steps(self) -> None:
        """A chunk returns the last frames that its actions give one by one."""
        chunk = ChunkSpec(n_obs_steps=2, horizon=4, n_action_steps=3)
        env = self._make(1, obs=(POINT_CLOUD, AGENT_POS), chunk=chunk)
        try:
            actions = self._actions(env)[:, 0]  # (steps, Da)
            first = env.reset(seed=[_SEEDS[0]])[0]
            second = env.step(actions[None, :3])[0]
        finally:
            env.close()
        start, *_, before, last = [_row(frame, 0) for frame in self._episode[:4]]
        for key, values in first.items():
            repeated = torch.stack([start[key], start[key]])
            _require(torch.equal(values[0], repeated), f"the first history of {key} is not the first frame repeated")
        if self.env.backend != "cpu":
            return
        for key, values in second.items():
            _require(torch.equal(values[0, 0], before[key]), f"history of {key}: not the frame before the last")
            _require(torch.equal(values[0, 1], last[key]), f"history of {key}: not the last frame")

    def time_limit_truncates_and_freezes(self) -> None:
        """The episode ends at its limit; later steps change nothing and earn nothing."""
        env = self._make(1, obs=(AGENT_POS,))
        try:
            env.reset(seed=[_SEEDS[0]])
            idle = torch.zeros(1, env.env_spec.action.dim, device=env.device)
            for _ in range(env.env_spec.max_episode_steps):
                obs, _, terminated, truncated, info = env.step(idle)
            _require(bool(terminated | truncated), "the time limit did not end the episode")
            elapsed = info["elapsed_steps"].item()
            again, reward, _, truncated_again, info = env.step(idle + 1)
        finally:
            env.close()
        _assert_equal([obs], [again], "a step after the end")
        _require(reward.item() == 0, "a step after the end is rewarded")
        _require(truncated_again.item() == truncated.item(), "a step after the end changed a flag")
        _require(info["elapsed_steps"].item() == elapsed, "a step after the end was counted")

    def close_twice(self) -> None:
        """Last: closes the environment."""
        self.env.close()
        self.env.close()


PROPERTIES: tuple[Callable[[_Checks], None], ...] = (
    _Checks.plays,
    _Checks.spaces_hold,
    _Checks.observations_finite,
    _Checks.same_seed_same_episode,
    _Checks.seed_decides_whatever_num_envs,
    _Checks.other_seed_other_start,
    _Checks.observations_vary,
    _Checks.observations_share_no_memory,
    _Checks.partial_reset_leaves_others,
    _Checks.unreset_row_goes_on,
    _Checks.bad_actions_refused,
    _Checks.bad_resets_refused,
    _Checks.last_seed_decides_later_resets,
    _Checks.out_of_range_clipped_and_counted,
    _Checks.info_complete,
    _Checks.chunk_equals_single_steps,
    _Checks.time_limit_truncates_and_freezes,
    _Checks.close_twice,
)


def check_vec_env(
    env_id: str, backend: str = "auto", on_result: Callable[[Property], None] = lambda _: None
) -> list[Property]:
    """Check the contract of `VecEnv` on an environment id, by playing it.

    Checked are: it plays at all; spaces and dtypes; finite observations; the same seed gives the same episode, again,
    alone and in another environment; seeds differ; observations answer to actions and share no memory; a partial reset
    leaves the other rows as they are; NaN and misshapen actions are refused, those out of range clipped and counted;
    bad seeds and unknown reset options are refused; the last seed decides later resets; info is complete; a chunk
    equals its single steps; the time limit truncates and freezes; closing twice is harmless.

    On the cpu backend episodes are compared whole and bit for bit. On the gpu backend a seed fixes the same start
    (docs/decisions/0010): the properties about equal episodes then compare the first frame alone, and "unreset row
    goes on" is passed with the reason in its detail.

    Args:
        env_id: a registered id.
        backend: see `make_vec`.
        on_result: called with each property as soon as it is known.

    Returns:
        one `Property` a check, in a fixed order; only the first one where it does not play.

    Raises:
        UnknownNameError, BackendError, RenderDeviceError: see `make_vec`.
    """
    checks = _Checks(env_id, backend)
    results = []
    try:
        for check in PROPERTIES:
            results.append(_run(check, checks))
            on_result(results[-1])
            if check is _Checks.plays and not results[-1].passed:
                break
    finally:
        checks.env.close()
    return results


def _run(check: Callable[[_Checks], None], checks: _Checks) -> Property:
    name = check.__name__.replace("_", " ")
    try:
        check(checks)
    except NotApplicableError as reason:
        return Property(name, True, str(reason))
    except (ViolationError, ManicmError) as error:
        return Property(name, False, str(error))
    except Exception as error:  # whatever an environment raises is its own failure, not this check's
        return Property(name, False, f"{type(error).__name__}: {error}")
    return Property(name, True)


def _row(frame: Obs, row: int) -> Obs:
    return {key: values[row] for key, values in frame.items()}


def _assert_equal(expected: list[Obs], actual: list[Obs], what: str) -> None:
    for k, (a, b) in enumerate(zip(expected, actual, strict=True)):
        for key in a:
            if not torch.equal(a[key], b[key]):
                worst = (a[key].double() - b[key].double()).abs().max().item()
                raise ViolationError(f"{what} differs in {key} at frame {k} by up to {worst:.3g}")


def _check_info(info: Info, num_envs: int) -> None:
    dtypes = {"success": torch.bool, "success_once": torch.bool, "elapsed_steps": torch.int64, "clipped": torch.int64}
    for name, dtype in dtypes.items():
        _require(name in info, f"info lacks {name!r}")
        _require(tuple(info[name].shape) == (num_envs,), f"info[{name!r}] is {tuple(info[name].shape)}")
        _require(info[name].dtype == dtype, f"info[{name!r}] is {info[name].dtype}, not {dtype}")
    _require(info["error"] == [None] * num_envs, f"info['error'] is {info['error']}")
