"""`manicm-ms evaluate`: policies on the same held-out seeds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from manicm_ms.cli.counts import Count, CountOrNone, OptionalCount, Seed
from manicm_ms.cli.options import Backend, this_command
from manicm_ms.errors import ConfigError

if TYPE_CHECKING:
    from manicm_ms.evaluation.decided import StoppingRule


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
    until_decided: bool = False,
    margin: float | None = None,
    colors: bool = False,
) -> int:
    """Evaluate policies on the same held-out seeds: success with intervals, paired difference, latency, report.

    Args:
        checkpoints: checkpoint folders, the teacher first and the student last; FOLDER@4 is one whose network is
            evaluated 4 times a decision.
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
        until_decided: play in blocks, and stop when it is decided whether the last policy is worse than the first by
            more than the margin; --episodes is then the most that is played.
        margin: points of success that do not matter to --until-decided, 5 by default.
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
        rule=_stopping_rule(until_decided, margin), policies=policy, colors=colors,
        command=this_command(), console=console,
    )  # fmt: skip
    return 0 if show(results, out, console) else 1


def _stopping_rule(until_decided: bool, margin: float | None) -> StoppingRule | None:
    """Return when to stop before the last seed, None for never; a margin without --until-decided is refused."""
    from manicm_ms.evaluation.decided import StoppingRule
    from manicm_ms.evaluation.verdicts import MARGIN

    if until_decided:
        return StoppingRule(MARGIN if margin is None else margin / 100)
    if margin is not None:
        raise ConfigError("--margin belongs to --until-decided: add it, or leave the margin out")
    return None
