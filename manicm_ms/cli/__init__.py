"""The command line: `manicm-ms COMMAND`; each command imports only what it needs.

What a user can cause ends in one line on standard error and exit status 2. Commands that do long work go on where they
were stopped when the same command is given again.
"""

from __future__ import annotations

import errno
import shlex
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from manicm_ms import signals
from manicm_ms.cli.counts import AtLeast, Count, CountOrNone, OptionalCount, Seed, checked
from manicm_ms.cli.messages import PROGRAM, warnings_in_one_line
from manicm_ms.errors import ConfigError, ManicmError, UnknownNameError
from manicm_ms.paths import is_disk_full, without_temporaries

Backend = Literal["auto", "cpu", "gpu"]
Command = Callable[..., int | None]
USER_ERROR, INTERRUPTED = 2, 130
_RESUMABLE = ("collect", "train", "distill", "evaluate", "benchmark")
_CHECK_THE_PATH = "check the paths on the command line"
_REMEDIES = {
    errno.EACCES: "name a place that you may read and write, or change its permissions",
    errno.EPERM: "name a place that you may read and write, or change its permissions",
    errno.EROFS: "name a place on a file system that can be written to",
    errno.ENOENT: "make the folder it lies in, or correct the path",
    errno.ENOTDIR: "a part of the path is a file: correct the path",
    errno.EISDIR: "this is a folder where a file is wanted: correct the path",
    errno.EEXIST: "name another place, or move away what stands there",
}


def list_command(kind: tyro.conf.Positional[Literal["envs", "policies", "presets"]], tag: str | None = None) -> None:
    """List what is registered: environments, policies or training presets.

    Args:
        kind: what to list.
        tag: only the environments that carry this tag.
    """
    from manicm_ms.cli import listing

    if tag is not None and kind != "envs":
        raise ConfigError(f"--tag selects environments, {kind} have no tags: use 'list envs --tag {tag}' or drop --tag")
    tables = {"envs": lambda: listing.envs(tag), "policies": listing.policies, "presets": listing.presets}
    where = listing.console()
    for table in tables[kind]():
        listing.show(table, where)


def check_command(env_ids: tyro.conf.Positional[tuple[str, ...]], backend: Backend = "auto") -> int:
    """Check that environments keep the promises of the vector interface; exit status 1 where one is broken.

    Args:
        env_ids: environment ids.
        backend: where to simulate.
    """
    from manicm_ms.envs.conformance import Property, check_vec_env

    def show(result: Property) -> None:
        print(f"  {'ok  ' if result.passed else 'FAIL'} {result.name}{result.detail and ': ' + result.detail}")

    broken = 0
    for env_id in _at_least_one(env_ids, "environment id"):
        print(env_id, flush=True)
        broken += sum(not result.passed for result in check_vec_env(env_id, backend, on_result=show))
    return 1 if broken else 0


def collect_command(
    env_id: tyro.conf.Positional[str | None] = None,
    out: Path | None = None,
    tag: str | None = None,
    episodes: Count = 10,
    num_envs: OptionalCount = None,
    seed: Seed = 0,
    style: str | None = None,
    backend: Backend = "auto",
    colors: bool = False,
    extras: tuple[str, ...] = (),
    tail_steps: Annotated[int | None, AtLeast(0)] = None,
    realism: str = "clean",
    camera: Path | None = None,
    obs_preset: str = "manicm_ms",
) -> None:
    """Collect demonstrations of a task's expert into a store, in parallel; the same command goes on after a kill.

    Args:
        env_id: environment id; or name a tag.
        out: the store, a folder, by default data/ENV_ID.zarr; with --tag the folder of the stores, by default data.
        tag: collect in every environment that carries this tag, one after another.
        episodes: solved episodes wanted.
        num_envs: environments that play at once; by default one a core. The data does not depend on it.
        seed: first seed; seeds count up from it.
        style: style of the expert, its default one if not given.
        backend: where to simulate.
        colors: store rgb beside xyz.
        extras: optional fields to store: image, depth, privileged_state.
        tail_steps: control steps kept after the first success; by default the task's own number.
        realism: clean, d435i or d435i+dr: camera errors and physical values drawn for each episode.
        camera: YAML file of the cell's depth camera, as 'manicm-ms calibrate' writes it.
        obs_preset: manicm_ms, or dp3 for clouds as the public DP3 wrapper makes them.
    """
    from manicm_ms.cli.collecting import collect_one, collect_tagged
    from manicm_ms.envs.vec_env import default_num_envs

    options = {
        "num_envs": num_envs or default_num_envs(), "seed": seed, "style": style, "backend": backend,
        "colors": colors, "extras": extras, "tail_steps": tail_steps, "realism": realism, "camera": camera,
        "obs_preset": obs_preset,
    }  # fmt: skip
    if (env_id is None) == (tag is None):
        raise ConfigError("name one environment id, or --tag and a tag ('manicm-ms list envs' shows both)")
    if env_id is not None:
        collect_one(env_id, out, episodes, options)
    else:
        collect_tagged(str(tag), out, episodes, options)


