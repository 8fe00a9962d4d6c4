"""Play a policy on a list of seeds in a vector env: every seed exactly once, a crash counts as a failure."""

from __future__ import annotations

import base64
import contextlib
import hashlib
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from manicm_ms.errors import BackendError, ConfigError
from manicm_ms.evaluation.decisions import Decider, Decisions
from manicm_ms.spec import STATE, ChunkSpec, require_compatible

if TYPE_CHECKING:
    from manicm_ms.envs.vector import VecEnv

MAX_RESTARTS = 3
"""Restarts of a dead env in a row, without an episode that ended by itself, before the rollout gives up."""
POLICY_FAULT = "the policy's action"
"""How the reason of an episode begins that its policy ended, by an action that is not finite; others are crashes."""


@dataclass(frozen=True)
class EpisodeResult:
    """What became of one episode.

    Attributes:
        seed: the episode's seed; it fixes the initial state and the policy's noise.
        success: by the env's `success_rule`; always False for a crashed episode.
        steps: control steps played.
        decisions: policy calls.
        total_return: sum of rewards.
        crashed: why the episode could not be played to its end, None where it was.
        success_once: whether it succeeded at some step; None in records of earlier versions.
        success_at_end: whether it succeeded at its last step; None where it was not played to its end.
        start_state: digest of the first state, see `start_digest`; None in records of earlier versions.
        actions: (decisions, Ta, Da) float32, the actions commanded; with the seed they replay the episode.
    """

    seed: int
    success: bool
    steps: int
    decisions: int
    total_return: float
    crashed: str | None = None
    success_once: bool | None = None
    success_at_end: bool | None = None
    start_state: str | None = None
    actions: np.ndarray = field(default_factory=lambda: np.zeros((0, 1, 1), np.float32), compare=False, repr=False)

    def to_record(self) -> dict[str, Any]:
        """Return plain JSON values, actions as base64 of little-endian float32; `from_record` is its inverse."""
        packed = base64.b64encode(np.ascontiguousarray(self.actions, dtype="<f4").tobytes()).decode("ascii")
        return {**self.summary(), "actions_shape": list(self.actions.shape), "actions": packed}

    def summary(self) -> dict[str, Any]:
        """Return plain JSON values without the actions."""
        return {
            "seed": self.seed,
            "success": self.success,
            "success_once": self.success_once,
            "success_at_end": self.success_at_end,
            "steps": self.steps,
            "decisions": self.decisions,
            "return": self.total_return,
            "crashed": self.crashed,
            "start_state": self.start_state,
        }

    @property
    def infrastructure_crashed(self) -> bool:
        """Whether something else than its policy ended the episode: then it says nothing about the policy."""
        return self.crashed is not None and not self.crashed.startswith(POLICY_FAULT)

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> EpisodeResult:
        """Build a result from what `to_record` returned."""
        flat = np.frombuffer(base64.b64decode(record["actions"]), dtype="<f4").astype(np.float32)
        return replace(cls.from_summary(record), actions=flat.reshape(record["actions_shape"]))

    @classmethod
    def from_summary(cls, record: Mapping[str, Any]) -> EpisodeResult:
        """Build a result without its actions from what `summary` returned, in this or an earlier version."""
        return cls(
            seed=int(record["seed"]),
            success=bool(record["success"]),
            steps=int(record["steps"]),
            decisions=int(record["decisions"]),
            total_return=float(record["return"]),
            crashed=record["crashed"],
            success_once=record.get("success_once"),
            success_at_end=record.get("success_at_end"),
            start_state=record.get("start_state"),
        )


class RestartableEnv:
    """Holds a vector env and builds it anew when its workers have died.

    Args:
        make_env: builds the env; called once now and once per `restart`.

    Attributes:
        env: the env that is alive at present.
    """

    def __init__(self, make_env: Callable[[], VecEnv]) -> None:
        self._make_env = make_env
        self.env = make_env()

    def restart(self) -> None:
        """Close what is left of the dead env and build a fresh one in its place."""
        with contextlib.suppress(Exception):  # a half-dead env may fail in any way while it is closed
            self.env.close()
        self.env = self._make_env()

    def close(self) -> None:
        """Close the env; twice is fine."""
        self.env.close()


def require_chunk(vec_env: VecEnv, chunk: ChunkSpec) -> None:
    """Raise ConfigError unless the env returns the frames and plays the actions of `chunk`."""
    theirs = vec_env.chunk
    ours = (chunk.n_obs_steps, chunk.n_action_steps)
    if theirs is None or (theirs.n_obs_steps, theirs.n_action_steps) != ours:
        plays = "no chunks" if theirs is None else f"{theirs.n_action_steps} actions for {theirs.n_obs_steps} frames"
        raise ConfigError(
            f"the env plays {plays} and the policy {chunk.n_action_steps} actions for {chunk.n_obs_steps}: "
            "make the env with chunk=policy.chunk"
        )


