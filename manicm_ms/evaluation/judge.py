"""Evaluate a teacher and its student on the same fresh seeds: roll-outs, control, latency, videos, report."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from rich.console import Console
from rich.progress import Progress

from manicm_ms.errors import ConfigError, OutputExistsError
from manicm_ms.evaluation.contenders import Contender, load_contenders, require_made_for
from manicm_ms.evaluation.latency import Latency, measure_latency
from manicm_ms.evaluation.origins import remarks, require_unseen
from manicm_ms.evaluation.protocol import CLEAN, Conditions, Protocol
from manicm_ms.evaluation.records import EpisodeLog, claimed_folder
from manicm_ms.evaluation.report import screen_lines, summary_tables, write_report
from manicm_ms.evaluation.request import OBS_PRESET, command_of, request_of
from manicm_ms.evaluation.results import compile_results, realism_entry
from manicm_ms.evaluation.rollout import EpisodeResult, RestartableEnv, rollout
from manicm_ms.evaluation.video import Take, choose_seeds, film
from manicm_ms.machine.devices import resolve_device, torch_threads
from manicm_ms.paths import write_json
from manicm_ms.progress import progress_bars, working
from manicm_ms.sensing.camera_model import CameraModel, read_camera
from manicm_ms.sensing.realism import REALISM, RealismSample, parse_presets
from manicm_ms.spec import AGENT_POS, ChunkSpec, EnvSpec, require_compatible

if TYPE_CHECKING:
    from manicm_ms.envs.vec_env import VecEnv
    from manicm_ms.policies.base import Policy


class EnvMaker(NamedTuple):
    """Makes the vector envs that an evaluation needs.

    Attributes:
        for_policy: (policy, num_envs, realism preset) -> env that exchanges histories and chunks as the policy does.
        for_film: (num_envs, realism preset) -> env without a chunk, with `render_video_frames`.
        conditions: (realism preset, seed) -> what is drawn for that episode beside its scene.
    """

    for_policy: Callable[[Policy, int, str], VecEnv]
    for_film: Callable[[int, str], VecEnv]
    conditions: Conditions = lambda preset, seed: {}


def evaluate(
    checkpoints: Sequence[Path],
    env_id: str,
    episodes: int,
    seed: int,
    out: Path,
    *,
    num_envs: int | None = None,
    backend: str = "auto",
    device: str = "cpu",
    control: bool = True,
    videos: int = 4,
    threads: int = 1,
    repetitions: int = 50,
    realism: str = CLEAN,
    camera: Path | None = None,
    obs_preset: str = OBS_PRESET,
    allow_seen_seeds: bool = False,
    to_the_end: bool = True,
    command: str | None = None,
    console: Console | None = None,
) -> dict[str, Any]:
    """Evaluate checkpoints on the same `episodes` fresh seeds and write results.json, report.md and report.html.

    The same call goes on where an earlier one was stopped: finished episodes are on disk and are not played again.

    Args:
        checkpoints: checkpoint folders, the teacher first and the student last; one alone is evaluated without a pair.
        env_id: environment, for example "ur3e/slide-block".
        episodes: seeds seed, seed + 1, ..., seed + episodes - 1.
        seed: the first seed, beyond those of the demonstrations.
        out: folder of records and report.
        num_envs: rows in parallel; None takes the machine's cores.
        backend: of `make_vec`.
        device: of the policies: "auto", "cpu", "cuda", "cuda:1".
        control: add the teacher run in one step, without distillation, between teacher and student.
        videos: seeds filmed for teacher and student.
        threads: torch threads while policies act and latency is measured.
        repetitions: timed decisions per policy.
        realism: one or more presets, separated by commas: all policies play the same seeds under each of them.
        camera: YAML file of the cell's depth camera, as in `make_vec`.
        obs_preset: as in `make_vec`; the one of the demonstrations that the policies learnt from.
        allow_seen_seeds: evaluate on seeds of a checkpoint's own demonstrations and say so; refused otherwise.
        to_the_end: play on after a success that is certain, so that success at the end is known; False saves time.
        command: the command line to print in the report; None writes the equivalent of this call.
        console: where progress and table are printed; None is standard output.

    Returns what results.json holds.

    Raises ManicmError: an unknown name, a checkpoint that does not fit, another evaluation in `out`, a full disk.
    """
    from manicm_ms.envs.simulator import ENVS, SimulatorConfig
    from manicm_ms.envs.vec_env import resolve_backend

    entry, seeds, presets = ENVS.get(env_id), tuple(range(seed, seed + episodes)), parse_presets(realism)
    rows = _rows(num_envs, episodes)
    protocol = Protocol(env_id, seeds, rows, threads, repetitions, videos, presets, to_the_end, entry.seed_limit)
    model = None if camera is None else read_camera(camera)
    backend = resolve_backend(backend, entry)
    for preset in presets:
        entry.require(SimulatorConfig(realism=REALISM.get(preset), camera=model, obs_preset=obs_preset))
    contenders = load_contenders(checkpoints, device := str(resolve_device(device)), control)
    if not allow_seen_seeds:
        require_unseen(contenders, env_id, seeds)
    require_made_for(SimulatorConfig(obs_preset=obs_preset).specialise(entry.spec), contenders)
    request = request_of(protocol, contenders, backend, device, model, obs_preset)
    asked = (checkpoints, env_id, episodes, seed, out, realism, camera, obs_preset, allow_seen_seeds, to_the_end)
    makers = env_maker(env_id, backend, model, obs_preset)
    return judge(contenders, protocol, makers, out, request, command or command_of(*asked), console or Console())


def _rows(num_envs: int | None, episodes: int) -> int:
    """Return how many rows play at once; raise ConfigError where there is no episode to play."""
    from manicm_ms.envs.vec_env import default_num_envs

    if episodes < 1:
        raise ConfigError(f"--episodes must be at least 1, got {episodes}")
    return min(default_num_envs() if num_envs is None else num_envs, episodes)


def env_maker(env_id: str, backend: str, camera: CameraModel | None = None, obs_preset: str = OBS_PRESET) -> EnvMaker:
    """Return what makes the real environments of `env_id`; see `evaluate` for the arguments."""
    from manicm_ms.envs.simulator import ENVS
    from manicm_ms.envs.vec_env import make_vec

    def for_policy(policy: Policy, n: int, preset: str) -> VecEnv:
        obs = policy.spec.obs
        return make_vec(
            env_id, n, backend, chunk=policy.chunk, num_points=obs.num_points, colors=obs.point_channels == 6,
            realism=preset, camera=camera, obs_preset=obs_preset,
        )  # fmt: skip

    def for_film(n: int, preset: str) -> VecEnv:
        return make_vec(
            env_id, n, backend, obs=(AGENT_POS,), video=True, realism=preset, camera=camera, obs_preset=obs_preset
        )

    def conditions(preset: str, seed: int) -> RealismSample:
        return ENVS.get(env_id).conditions(REALISM.get(preset), seed)

    return EnvMaker(for_policy, for_film, conditions)


def judge(
    contenders: Sequence[Contender],
    protocol: Protocol,
    envs: EnvMaker,
    out: Path,
    request: Mapping[str, Any],
    command: str,
    console: Console,
) -> dict[str, Any]:
    """Evaluate loaded policies; see `evaluate`, which loads them and makes real environments.

    Args:
        contenders: teacher first, student last.
        protocol: seeds and sizes.
        envs: makes the vector envs.
        out: folder of records and report.
        request: plain JSON values that identify this evaluation in `out`.
        command: the command line that reproduces it.
        console: where progress and table are printed.
    """
    with claimed_folder(out, request):
        for remark in remarks(contenders, protocol.env_id, protocol.seeds):
            console.print(remark, style="yellow", highlight=False, markup=False, soft_wrap=True)
        with working(console, "time the decisions"):
            latencies = _latencies(contenders, protocol, out / "latency.json")
        by_preset, spec = _play(contenders, protocol, envs, out, console)
        episodes = by_preset[protocol.realism[0]]
        results = compile_results(contenders, protocol, episodes, latencies, command, envs.conditions)
        if protocol.realism != (CLEAN,):
            results["realism"] = realism_entry(contenders, protocol, by_preset, envs.conditions)
        results["success_rule"] = spec.success_rule
        results["videos"] = []
        _write(results, out)  # before filming, which may fail or be stopped
        results["videos"] = _film(contenders, protocol, envs, out, episodes, spec, console)
        _write(results, out)
    for table in summary_tables(results):
        console.print(table)
    for sentence in screen_lines(results):
        console.print(sentence, highlight=False, markup=False)
    console.print(f"report: {out / 'report.html'}", soft_wrap=True)
    return results


def _write(results: Mapping[str, Any], out: Path) -> None:
    write_json(out / "results.json", results)
    write_report(results, out)


def _latencies(contenders: Sequence[Contender], protocol: Protocol, path: Path) -> dict[str, Latency]:
    """Measure each contender, or read what an earlier call of the same evaluation measured.

    Before any worker process exists, so that the machine is quiet.
    """
    if path.exists():
        stored = _stored_latencies(path)
        wanted = (protocol.threads, protocol.repetitions)
        if set(stored) == {c.name for c in contenders} and all((s.threads, s.n) == wanted for s in stored.values()):
            return stored
    measured = measure_latency(
        {c.name: c.policy for c in contenders}, repetitions=protocol.repetitions, threads=protocol.threads
    )
    write_json(path, {name: latency._asdict() for name, latency in measured.items()})
    return measured


def _stored_latencies(path: Path) -> dict[str, Latency]:
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return {name: Latency(**fields) for name, fields in stored.items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise OutputExistsError(f"{path} is damaged: delete it and latency is measured again") from error


def _play(
    contenders: Sequence[Contender], protocol: Protocol, envs: EnvMaker, out: Path, console: Console
) -> tuple[dict[str, dict[str, list[EpisodeResult]]], EnvSpec]:
    """Play what is not yet on disk.

    Returns:
        preset -> policy -> results in the order of the seeds, and the env's spec.
    """
    results: dict[str, dict[str, list[EpisodeResult]]] = {}
    spec = contenders[0].policy.spec
    with _progress(console) as progress:
        for preset in protocol.realism:
            with _Bench(envs, protocol, preset) as bench:
                results[preset] = {
                    contender.name: _play_policy(
                        contender, bench, protocol, log_file(out, preset, contender.name), progress
                    )
                    for contender in contenders
                }
            spec = bench.spec or spec
    return results, spec


def _play_policy(
    contender: Contender, bench: _Bench, protocol: Protocol, file: Path, progress: Progress
) -> list[EpisodeResult]:
    """Play what one policy has not yet played on the bench; return its results in the order of the seeds."""
    with EpisodeLog(file) as log:
        missing = [s for s in protocol.seeds if s not in log]
        done = len(protocol.seeds) - len(missing)
        title = contender.name if protocol.realism == (CLEAN,) else f"{bench.preset}: {contender.name}"
        bar = progress.add_task(title, total=len(protocol.seeds), completed=done, successes="")
        if missing:
            home = bench.home(contender)
            with torch_threads(protocol.threads):  # more fight the workers for the cores
                rollout(
                    home, contender.policy, missing, on_episode=_recorder(log, progress, bar),
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


class _Bench:
    """Keeps one vector env alive across contenders that exchange the same chunks: workers start slowly."""

    def __init__(self, envs: EnvMaker, protocol: Protocol, preset: str) -> None:
        self._envs, self._protocol, self.preset = envs, protocol, preset
        self._home: RestartableEnv | None = None
        self._shape: tuple[int, ...] = ()
        self.spec: EnvSpec | None = None

    def home(self, contender: Contender) -> RestartableEnv:
        """Return an env that plays the contender's chunks, the one at hand where it does."""
        policy = contender.policy
        shape = _exchange(policy.chunk, policy.spec)
        if self._home is None or shape != self._shape:
            self._close()
            rows = self._protocol.num_envs
            self._home = RestartableEnv(lambda: self._envs.for_policy(policy, rows, self.preset))
            self._shape = shape
        self.spec = self._home.env.env_spec
        env_name = f"environment {self.spec.env_id}"
        require_compatible(self.spec, policy.spec, env_name, f"checkpoint {contender.checkpoint}")
        return self._home

    def _close(self) -> None:
        if self._home is not None:
            self._home.close()
            self._home = None

    def __enter__(self) -> _Bench:
        return self

    def __exit__(self, *exc: object) -> None:
        self._close()