def experts_command(
    action: tyro.conf.Positional[Literal["fetch", "list"]],
    names: tyro.conf.Positional[tuple[str, ...]] = (),
    from_: Annotated[Path | None, tyro.conf.arg(name="from")] = None,
) -> None:
    """Get the weights of published experts from their public source, checked by SHA-256, or list those there are.

    Args:
        action: what to do.
        names: of experts, as in adroit/door; all of them by default.
        from_: a folder that holds door.npz and so on with their LICENSE, instead of the public source.
    """
    from manicm_ms.cli.collecting import experts

    experts(action, names, from_)


def inspect_command(
    store: tyro.conf.Positional[Path],
    html: Path | None = None,
    json: bool = False,
) -> int:
    """Summarise a store of demonstrations and name its problems; exit status 1 where there are any.

    Args:
        store: the store.
        html: where to write a page with a turnable point cloud; by default beside the store.
        json: print the summary as JSON and write no page.
    """
    from manicm_ms.demos.inspect import inspect

    page = None if json else html or store.with_suffix(".html")
    return inspect(store, html=page, as_json=json)


def convert_command(
    store: tyro.conf.Positional[Path],
    out: Path,
    to: str | None = None,
    from_: Annotated[str | None, tyro.conf.arg(name="from")] = None,
    task: str | None = None,
    env: str | None = None,
    num_points: OptionalCount = None,
    colors: bool = False,
    frame: str | None = None,
    control_hz: float | None = None,
    cloud_scale: float | None = None,
    depth_scale: float | None = None,
    action_scale: tuple[float, ...] = (),
) -> None:
    """Convert a store for other tools (--to maniskill, lerobot, minari), or theirs into one (--from dp3).

    Args:
        store: what to convert.
        out: the folder to make.
        to: format to write.
        from_: format to read; --out is then a store of ours.
        task: with --to, the task in words, for formats that carry instructions.
        env: with --from, the environment that the data is of; without it the specs are made of the shapes.
        num_points: with --from, points kept of each cloud.
        colors: with --from, keep rgb beside xyz.
        frame: with --from and no --env, frame of the clouds: world (if not given) or robot_base.
        control_hz: with --from and no --env, actions per second; 10 if not given.
        cloud_scale: with --from, metres of a unit of the clouds: 0.001 for millimetres.
        depth_scale: with --from, metres of a unit of the depth images.
        action_scale: with --from, what actions are divided by to lie in [-1, 1]: one number, or one an entry.
    """
    from manicm_ms.cli.converting import convert_or_import

    reading = {
        "env": env, "num_points": num_points, "colors": colors or None, "frame": frame, "control_hz": control_hz,
        "cloud_scale": cloud_scale, "depth_scale": depth_scale, "action_scale": action_scale or None,
    }  # fmt: skip
    convert_or_import(store, out, to, from_, {"task": task}, reading)


