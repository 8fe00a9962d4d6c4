"""`manicm-ms compare`: policies on the same start states, and what may be concluded."""

from __future__ import annotations

from pathlib import Path

import tyro

from manicm_ms.cli.counts import Count, OptionalCount, Seed
from manicm_ms.cli.options import Backend


def compare_command(
    policies: tyro.conf.Positional[tuple[Path, ...]],
    *,
    env: str | None = None,
    out: Path = Path("runs/compare"),
    episodes: Count = 100,
    seed: Seed = 100_000,
    margin: float = 5.0,
    baseline: str | None = None,
    all_pairs: bool = False,
    num_envs: OptionalCount = None,
    backend: Backend = "auto",
    device: str = "cpu",
    realism: str = "clean",
    camera: Path | None = None,
    obs_preset: str = "manicm_ms",
    allow_seen_seeds: bool = False,
) -> int:
    """Compare policies on the same start states: better, worse, not worse by more than a margin, or underpowered.

    Args:
        policies: folders of finished evaluations, whose records are compared, and checkpoints, which are played first;
            FOLDER@4 is a checkpoint whose network is evaluated 4 times a decision.
        env: environment id that checkpoints are played in.
        out: folder of compare.json, compare.md and the evaluations of checkpoints.
        episodes: held-out seeds on which checkpoints are played.
        seed: first of them.
        margin: points of success that do not matter.
        baseline: name or folder of the policy that the others are compared with; the first by default.
        all_pairs: compare every policy with every other.
        num_envs: environments that play at once; by default one a core.
        backend: where to simulate.
        device: torch device of the policies.
        realism: preset under which checkpoints are played.
        camera: YAML file of the cell's depth camera, as 'manicm-ms calibrate' writes it.
        obs_preset: the one that the policies were trained with: manicm_ms or dp3.
        allow_seen_seeds: play checkpoints on seeds of their own demonstrations, which is refused otherwise.
    """
    from rich.console import Console

    from manicm_ms.evaluation.compare import Playing, compare
    from manicm_ms.evaluation.comparison_text import show_comparison

    console = Console()
    playing = Playing(env, episodes, seed, num_envs, backend, device, realism, camera, obs_preset, allow_seen_seeds)
    found = compare(
        policies, out, playing, margin=margin / 100, baseline=baseline, all_pairs=all_pairs, console=console
    )
    return 0 if show_comparison(found, out, console) else 1