def _exchange(chunk: ChunkSpec, spec: EnvSpec) -> tuple[int, ...]:
    return (chunk.n_obs_steps, chunk.n_action_steps, spec.obs.num_points, spec.obs.point_channels)


def _film(
    contenders: Sequence[Contender],
    protocol: Protocol,
    envs: EnvMaker,
    out: Path,
    episodes: Mapping[str, Sequence[EpisodeResult]],
    spec: EnvSpec,
    console: Console,
) -> list[dict[str, Any]]:
    """Film teacher and student on the same seeds; return what was filmed, with the files relative to `out`."""
    cast = [contenders[0], contenders[-1]] if len(contenders) > 1 else [contenders[0]]
    seeds = choose_seeds(episodes[cast[0].name], episodes[cast[-1].name], protocol.videos)
    scenes = [(seed, contender) for seed in seeds for contender in cast]
    by_seed = {c.name: {e.seed: e for e in episodes[c.name]} for c in cast}
    entries, takes = [], []
    for seed, contender in scenes:
        file = f"videos/{slug(contender.name)}-{seed}.mp4"
        episode = by_seed[contender.name][seed]
        entries.append({"seed": seed, "policy": contender.name, "success": episode.success, "file": file})
        if not (out / file).exists():
            takes.append(Take(episode, out / file))
    if not takes:
        return entries
    try:
        with _progress(console) as progress:
            bar = progress.add_task("videos", total=len(takes), successes="")
            vec_env = envs.for_film(min(protocol.num_envs, len(takes)), protocol.realism[0])
            try:
                for take, success in film(vec_env, takes, spec.action.control_hz):
                    progress.update(bar, advance=1)
                    if success != take.episode.success:  # a simulation that does not repeat itself
                        take.path.unlink()
            finally:
                vec_env.close()
    except Exception as error:  # a report without pictures is better than none, whatever the renderer raised
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        console.print(f"not all videos were made: {reason}", style="yellow", markup=False, soft_wrap=True)
    return [entry for entry in entries if (out / str(entry["file"])).exists()]


def _successes(count: int) -> str:
    return f"{count} success{'' if count == 1 else 'es'}"


def _progress(console: Console) -> Progress:
    return progress_bars(console, "{task.fields[successes]}")


def slug(name: str) -> str:
    """Return `name` as a file name."""
    return re.sub(r"[^\w-]+", "-", name).strip("-")