def start_digest(obs: Mapping[str, torch.Tensor], row: int) -> str | None:
    """Return what tells the state in which a row stands from others: 16 hex digits of the SHA-256 of its float32 bytes.

    None where the env does not give its privileged state. It does not depend on what a policy reads of the scene, so
    that two policies meet on the same start state where, and only where, their digests are equal. Two machines may
    differ in a last bit and so in the digest.

    Args:
        obs: key -> (N, To, ...), just after a reset.
        row: which of the N.
    """
    if STATE not in obs or obs[STATE].shape[-1] == 0:
        return None
    state = np.ascontiguousarray(_numpy(obs[STATE][row, -1]), dtype="<f4")
    return hashlib.sha256(state.tobytes()).hexdigest()[:16]


def rollout(
    vec_env: VecEnv | RestartableEnv,
    policy: Decider,
    seeds: Sequence[int],
    *,
    on_episode: Callable[[EpisodeResult], None] | None = None,
    to_the_end: bool = False,
) -> list[EpisodeResult]:
    """Play one episode per seed and return the results in the order of `seeds`.

    The protocol:

    1. A row without an episode takes the next seed and is reset; the other rows go on undisturbed.
    2. The policy decides for all N rows at once, idle ones included, so that the batch keeps one size.
       Row i's noise is a function of its episode's seed and the number of the decision alone.
    3. The env plays the chunk in all rows. Rows that ended give their result; back to 1. Where success at some step
       is enough (`success_rule` "any"), a row that has seen it has ended, whether or not the env goes on, unless
       `to_the_end` is asked for.
    4. A row whose simulation or policy fails (error in the env, also at its reset, or an action that is not
       finite) is a failed episode with its reason. If the env itself dies (BackendError), all episodes in
       flight are failed ones; a `RestartableEnv` is restarted and the remaining seeds go on, any other env ends the
       rollout with that error.

    Noise and initial state depend on the seed alone, hence the same seed meets two policies, or two
    values of num_envs, under the same conditions. With the same num_envs the results are bit-equal, in
    whatever order or part of the list the seeds are played: a row's action does not depend on its place
    in the batch or on the other rows (measured, and tested with a real network). Another num_envs is
    another batch size, at which matrix products round differently by about 1e-6.

    Args:
        vec_env: env with N rows, made with `chunk=policy.chunk`. Where it gives the privileged state, results hold
            its digest, and a policy that does not name the state among its `keys` does not see it.
        policy: decides; it stays on its device and is put in evaluation mode.
        seeds: distinct non-negative integers.
        on_episode: called with each result as soon as it is known, in order of completion.
        to_the_end: play on after a success that is certain (`success_rule` "any") until the env ends the episode, so
            that `success_at_end` is known.

    Raises:
        ConfigError: seeds that repeat, or an env made for another chunk.
        SpecMismatchError: a policy made for other observations or actions.
        BackendError: an env that cannot be restarted, or that keeps dying.
    """
    if len(set(seeds)) != len(seeds):
        raise ConfigError("every seed may be played once only: the list of seeds repeats some")
    env = vec_env.env if isinstance(vec_env, RestartableEnv) else vec_env
    require_chunk(env, policy.chunk)
    keys = getattr(policy, "keys", ())
    require_compatible(env.env_spec, policy.spec, f"environment {env.env_spec.env_id}", "the policy", keys)
    policy.eval()
    with torch.no_grad():
        results = _Rollout(vec_env, policy, seeds, on_episode, to_the_end).run()
    return [results[seed] for seed in seeds]


