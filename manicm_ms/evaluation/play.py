"""Plays every policy on every seed under every preset, what is on disk already left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from manicm_ms.spec import AGENT_POS, EnvSpec, require_compatible

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
        forms = policy.spec.obs.request(policy.keys)
        return request.vec_env(n, realism=preset, obs=policy.keys, chunk=policy.chunk, **forms)

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
    """

    by_preset: dict[str, dict[str, list[EpisodeResult]]]
    spec: EnvSpec


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
                results[preset] = {
                    evaluated.name: _play_policy(
                        evaluated, kept, protocol, log_file(out, preset, evaluated.name), progress
                    )
                    for evaluated in policies
                }
            spec = kept.spec or spec
    return Played(results, spec)


def _play_policy(
    evaluated: EvaluatedPolicy, kept: _KeptEnv, protocol: Protocol, file: Path, progress: Progress
) -> list[EpisodeResult]:
    """Play what one policy has not yet played; return its results in the order of the seeds."""
    with EpisodeLog(file) as log:
        missing = [s for s in protocol.seeds if s not in log]
        done = len(protocol.seeds) - len(missing)
        title = evaluated.name if protocol.realism == (CLEAN,) else f"{kept.preset}: {evaluated.name}"
        bar = progress.add_task(title, total=len(protocol.seeds), completed=done, successes="")
        if missing:
            env = kept.env_for(evaluated)
            with torch_threads(protocol.threads):  # more fight the workers for the cores
                rollout(
                    env, evaluated.policy, missing, on_episode=_recorder(log, progress, bar),
                    to_the_end=protocol.to_the_end,
                )  # fmt: skip
        results = [log[s] for s in protocol.seeds]
        progress.update(bar, successes=_successes(sum(e.success for e in results)))
    return results


def log_file(out: Path, preset: str, policy: str) -> Path:
    """Return the file of one policy's episodes under one realism preset."""
    folder = out / "episodes" if preset == CLEAN else out / "episodes" / slug(preset)
    return folder / f"{slug(policy)}.jsonl"


def _recorder(log: EpisodeLog, progress: Progress, bar: Any) -> Callable[[EpisodeResult], None]:
    successes = 0

    def record(result: EpisodeResult) -> None:
        nonlocal successes
        log.append(result)
        successes += result.success
        progress.update(bar, advance=1, successes=_successes(successes))

    return record


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
