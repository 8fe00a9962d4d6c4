"""Plays every policy on every seed under every preset, what is on disk already left out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rich.console import Console
from rich.progress import Progress

from manicm_ms.evaluation.protocol import CLEAN, Conditions, EvaluatedPolicy, Protocol, slug
from manicm_ms.evaluation.records import EpisodeLog
from manicm_ms.evaluation.rollout import EpisodeResult, RestartableEnv, rollout
from manicm_ms.machine.devices import torch_threads
from manicm_ms.progress import progress_bars
from manicm_ms.sensing.realism import REALISM, RealismSample
from manicm_ms.spec import AGENT_POS, STATE, EnvSpec, require_compatible

if TYPE_CHECKING:
    from manicm_ms.envs.env_request import EnvRequest
    from manicm_ms.envs.vector import VecEnv
    from manicm_ms.evaluation.user_policy import UserPolicy
    from manicm_ms.policies.policy import Policy


class EnvMaker(NamedTuple):
    """Makes the vector envs that an evaluation needs.

    Attributes:
        for_policy: (policy, num_envs, realism preset) -> env that exchanges histories and chunks as the policy does.
        for_film: (num_envs, realism preset) -> env without a chunk, with `render_video_frames`.
        conditions: (realism preset, seed) -> what is drawn for that episode beside its scene.
    """

    for_policy: Callable[[Policy | UserPolicy, int, str], VecEnv]
    for_film: Callable[[int, str], VecEnv]
    conditions: Conditions = lambda preset, seed: {}


def env_maker(request: EnvRequest) -> EnvMaker:
    """Return what makes the real environments that are asked for."""

    def for_policy(policy: Policy | UserPolicy, n: int, preset: str) -> VecEnv:
        state = (STATE,) if request.entry.spec.state_layout else ()  # recorded as a digest, not shown to the policy
        keys = tuple(dict.fromkeys([*policy.keys, *state]))
        forms = policy.spec.obs.request(policy.keys)
        return request.vec_env(n, realism=preset, obs=keys, chunk=policy.chunk, **forms)

    def for_film(n: int, preset: str) -> VecEnv:
        return request.vec_env(n, realism=preset, obs=(AGENT_POS,), colors=False, video=True)

    def conditions(preset: str, seed: int) -> RealismSample:
        return request.entry.conditions(REALISM.get(preset), seed)

    return EnvMaker(for_policy, for_film, conditions)


class Played(NamedTuple):
    """What was played.

    Attributes:
        by_preset: preset -> policy -> results in the order of the seeds.
        spec: of the environment.
        seeds: those that were played.
    """

    by_preset: dict[str, dict[str, list[EpisodeResult]]]
    spec: EnvSpec
    seeds: tuple[int, ...]


def play(
    policies: Sequence[EvaluatedPolicy], protocol: Protocol, envs: EnvMaker, out: Path, console: Console
) -> Played:
    """Play what is not yet on disk.

    Args:
        policies: teacher first, student last.
        protocol: seeds and presets.
        envs: makes the vector envs.
        out: folder of records.
        console: for progress.
    """
    results: dict[str, dict[str, list[EpisodeResult]]] = {}
    spec = policies[0].policy.spec
    with progress_bars(console, "{task.fields[successes]}") as progress:
        for preset in protocol.realism:
            with _KeptEnv(envs, protocol, preset) as kept:
                players = [_Player(evaluated, kept, protocol, out, progress) for evaluated in policies]
                results[preset] = {player.name: player.play(protocol.seeds) for player in players}
            spec = kept.spec or spec
    return Played(results, spec, protocol.seeds)


def play_in_blocks(
    policies: Sequence[EvaluatedPolicy],
    protocol: Protocol,
    envs: EnvMaker,
    out: Path,
    console: Console,
    block: int,
    decided: Callable[[Mapping[str, Sequence[EpisodeResult]]], bool],
) -> Played:
    """Play all policies on a block of seeds before the next one, until it is decided or the seeds are used up.

    What is not yet on disk is played; where an earlier call was stopped, it ends at the same block.

    Args:
        policies: teacher first, student last.
        protocol: all seeds that may be played, and one preset.
        envs: makes the vector envs.
        out: folder of records.
        console: for progress.
        block: seeds of a block.
        decided: policy -> its results so far, in the order of the seeds; whether to stop.
    """
    (preset,) = protocol.realism
    results: dict[str, list[EpisodeResult]] = {evaluated.name: [] for evaluated in policies}
    with progress_bars(console, "{task.fields[successes]}") as progress, _KeptEnv(envs, protocol, preset) as kept:
        players = [_Player(evaluated, kept, protocol, out, progress) for evaluated in policies]
        for start in range(0, len(protocol.seeds), block):
            for player in players:
                results[player.name] += player.play(protocol.seeds[start : start + block])
            if decided(results):
                break
        spec = kept.spec or policies[0].policy.spec
    return Played({preset: results}, spec, protocol.seeds[: start + block])


class _Player:
    """Plays one policy under one preset, what is on disk already left out.

    Args:
        evaluated: the policy.
        kept: makes its env.
        protocol: all seeds, for the progress bar, and how to play.
        out: folder of records.
        progress: where its bar is shown, from its first episode on.
    """

    def __init__(
        self, evaluated: EvaluatedPolicy, kept: _KeptEnv, protocol: Protocol, out: Path, progress: Progress
    ) -> None:
        self.name = evaluated.name
        self._evaluated, self._kept, self._protocol, self._progress = evaluated, kept, protocol, progress
        self._file = log_file(out, kept.preset, evaluated.name)
        self._bar: Any = None
        self._played = self._won = 0

    def play(self, seeds: Sequence[int]) -> list[EpisodeResult]:
        """Return the results of `seeds` in their order; those that are not on disk are played first."""
        with EpisodeLog(self._file) as log:
            missing = [s for s in seeds if s not in log]
            self._show(log[s] for s in seeds if s in log)
            if missing:
                env = self._kept.env_for(self._evaluated)

                def record(result: EpisodeResult) -> None:
                    log.append(result)
                    self._show([result])

                with torch_threads(self._protocol.threads):  # more fight the workers for the cores
                    rollout(
                        env, self._evaluated.policy, missing, on_episode=record, to_the_end=self._protocol.to_the_end
                    )
            return [log[s] for s in seeds]

    def _show(self, results: Iterable[EpisodeResult]) -> None:
        for result in results:
            self._played += 1
            self._won += result.success
        if self._bar is None:
            title = self.name if self._protocol.realism == (CLEAN,) else f"{self._kept.preset}: {self.name}"
            self._bar = self._progress.add_task(title, total=len(self._protocol.seeds), successes="")
        self._progress.update(self._bar, completed=self._played, successes=_successes(self._won))


def log_file(out: Path, preset: str, policy: str) -> Path:
    """Return the file of one policy's episodes under one realism preset."""
    folder = out / "episodes" if preset == CLEAN else out / "episodes" / slug(preset)
    return folder / f"{slug(policy)}.jsonl"