def evaluate_command(
    checkpoints: tyro.conf.Positional[tuple[Path, ...]] = (),
    *,
    env: str,
    policy: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    out: Path = Path("runs/report"),
    episodes: Count = 100,
    seed: Seed = 100_000,
    num_envs: OptionalCount = None,
    backend: Backend = "auto",
    device: str = "cpu",
    control: bool = True,
    videos: CountOrNone = 4,
    threads: Count = 1,
    realism: str = "clean",
    camera: Path | None = None,
    obs_preset: str = "manicm_ms",
    allow_seen_seeds: bool = False,
    to_the_end: bool = True,
    colors: bool = False,
) -> int:
    """Evaluate policies on the same held-out seeds: success with intervals, paired difference, latency, report.

    Args:
        checkpoints: checkpoint folders, the teacher first and the student last.
        env: environment id.
        policy: a policy of your own, FILE.py:FUNCTION; may be repeated, and stand beside checkpoints.
        out: folder of results.json, report.md and report.html.
        episodes: held-out seeds, each played once by each policy.
        seed: first of them.
        num_envs: environments that play at once; by default one a core.
        backend: where to simulate.
        device: torch device of the policies.
        control: add the teacher run in one step, without distillation.
        videos: seeds filmed.
        threads: torch threads while policies act and latency is measured.
        realism: presets separated by commas, as in clean,d435i,d435i+dr: every policy plays the same seeds under each.
        camera: YAML file of the cell's depth camera, as 'manicm-ms calibrate' writes it.
        obs_preset: the one that the policies were trained with: manicm_ms or dp3.
        allow_seen_seeds: evaluate on seeds of a checkpoint's own demonstrations, which is refused otherwise.
        to_the_end: play on after a success that is certain, so that success at the last step is known too.
        colors: coloured clouds for policies of your own; beside checkpoints they get the first one's clouds.
    """
    from rich.console import Console

    from manicm_ms.evaluation.evaluate import evaluate
    from manicm_ms.evaluation.screen import show

    console = Console()
    results = evaluate(
        checkpoints, env, episodes, seed, out, num_envs=num_envs, backend=backend,
        device=device, control=control, videos=videos, threads=threads, realism=realism,
        camera=camera, obs_preset=obs_preset, allow_seen_seeds=allow_seen_seeds, to_the_end=to_the_end,
        policies=policy, colors=colors, command=this_command(), console=console,
    )  # fmt: skip
    return 0 if show(results, out, console) else 1


def benchmark_command(
    envs: str = "benchmark31",
    methods: str = "simple_dp3,one_step,manicm",
    seeds: str = "0,1,2",
    preset: str = "quick",
    out: Path = Path("runs/bench"),
    data: Path | None = None,
    demos: Count = 10,
    demo_seed: Seed = 0,
    colors: bool = False,
    obs_preset: str = "manicm_ms",
    episodes: Count = 50,
    eval_seed: Seed = 100_000,
    evaluations: CountOrNone = 0,
    evaluation_episodes: Count = 20,
    processes: OptionalCount = None,
    num_envs: Count = 2,
    device: str = "auto",
    ray: str | None = None,
    to_the_end: bool = False,
) -> int:
    """Run the grid task x method x seed and write the paper's main table; any number of these may run at once.

    Each job (collect, train or distil, evaluate) goes on where it was stopped when the same command is given again.

    Args:
        envs: environment ids and tags, separated by commas; 'manicm-ms list envs' shows both.
        methods: simple_dp3, dp3 (teachers), one_step (a teacher undistilled), manicm, manicm_4 (students), separated
            by commas; with two teachers, manicm:dp3 says of which.
        seeds: of the trainings, separated by commas.
        preset: recipe of teacher and student; 'manicm-ms list presets' shows them.
        out: folder of everything that is made.
        data: folder of the demonstrations, SUITE/TASK.zarr; by default OUT/data. What is missing is collected.
        demos: demonstrations to learn from.
        demo_seed: first seed of the demonstrations.
        colors: coloured clouds.
        obs_preset: manicm_ms, or dp3 for clouds and success as the public DP3 wrapper has them.
        episodes: fresh seeds that each trained policy plays.
        eval_seed: first of them.
        evaluations: evaluations during training, for the paper's mean of the five highest; 0: none.
        evaluation_episodes: episodes of each of those.
        processes: that work at once; by default one a core.
        num_envs: environments that play at once in each.
        device: torch device of trainings and policies; auto takes an accelerator where there is one.
        ray: address of a Ray cluster to work on instead ("auto", "local"); needs the extra ray and shared folders.
        to_the_end: play on after a success that is certain, so that success at the last step is known too.
    """
    from manicm_ms.benchmark.plan import Plan, parse_envs, parse_seeds, split_names
    from manicm_ms.benchmark.run import benchmark
    from manicm_ms.envs.vec_env import default_num_envs
    from manicm_ms.machine.devices import resolve_device

    plan = Plan(
        env_ids=parse_envs(envs), methods=tuple(split_names(methods)), seeds=parse_seeds(seeds), preset=preset, out=out,
        data=data or out / "data", demos=demos, demo_seed=demo_seed, colors=colors, obs_preset=obs_preset,
        episodes=episodes, eval_seed=eval_seed, evaluations=evaluations, evaluation_episodes=evaluation_episodes,
        num_envs=num_envs, device=str(resolve_device(device)), to_the_end=to_the_end,
    )  # fmt: skip
    results = benchmark(plan, processes=processes or default_num_envs(), ray=ray, command=this_command())
    return 1 if results["missing"] else 0


