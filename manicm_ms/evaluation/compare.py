"""Compare policies on the same start states: finished evaluations from their records, checkpoints once evaluated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console

from manicm_ms.errors import ConfigError, NotComparableError, UnknownNameError
from manicm_ms.evaluation.anytime import require_margin
from manicm_ms.evaluation.comparison import compile_comparison
from manicm_ms.evaluation.comparison_text import render_comparison
from manicm_ms.evaluation.contestants import (
    Contestant,
    common_seeds,
    conditions,
    evaluations_asked,
    is_checkpoint,
    read_evaluation,
    with_distinct_names,
    without_twins,
)
from manicm_ms.evaluation.evaluate import evaluate
from manicm_ms.evaluation.policies import load_policies, require_playable
from manicm_ms.evaluation.protocol import CLEAN, OBS_PRESET, EvaluatedPolicy, Protocol, seeds_from, slug
from manicm_ms.evaluation.records import claimed_folder
from manicm_ms.evaluation.request import requested_realism
from manicm_ms.evaluation.rollout import EpisodeResult
from manicm_ms.evaluation.verdicts import MARGIN
from manicm_ms.paths import write_json, write_text
from manicm_ms.sensing.realism import parse_presets

COMPARE_FILE, COMPARE_PAGE, EVALUATIONS = "compare.json", "compare.md", "evaluations"


@dataclass(frozen=True)
class Playing:
    """How checkpoints are evaluated before they are compared; see `evaluate`.

    Attributes:
        env_id: the environment; None where there is no checkpoint.
        episodes: seeds seed, seed + 1, ...
        seed: the first of them.
        num_envs: rows in parallel; None takes the machine's cores.
        backend: of `make_vec`.
        device: of the policies.
        realism: one preset.
        camera: YAML file of the cell's depth camera.
        obs_preset: the one that the policies were trained with.
        allow_seen_seeds: take seeds of a checkpoint's own demonstrations as well.
    """

    env_id: str | None = None
    episodes: int = 100
    seed: int = 100_000
    num_envs: int | None = None
    backend: str = "auto"
    device: str = "cpu"
    realism: str = CLEAN
    camera: Path | None = None
    obs_preset: str = OBS_PRESET
    allow_seen_seeds: bool = False

    @property
    def seeds(self) -> tuple[int, ...]:
        """All seeds."""
        return seeds_from(self.seed, self.episodes)

    def evaluate(self, checkpoint: str, out: Path, console: Console) -> None:
        """Evaluate one checkpoint alone into `out`, or go on where that was stopped."""
        assert self.env_id is not None
        evaluate(
            [Path(checkpoint)], self.env_id, self.episodes, self.seed, out, control=False, videos=0,
            num_envs=self.num_envs, backend=self.backend, device=self.device, realism=self.realism, camera=self.camera,
            obs_preset=self.obs_preset, allow_seen_seeds=self.allow_seen_seeds, console=console,
        )  # fmt: skip


def compare(
    sources: Sequence[Path],
    out: Path,
    playing: Playing = Playing(),
    *,
    margin: float = MARGIN,
    baseline: str | None = None,
    all_pairs: bool = False,
    console: Console | None = None,
) -> dict[str, Any]:
    """Compare policies and write compare.json and compare.md.

    Args:
        sources: checkpoint folders (or FOLDER@N, see `load_policies`) and folders of finished evaluations, at least two
            policies in all. Checkpoints are evaluated into `out`; the same call goes on where that was stopped.
        out: folder of the comparison.
        playing: how checkpoints are evaluated.
        margin: difference of success rates that does not matter, in (0, 1).
        baseline: name or folder of the policy that the others are compared with; None takes the first.
        all_pairs: compare every policy with every other.
        console: where progress is shown; None is standard output.

    Returns what compare.json holds.

    Raises:
        NotComparableError: other environments or start states; nothing is written where that is known beforehand.
        ManicmError: anything else that does not fit, before anything is written.
    """
    console = console or Console()
    require_margin(margin)
    contestants, remarks = without_twins(_contestants(sources, playing))
    if len(contestants) < 2:
        raise ConfigError("a comparison needs at least two policies: name another checkpoint or evaluation folder")
    contestants = with_distinct_names(contestants)
    common_seeds(contestants)
    chosen = _index_of(baseline, contestants)
    request = {
        "compared": [[c.name, c.source, c.identity] for c in contestants],
        "conditions": dict(contestants[0].conditions),
        "baseline": contestants[chosen].name,
        "margin": margin,
        "all_pairs": all_pairs,
        "env_id": contestants[0].env_id,
        "seeds": [playing.seeds[0], playing.seeds[-1]] if any(c.pending for c in contestants) else None,
    }
    with claimed_folder(out, request, "comparison"):
        played = [_played(contestant, playing, out, console) for contestant in contestants]
        seeds = common_seeds(played)
        found = compile_comparison(played, played[chosen], seeds, margin, all_pairs, remarks)
        write_json(out / COMPARE_FILE, found)
        write_text(out / COMPARE_PAGE, render_comparison(found))
    return found


def _contestants(sources: Sequence[Path], playing: Playing) -> list[Contestant]:
    """Return the policies in the order of their sources; those of checkpoints are still to be played."""
    kinds = [(source, is_checkpoint(source)) for source in dict.fromkeys(sources)]
    checkpoints = [source for source, is_one in kinds if is_one]
    pending = dict(zip(checkpoints, _to_be_played(checkpoints, playing), strict=True)) if checkpoints else {}
    found: list[Contestant] = []
    for source, is_one in kinds:
        found += [pending[source]] if is_one else read_evaluation(source)
    return found


def _to_be_played(checkpoints: Sequence[Path], playing: Playing) -> list[Contestant]:
    """Return checkpoints as policies without outcomes; raise ManicmError where one cannot be played."""
    from manicm_ms.envs.env_request import EnvRequest
    from manicm_ms.envs.simulator import ENVS, SimulatorConfig

    if playing.env_id is None:
        raise ConfigError(f"{checkpoints[0]} is a checkpoint and has to be played: add --env ENV_ID")
    presets = parse_presets(playing.realism)
    if len(presets) > 1:
        raise ConfigError(
            f"a comparison has one realism preset, got {', '.join(presets)}: compare under each on its own"
        )
    entry = ENVS.get(playing.env_id)
    env = EnvRequest(playing.env_id, realism=playing.realism, camera=playing.camera, obs_preset=playing.obs_preset)
    env.require_offered()
    Protocol(playing.env_id, playing.seeds, 1, realism=presets, seed_limit=entry.seed_limit)  # refuses bad seeds
    loaded = load_policies(checkpoints, playing.device, control=False)
    _require_one_task(loaded)
    offered = SimulatorConfig(obs_preset=playing.obs_preset).specialise(entry.spec)
    require_playable(loaded, offered, () if playing.allow_seen_seeds else playing.seeds)
    where = conditions(presets[0], requested_realism(presets, env.camera_model))
    unknown = {seed: EpisodeResult(seed, False, 0, 0, 0.0) for seed in playing.seeds}
    return [
        Contestant(
            policy.name, policy.checkpoint, policy.role, policy.checkpoint,
            ("", policy.digest, evaluations_asked(policy.name)), playing.env_id, where, False, unknown,
        )
        for policy in loaded
    ]  # fmt: skip


def _require_one_task(loaded: Sequence[EvaluatedPolicy]) -> None:
    first = loaded[0]
    for other in loaded[1:]:
        if other.policy.spec.env_id != first.policy.spec.env_id:
            raise NotComparableError(
                f"{first.checkpoint} was trained for {first.policy.spec.env_id}, {other.checkpoint} for "
                f"{other.policy.spec.env_id}: name checkpoints of one task"
            )


def _played(contestant: Contestant, playing: Playing, out: Path, console: Console) -> Contestant:
    """Return the policy with its outcomes; one of a checkpoint is evaluated first."""
    if not contestant.pending:
        return contestant
    folder = out / EVALUATIONS / slug(contestant.name)
    playing.evaluate(contestant.checkpoint, folder, console)
    (found,) = read_evaluation(folder)
    return replace(found, name=contestant.name)


def _index_of(baseline: str | None, contestants: Sequence[Contestant]) -> int:
    if baseline is None:
        return 0
    for index, contestant in enumerate(contestants):
        if baseline in (contestant.name, contestant.source, contestant.checkpoint):
            return index
    raise UnknownNameError("baseline", baseline, [c.name for c in contestants])