class _KeptEnv:
    """Keeps one vector env alive across policies that exchange the same chunks: workers start slowly."""

    def __init__(self, envs: EnvMaker, protocol: Protocol, preset: str) -> None:
        self._envs, self._protocol, self.preset = envs, protocol, preset
        self._env: RestartableEnv | None = None
        self._shape: tuple[Any, ...] = ()
        self.spec: EnvSpec | None = None

    def env_for(self, evaluated: EvaluatedPolicy) -> RestartableEnv:
        """Return an env that plays the policy's chunks, the one at hand where it does."""
        policy = evaluated.policy
        chunk, forms = policy.chunk, policy.spec.obs.request(policy.keys)
        shape = (chunk.n_obs_steps, chunk.n_action_steps, policy.keys, forms)
        if self._env is None or shape != self._shape:
            self._close()
            rows = self._protocol.num_envs
            self._env = RestartableEnv(lambda: self._envs.for_policy(policy, rows, self.preset))
            self._shape = shape
        self.spec = self._env.env.env_spec
        env_name = f"environment {self.spec.env_id}"
        require_compatible(self.spec, policy.spec, env_name, f"checkpoint {evaluated.checkpoint}", policy.keys)
        return self._env

    def _close(self) -> None:
        if self._env is not None:
            self._env.close()
            self._env = None

    def __enter__(self) -> _KeptEnv:
        return self

    def __exit__(self, *exc: object) -> None:
        self._close()


def _successes(count: int) -> str:
    return f"{count} success{'' if count == 1 else 'es'}"