def cloud_command(
    depth: tyro.conf.Positional[Path],
    camera: Path,
    out: Path,
    env: str = "ur3e/slide-block",
    realism: str = "d435i",
    num_points: Count = 512,
    overwrite: bool = False,
) -> None:
    """Turn a recorded depth image into the cloud that a policy sees, exactly as the simulator makes its own.

    Args:
        depth: a PNG of one 16-bit channel, of the camera's native size, in its depth units.
        camera: camera file of the cell, as 'manicm-ms calibrate' writes it.
        out: where to write the points, metres, robot-base frame: NAME.ply or NAME.npy.
        env: environment whose workspace box crops the cloud.
        realism: preset whose crop floor applies; a real camera's errors lift the table above that of clean.
        num_points: points wanted.
        overwrite: replace the file where there is one.
    """
    from manicm_ms.cli.cloud import cloud

    cloud(depth, camera, out, env, realism, num_points, overwrite)


def calibrate_command(
    images: tyro.conf.Positional[Path],
    out: Path,
    poses: Path | None = None,
    intrinsics: Path | None = None,
    squares: tuple[int, int] = (5, 7),
    square_length: float = 0.030,
    marker_length: float = 0.022,
    dictionary: str = "4X4_50",
    legacy: bool = False,
    overwrite: bool = False,
) -> None:
    """Solve the pose of a fixed camera from images of a ChArUco board in the robot's hand; write the camera file.

    Args:
        images: folder of PNG or JPG images, all of one stream.
        out: camera file to write (YAML), for the tasks, 'manicm-ms cloud' and a real camera.
        poses: robot poses of the images, JSON or CSV; by default poses.json or poses.csv in the folder.
        intrinsics: camera file whose intrinsics hold; without it they are solved from the board.
        squares: squares in a row and in a column of the board.
        square_length: side of a square, metres, as measured on the print.
        marker_length: side of a marker, metres.
        dictionary: OpenCV's marker dictionary.
        legacy: the board was made by OpenCV before 4.6.
        overwrite: replace the camera file where there is one.
    """
    from manicm_ms.cli.calibration import progress, report
    from manicm_ms.cli.listing import console
    from manicm_ms.sensing.calibration import CharucoSpec, calibrate

    board = CharucoSpec(*squares, square_length, marker_length, dictionary, legacy)
    with progress() as on_image:
        solved = calibrate(
            images, board, out, poses=poses, intrinsics=intrinsics, overwrite=overwrite, on_image=on_image
        )
    report(solved, console())
    print(f"{out} written")


def board_command(
    out: Path = Path("board.pdf"),
    squares: tuple[int, int] = (5, 7),
    square_length: float = 0.030,
    marker_length: float = 0.022,
    dictionary: str = "4X4_50",
    legacy: bool = False,
    overwrite: bool = False,
) -> None:
    """Draw a ChArUco board for calibrate at its exact size, to be printed at 100 %.

    Args:
        out: NAME.pdf, NAME.svg or NAME.png.
        squares: squares in a row and in a column.
        square_length: side of a square, metres.
        marker_length: side of a marker, metres.
        dictionary: OpenCV's marker dictionary.
        legacy: the pattern of OpenCV before 4.6.
        overwrite: replace the file where there is one.
    """
    from manicm_ms.sensing.calibration import CharucoSpec, print_board

    board = CharucoSpec(*squares, square_length, marker_length, dictionary, legacy)
    paper = print_board(board, out, overwrite=overwrite)
    print(f"{out}: {board}; print it on {paper} at 100 % and measure a row of squares")


