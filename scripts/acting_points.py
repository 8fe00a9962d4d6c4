"""Acting on the farthest-point prefix or on random points, compared: `python scripts/acting_points.py CHECKPOINT ...`.

Each checkpoint plays the same seeds with each choice of points. Noise and start states are the same in both, so that
the outcomes are pairs. Which choice a checkpoint acts on is `acting_points` in its configuration.
"""

from __future__ import annotations

from pathlib import Path
from typing import cast

import tyro

from manicm_ms.envs.backends import default_num_envs
from manicm_ms.envs.vec_env import make_vec
from manicm_ms.envs.vector import VecEnv
from manicm_ms.evaluation.rollout import RestartableEnv, rollout
from manicm_ms.evaluation.statistics import compare_paired, success_rate
from manicm_ms.machine.devices import torch_threads
from manicm_ms.policies.action_policy import ActionPolicy
from manicm_ms.policies.checkpoint import load_checkpoint
from manicm_ms.policies.encoders.points import PointSubset

CHOICES = ("prefix", "random")


def players(checkpoint: Path) -> dict[str, ActionPolicy]:
    """Return the policy of a checkpoint, and of a teacher also its one-step control, by name."""
    policy = load_checkpoint(checkpoint)
    name = f"{checkpoint.resolve().parent.name}/{checkpoint.name}"
    if "points" not in policy.transforms:
        raise SystemExit(f"{checkpoint} holds a {policy.name}, which does not choose points")
    control = policy.one_step()
    return {name: policy} if control is None else {name: policy, f"{name}, one step": control}


def main(
    checkpoints: tyro.conf.Positional[tuple[Path, ...]],
    env_id: str | None = None,
    episodes: int = 200,
    seed: int = 100_000,
    realism: str = "clean",
    num_envs: int | None = None,
    backend: str = "auto",
) -> None:
    """Print a row for each policy: successes with each choice, and their paired difference.

    Args:
        checkpoints: folders of policies that read fewer points than a cloud holds.
        env_id: environment; that of the checkpoint by default.
        episodes: seeds, each played once with each choice.
        seed: the first of them, beyond those of the demonstrations.
        realism: preset of the environment.
        num_envs: rows in parallel; the machine's cores by default.
        backend: of `make_vec`.
    """
    print(f"seeds {seed} to {seed + episodes - 1}, {realism}", flush=True)
    print("| policy | points | prefix | random | only prefix / only random | random - prefix (95 %) |")
    print("|---|---|---|---|---|---|", flush=True)
    with torch_threads(1):
        for checkpoint in checkpoints:
            for name, policy in players(checkpoint).items():
                print(row(name, policy, env_id, range(seed, seed + episodes), realism, num_envs, backend), flush=True)


def row(
    name: str, policy: ActionPolicy, env_id: str | None, seeds: range, realism: str, num_envs: int | None, backend: str
) -> str:
    """Play the seeds with each choice and return the row of the table."""
    points, spec = cast(PointSubset, policy.transforms["points"]), policy.spec
    count = points.config.max_points
    if count is None or count >= spec.obs.num_points:
        raise SystemExit(f"{name} reads all {spec.obs.num_points} points: there is nothing to choose")

    def make_env() -> VecEnv:
        return make_vec(
            env_id or spec.env_id,
            min(num_envs or default_num_envs(), len(seeds)),
            backend,
            chunk=policy.chunk,
            num_points=spec.obs.num_points,
            colors=spec.obs.point_channels == 6,
            realism=realism,
        )

    env = RestartableEnv(make_env)
    solved = {}
    try:
        for choice in CHOICES:
            points.act_on(choice)
            solved[choice] = [episode.success for episode in rollout(env, policy, seeds)]
    finally:
        env.close()
    rates = [success_rate(solved[choice]) for choice in CHOICES]
    cells = [f"{r.successes}/{r.n} ({100 * r.ci95.low:.0f} to {100 * r.ci95.high:.0f} %)" for r in rates]
    pair = compare_paired(*(solved[choice] for choice in CHOICES))
    low, high = pair.difference_ci95
    return (
        f"| {name} | {count} of {spec.obs.num_points} | {cells[0]} | {cells[1]} "
        f"| {pair.counts.only_first} / {pair.counts.only_second} "
        f"| {100 * pair.difference:+.1f} ({100 * low:+.1f} to {100 * high:+.1f}) |"
    )


if __name__ == "__main__":
    tyro.cli(main)