class _Episode:
    """An episode in flight in one row."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.start_state: str | None = None
        self.steps = 0
        self.total_return = 0.0
        self.actions: list[np.ndarray] = []  # each (Ta, Da)

    def result(self, outcome: _Outcome) -> EpisodeResult:
        actions = np.stack(self.actions) if self.actions else np.zeros((0, 1, 1), np.float32)
        return EpisodeResult(
            self.seed, outcome.success, self.steps, len(self.actions), self.total_return, outcome.crashed,
            outcome.success_once, outcome.success_at_end, self.start_state, actions,
        )  # fmt: skip


class _Outcome(NamedTuple):
    """How an episode ended; the fields are those of `EpisodeResult`."""

    success: bool = False
    success_once: bool | None = False
    success_at_end: bool | None = False
    crashed: str | None = None


class _Rollout:
    """The state of one call of `rollout`."""

    def __init__(
        self,
        vec_env: VecEnv | RestartableEnv,
        policy: Decider,
        seeds: Sequence[int],
        on_episode: Callable[[EpisodeResult], None] | None,
        to_the_end: bool,
    ) -> None:
        self.home = vec_env if isinstance(vec_env, RestartableEnv) else None
        self.env: VecEnv = vec_env.env if isinstance(vec_env, RestartableEnv) else vec_env
        self.policy, self.on_episode, self.to_the_end = policy, on_episode, to_the_end
        self.pending = deque(int(s) for s in seeds)
        self.rows: list[_Episode | None] = [None] * self.env.num_envs
        self.results: dict[int, EpisodeResult] = {}
        self.decisions = Decisions(policy, self.env.num_envs)
        self.obs: Mapping[str, torch.Tensor] | None = None  # None until the env's first reset
        self.restarts = 0
        # The privileged state is for the record alone, unless the policy reads it or does not say what it reads.
        self.hidden = {STATE} - set(getattr(policy, "keys", (STATE,)))

    def run(self) -> dict[int, EpisodeResult]:
        """Play all pending seeds; return seed -> result."""
        while self.pending or any(self.rows):
            try:
                self._start_episodes()
                self._play(self._decide())
            except BackendError as error:
                self._replace_env(error)
        return self.results

    def _start_episodes(self) -> None:
        fresh = np.zeros(len(self.rows), dtype=bool)
        for i, episode in enumerate(self.rows):
            if episode is None and self.pending:
                self.rows[i] = _Episode(self.pending.popleft())
                fresh[i] = True
        if not fresh.any():
            return
        # Rows without an episode need a first reset too; any seed will do, nobody looks at them.
        mask = fresh if self.obs is not None else np.ones_like(fresh)
        spare = next(e.seed for e in self.rows if e is not None)
        seeds = [spare if e is None else e.seed for e in self.rows]
        self.obs, info = self.env.reset(seed=seeds, options={"reset_mask": mask})
        self.decisions.restart(np.flatnonzero(mask).tolist())
        for i in np.flatnonzero(fresh).tolist():
            episode = self.rows[i]
            assert episode is not None
            if (error := info["error"][i]) is not None:
                self._end(i, _Outcome(crashed=error))
            else:
                episode.start_state = start_digest(self.obs, i)

    def _decide(self) -> torch.Tensor:
        """Return actions (N, Ta, Da); end the episodes of rows whose action is not finite."""
        assert self.obs is not None
        asked = [None if e is None else (e.seed, len(e.actions)) for e in self.rows]
        seen = {key: values for key, values in self.obs.items() if key not in self.hidden}
        actions = self.decisions.actions(seen, asked)
        finite = torch.isfinite(actions).flatten(1).all(1).cpu()
        actions = torch.where(finite.to(actions.device)[:, None, None], actions, torch.zeros_like(actions))
        played = actions.float().cpu().numpy()
        for i, episode in enumerate(self.rows):
            if episode is None:
                continue
            if finite[i]:
                episode.actions.append(played[i].copy())
            else:
                self._end(i, _Outcome(crashed=f"{POLICY_FAULT} {len(episode.actions)} is not finite"))
        return actions.to(self.env.device)

    def _play(self, actions: torch.Tensor) -> None:
        if not any(self.rows):
            return
        self.obs, reward, terminated, truncated, info = self.env.step(actions)
        rewards = _numpy(reward)
        ended = _numpy(terminated) | _numpy(truncated)
        steps = _numpy(info["elapsed_steps"])
        any_step = self.env.env_spec.success_rule == "any"
        now, once = _numpy(info["success"]), _numpy(info["success_once"])
        certain = once if any_step and not self.to_the_end else np.zeros_like(once)
        for i, episode in enumerate(self.rows):
            if episode is None:
                continue
            episode.total_return += float(np.nan_to_num(rewards[i]))
            episode.steps = int(steps[i])
            if (error := info["error"][i]) is not None:
                self._end(i, _Outcome(crashed=error))
            elif ended[i] or certain[i]:
                at_end = bool(now[i]) if ended[i] else None
                self._end(i, _Outcome(bool(once[i] if any_step else now[i]), bool(once[i]), at_end))

    def _end(self, row: int, outcome: _Outcome) -> None:
        episode = self.rows[row]
        assert episode is not None
        self.rows[row] = None
        if outcome.crashed is None:
            self.restarts = 0
        self.results[episode.seed] = result = episode.result(outcome)
        if self.on_episode is not None:
            self.on_episode(result)

    def _replace_env(self, error: BackendError) -> None:
        """Fail the episodes in flight and restart the env, or raise where that cannot help."""
        if self.home is None:
            raise error
        self.restarts += 1
        if self.restarts > MAX_RESTARTS:
            raise BackendError(
                f"the env died {self.restarts} times in a row without finishing an episode; last: {error}"
            ) from error
        for i, episode in enumerate(self.rows):
            if episode is not None:
                self._end(i, _Outcome(crashed=f"the env died: {error}"))
        self.obs = None
        self.home.restart()
        self.env = self.home.env


def _numpy(value: Any) -> np.ndarray:
    return value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)