def doctor_command() -> int:
    """Say what this machine offers and lacks, each trouble with its remedy; exit status 1 where one is fatal."""
    from manicm_ms.machine.doctor import doctor

    return doctor()


_PLAIN: dict[str, Command] = {
    "list": list_command,
    "check": check_command,
    "collect": collect_command,
    "experts": experts_command,
    "inspect": inspect_command,
    "convert": convert_command,
    "evaluate": evaluate_command,
    "benchmark": benchmark_command,
    "calibrate": calibrate_command,
    "board": board_command,
    "cloud": cloud_command,
    "doctor": doctor_command,
}
# These depend on the preset that the command line names: its fields become options with its values as defaults.
_WITH_PRESET = {
    "train": "Train a diffusion teacher on demonstrations; the same command goes on after Ctrl-C or a kill.",
    "distill": "Distil a teacher into a one-step ManiCM student; the same command goes on after Ctrl-C or a kill.",
}
# Commands with commands of their own.
_GROUPS = {"bench": "Time environments, decisions, experts and sensors; 'manicm-ms bench --help' lists what."}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command and exit with its status.

    It is 0 good, 1 a check failed, 2 a user error, 130 stopped by Ctrl-C, 143 by SIGTERM, 129 by SIGHUP.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with signals.stoppable():
            code = _run(arguments)
    except ManicmError as error:
        code = _complain(str(error))
    except OSError as error:
        code = _complain(_explain(error))
    except KeyboardInterrupt as stop:
        goes_on = arguments[0] in _RESUMABLE if arguments else False
        print("stopped; the same command goes on from here" if goes_on else "stopped", file=sys.stderr)
        code = getattr(stop, "status", INTERRUPTED)
        signals.end_stopped(code)
    sys.exit(code or 0)


def _run(arguments: list[str]) -> int | None:
    if not arguments or arguments[0] in ("-h", "--help"):
        _overview()
        return 0 if arguments else USER_ERROR
    if arguments[0] == "--version":
        from manicm_ms import __version__

        print(__version__)
        return 0
    name, rest = arguments[0], arguments[1:]
    if name not in (*_PLAIN, *_WITH_PRESET, *_GROUPS):
        raise UnknownNameError("command", name, (*_PLAIN, *_WITH_PRESET, *_GROUPS))
    with warnings_in_one_line():
        if name in _GROUPS:
            from manicm_ms.cli import bench

            return bench.run(rest)
        return tyro.cli(
            checked(_command(name, rest)), prog=f"{PROGRAM} {name}", args=rest, config=(tyro.conf.OmitArgPrefixes,)
        )


def _command(name: str, arguments: list[str]) -> Command:
    if name in _PLAIN:
        return _PLAIN[name]
    from manicm_ms.cli import training  # torch and the presets: a second that the other commands need not wait

    return {"train": training.train_command, "distill": training.distill_command}[name](arguments)


def _overview() -> None:
    from manicm_ms.cli.listing import console

    print(f"usage: {PROGRAM} COMMAND ...   ('{PROGRAM} COMMAND --help' tells more)\n")
    plain = {name: (command.__doc__ or "").splitlines()[0] for name, command in _PLAIN.items()}
    width = console().width
    for name, summary in {**plain, **_WITH_PRESET, **_GROUPS}.items():
        print(textwrap.fill(f"  {name:<9} {summary}", width, subsequent_indent=" " * 12, break_on_hyphens=False))


def _explain(error: OSError) -> str:
    """Say which file is in trouble, why and what to try; raise `error` again where it is about no file and no disk."""
    if is_disk_full(error):
        return f"no space left on the disk ({error.filename or 'output'}): free some and give the same command"
    if error.filename is None:
        raise error
    return f"{error.filename}: {error.strerror or error}: {_REMEDIES.get(error.errno or 0, _CHECK_THE_PATH)}"


def _complain(message: str) -> int:
    print(f"{PROGRAM}: {without_temporaries(' '.join(message.split()))}", file=sys.stderr)
    return USER_ERROR


def _at_least_one(values: tuple[Any, ...], what: str) -> tuple[Any, ...]:
    if not values:
        raise ManicmError(f"name at least one {what}")
    return values


def this_command() -> str:
    """Return the command line as the user gave it, for provenance."""
    return shlex.join([PROGRAM, *sys.argv[1:]])
