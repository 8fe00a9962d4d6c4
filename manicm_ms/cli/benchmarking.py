"""`manicm-ms benchmark`: the grid task x method x seed."""

from __future__ import annotations

from pathlib import Path

from manicm_ms.cli.counts import Count, CountOrNone, OptionalCount, Seed
from manicm_ms.cli.options import this_command


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
        methods: separated by commas: what 'manicm-ms list policies' shows, and one_step (a teacher undistilled); with
            two teachers, manicm:dp3 says of which. simple_dp3_4 is simple_dp3 evaluated 4 times a decision. Brackets
            hold overrides, as --set takes them, separated by semicolons: 'simple_dp3[head.prediction_type=epsilon]'.
        seeds: of the trainings, separated by commas.
        preset: preset of teacher and student; 'manicm-ms list presets' shows them.
        out: folder of everything that is made.
        data: folder of the demonstrations, SUITE/TASK.zarr; by default OUT/data. What is missing is collected.
        demos: demonstrations to learn from.
        demo_seed: first seed of the demonstrations.
        colors: coloured clouds.
        obs_preset: manicm_ms, or dp3 for clouds and success as the public DP3 wrapper has them.
        episodes: held-out seeds that each trained policy plays.
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
    from manicm_ms.envs.backends import default_num_envs
    from manicm_ms.machine.devices import resolve_device

    plan = Plan(
        env_ids=parse_envs(envs), methods=tuple(split_names(methods)), seeds=parse_seeds(seeds), preset=preset, out=out,
        data=data or out / "data", demos=demos, demo_seed=demo_seed, colors=colors, obs_preset=obs_preset,
        episodes=episodes, eval_seed=eval_seed, evaluations=evaluations, evaluation_episodes=evaluation_episodes,
        num_envs=num_envs, device=str(resolve_device(device)), to_the_end=to_the_end,
    )  # fmt: skip
    results = benchmark(plan, processes=processes or default_num_envs(), ray=ray, command=this_command())
    return 1 if results["missing"] else 0
