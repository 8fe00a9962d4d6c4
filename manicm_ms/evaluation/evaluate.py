"""Evaluate policies on the same held-out seeds: from checkpoints to a report, one stage after another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.decided import StoppingRule, seal
from manicm_ms.evaluation.eval_info import write_exports
from manicm_ms.evaluation.latency import stored_or_measured
from manicm_ms.evaluation.origins import remarks
from manicm_ms.evaluation.play import EnvMaker, Played, env_maker, play, play_in_blocks
from manicm_ms.evaluation.policies import load_policies, require_playable, with_users
from manicm_ms.evaluation.protocol import CLEAN, OBS_PRESET, EvaluatedPolicy, Protocol, seeds_from
from manicm_ms.evaluation.records import claimed_folder
from manicm_ms.evaluation.report import write_report
from manicm_ms.evaluation.request import command_of, identity_of
from manicm_ms.evaluation.results import compile_results
from manicm_ms.evaluation.video import film_pair
from manicm_ms.machine.devices import resolve_device
from manicm_ms.paths import write_json
from manicm_ms.progress import working
from manicm_ms.sensing.realism import parse_presets

if TYPE_CHECKING:
    from manicm_ms.spec import EnvSpec


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
    rule: StoppingRule | None = None,
    policies: Sequence[str] = (),
    colors: bool = False,
    command: str | None = None,
    console: Console | None = None,
) -> dict[str, Any]:
    """Evaluate checkpoints on the same `episodes` held-out seeds and write results.json, report.md and report.html.

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
        rule: when to stop before the last seed; None plays them all.
        policies: FILE.py:FUNCTION of each policy of the user's own, behind the checkpoints; see `UserPolicy`.
        colors: give policies of the user's own coloured clouds; beside checkpoints they get the first one's clouds.
        command: the command line to print in the report; None writes the equivalent of this call.
        console: where progress is shown; None is standard output.

    Returns what results.json holds. Raises ManicmError: a name, a checkpoint or a folder that does not fit, no space.
    """
    from manicm_ms.envs.backends import resolve_backend
    from manicm_ms.envs.env_request import EnvRequest
    from manicm_ms.envs.simulator import ENVS, SimulatorConfig

    entry, seeds = ENVS.get(env_id), seeds_from(seed, episodes)
    presets, rows = parse_presets(realism), _rows(num_envs, episodes)
    where, device = resolve_backend(backend, entry), str(resolve_device(device))
    env = EnvRequest(env_id, where, colors=colors, realism=realism, camera=camera, obs_preset=obs_preset)
    env.require_offered()
    protocol = Protocol(env_id, seeds, rows, threads, repetitions, videos, presets, to_the_end, entry.seed_limit)
    offered = SimulatorConfig(obs_preset=obs_preset, colors=colors).specialise(entry.spec)
    evaluated = _policies(checkpoints, policies, device, control, offered, () if allow_seen_seeds else seeds)
    identity = identity_of(protocol, evaluated, env, device, rule)
    command = command or command_of(checkpoints, policies, env, episodes, seed, out, allow_seen_seeds, to_the_end, rule)
    return evaluate_policies(evaluated, protocol, env_maker(env), out, identity, command, console or Console(), rule)


def _policies(
    checkpoints: Sequence[Path],
    sources: Sequence[str],
    device: str,
    control: bool,
    offered: EnvSpec,
    held_out: Sequence[int],
) -> list[EvaluatedPolicy]:
    """Return the policies of the checkpoints and those of the user's own, all of which can play what is `offered`."""
    loaded = load_policies(checkpoints, device, control)
    require_playable(loaded, offered, held_out)
    return with_users(loaded, sources, offered)


def _rows(num_envs: int | None, episodes: int) -> int:
    """Return how many rows play at once; raise ConfigError where there is no episode to play."""
    from manicm_ms.envs.backends import default_num_envs

    if episodes < 1:
        raise ConfigError(f"--episodes must be at least 1, got {episodes}")
    return min(default_num_envs() if num_envs is None else num_envs, episodes)


def evaluate_policies(
    policies: Sequence[EvaluatedPolicy],
    protocol: Protocol,
    envs: EnvMaker,
    out: Path,
    request: Mapping[str, Any],
    command: str,
    console: Console,
    rule: StoppingRule | None = None,
) -> dict[str, Any]:
    """Evaluate loaded policies; see `evaluate`, which loads them and makes real environments.

    Args:
        policies: teacher first, student last.
        protocol: seeds and sizes.
        envs: makes the vector envs.
        out: folder of records and report.
        request: plain JSON values that identify this evaluation in `out`.
        command: the command line that reproduces it.
        console: where progress is shown.
        rule: when to stop before the last seed.
    """
    if rule is not None:
        rule.require_possible(policies, protocol)
    with claimed_folder(out, request):
        plan = {} if rule is None else rule.plan(protocol, policies, request)
        if rule is not None:
            seal(plan, out)
        for remark in remarks(policies, protocol.env_id, protocol.seeds):
            console.print(remark, style="yellow", highlight=False, markup=False, soft_wrap=True)
        with working(console, "time the decisions"):
            latencies = stored_or_measured(
                {p.name: p.policy for p in policies}, out / "latency.json",
                repetitions=protocol.repetitions, threads=protocol.threads,
            )  # fmt: skip
        played = _play(policies, protocol, envs, out, console, rule)
        protocol = replace(protocol, seeds=played.seeds)
        results = compile_results(policies, protocol, played, latencies, command, envs.conditions)
        if rule is not None:
            episodes = played.by_preset[protocol.realism[0]]
            results["until_decided"] = rule.outcome(plan, episodes[policies[0].name], episodes[policies[-1].name])
        _write(results, out)  # before filming, which may fail or be stopped
        main, fps = played.by_preset[protocol.realism[0]], played.spec.action.control_hz
        results["videos"] = film_pair(policies, protocol, envs, out, main, fps, console)
        _write(results, out)
    return results


def _play(
    policies: Sequence[EvaluatedPolicy],
    protocol: Protocol,
    envs: EnvMaker,
    out: Path,
    console: Console,
    rule: StoppingRule | None,
) -> Played:
    if rule is None:
        return play(policies, protocol, envs, out, console)
    first, last = policies[0].name, policies[-1].name
    return play_in_blocks(
        policies, protocol, envs, out, console, rule.block, lambda r: rule.decided(r[first], r[last])
    )  # fmt: skip


def _write(results: Mapping[str, Any], out: Path) -> None:
    write_json(out / "results.json", results)
    write_exports(results, out)
    write_report(results, out)
