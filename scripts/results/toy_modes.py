#!/usr/bin/env python3
"""Train every one-step family on two equally good actions, and measure which of them keep both.

The actions are those of toy_distillation.py: two-dimensional, the same situation, two modes. Heads and objectives are
the package's own, on a small MLP; each is trained for the same number of steps. Writes a Markdown page; about ten
minutes on one free core.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from manicm_ms.policies.action_policy import ActionPolicy, build_policy
from manicm_ms.policies.backbones.backbone import BACKBONES, Backbone
from manicm_ms.policies.backbones.unet1d import SinusoidalEmbedding
from manicm_ms.policies.configuration import NAME, Nested
from manicm_ms.policies.encoders.encoder import ENCODERS, Features, FeatureShape, ObsEncoder
from manicm_ms.policies.methods import student_of
from manicm_ms.spec import ACTION, AGENT_POS, ActionSpec, ChunkSpec, EnvSpec, ObsSpec
from manicm_ms.training.features import CLEAN_ACTION
from manicm_ms.training.objectives.consistency import ConsistencyDistillation
from manicm_ms.training.objectives.head_loss import AveragedHeadObjective
from manicm_ms.training.objectives.objective import PolicyObjective
from manicm_ms.training.optim import FitConfig, PowerDecay, build_optimizer, build_scheduler

sys.path.insert(0, str(Path(__file__).parent))
from toy_distillation import EVAL_SAMPLES, MU, ModeScore, score_modes, two_modes

CHUNK = ChunkSpec(n_obs_steps=1, horizon=1, n_action_steps=1)
SPEC = EnvSpec(
    env_id="toy/two-modes",
    obs=ObsSpec(num_points=1, point_channels=3, agent_pos_dim=1, frame="robot_base"),
    action=ActionSpec(("x", "y"), "position", 1.0),
    max_episode_steps=1,
    agent_pos_names=("situation",),
)
BATCH = 128
DRIFT_BATCHES = (32, 64, 128)
HEADS: Mapping[str, Nested] = {
    "diffusion": {NAME: "diffusion"},
    "meanflow": {NAME: "meanflow"},
    "meanflow, extrapolated (MP1)": {NAME: "meanflow", "velocity_target": "extrapolated"},
    "meanflow, improved": {NAME: "meanflow", "velocity_target": "improved"},
    "uca_flow": {NAME: "uca_flow"},
    "drift": {NAME: "drift"},
    "bc_gmm": {NAME: "gmm", "widths": (128, 128)},
}


@dataclass(frozen=True)
class Width:
    """Width of a part.

    Attributes:
        width: of its layers.
    """

    width: int = 128


@ENCODERS.register("toy_situation")
class Situation(ObsEncoder):
    """The situation as it is."""

    Config = Width
    keys = (AGENT_POS,)

    def __init__(self, config: Width, spec: EnvSpec, chunk: ChunkSpec) -> None:
        super().__init__(config, spec, chunk)
        self.shape = FeatureShape(chunk.n_obs_steps * spec.obs.agent_pos_dim)

    def forward(self, obs: Mapping[str, Tensor]) -> Features:
        """Return the situations (B, To D)."""
        return Features(obs[AGENT_POS].flatten(1))


@BACKBONES.register("toy_mlp")
class MLP(Backbone):
    """Three hidden layers over the chunk, the embedded times and the features."""

    Config = Width

    def __init__(
        self, config: Width, chunk: ChunkSpec, action_dim: int, features: FeatureShape, times: int = 1
    ) -> None:
        super().__init__(config, chunk, action_dim, features, times)
        outputs, width, embedded = chunk.horizon * action_dim, config.width, 32
        self.embedding = SinusoidalEmbedding(embedded)
        layers: list[nn.Module] = []
        for fan_in, fan_out in itertools.pairwise((outputs + times * embedded + features.cond, *[width] * 3)):
            layers += [nn.Linear(fan_in, fan_out), nn.Mish()]
        self.mlp = nn.Sequential(*layers, nn.Linear(width, outputs))

    def forward(self, x: Tensor, times: tuple[Tensor, ...], features: Features) -> Tensor:
        """Return a chunk (B, Tp, Da); see `Backbone.forward`."""
        inputs = [x.flatten(1), *(self.embedding(t) for t in times), features.cond]
        return self.mlp(torch.cat(inputs, dim=-1)).reshape(x.shape)


Batch = Callable[[torch.Generator], dict[str, Tensor]]


def demonstrations(size: int = BATCH) -> Batch:
    """Return what draws batches of raw windows: situations (B, 1, 1) and actions (B, 1, 2)."""

    def batch(generator: torch.Generator) -> dict[str, Tensor]:
        situations, actions = two_modes(size, generator)
        return {AGENT_POS: situations[:, None], ACTION: actions[:, None]}

    return batch


def features(generator: torch.Generator) -> dict[str, Tensor]:
    """Return a batch as a distillation reads it: one draw of each situation's features, and actions (B, 1, 2)."""
    situations, actions = two_modes(BATCH, generator)
    return {"cond": situations[:, None], CLEAN_ACTION: actions[:, None]}


def policy_of(head: Nested, seed: int) -> ActionPolicy:
    """Return an untrained policy with this head; actions are not normalised further."""
    config: dict[str, Any] = {"encoder": {NAME: "toy_situation"}, "head": head}
    if head[NAME] != "gmm":
        config["backbone"] = {NAME: "toy_mlp"}
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return build_policy(str(head[NAME]), config, SPEC, CHUNK)


def fitted(objective: PolicyObjective, batch: Batch, steps: int, learning_rate: float, seed: int) -> ActionPolicy:
    """Return what an objective makes of so many steps; the same seed gives the same policy."""
    config = FitConfig(steps=steps, batch_size=BATCH, learning_rate=learning_rate, warmup_steps=min(100, steps - 1))
    optimizer = build_optimizer([p for p in objective.parameters() if p.requires_grad], config)
    schedule = build_scheduler(optimizer, config, steps)
    generator = torch.Generator().manual_seed(seed)
    objective.train()
    for _ in range(steps):
        optimizer.zero_grad()
        objective(batch(generator), generator).backward()
        optimizer.step()
        schedule.step()
        objective.after_step()
    return objective.outcome.eval()


def samples_of(policy: ActionPolicy, seed: int) -> Tensor:
    """Return actions (n, 2) in the one situation that there is, from noise that every policy gets."""
    generator = torch.Generator().manual_seed(1000 + seed)
    noise = torch.randn(2, EVAL_SAMPLES, 1, 2, generator=generator)[: policy.noise_draws]
    return policy.act({AGENT_POS: torch.zeros(EVAL_SAMPLES, 1, 1)}, noise=noise)[:, 0]


def policies_of(name: str, steps: int, seed: int) -> dict[str, ActionPolicy]:
    """Return the rows of the table that come of one training: label -> policy."""
    decay = PowerDecay()
    policy = fitted(AveragedHeadObjective(policy_of(HEADS[name], seed), decay), demonstrations(), steps, 1e-3, seed)
    if name != "diffusion":
        return {name: policy}
    student = student_of(policy).requires_grad_(True)  # an average asks for no gradient
    objective = ConsistencyDistillation(policy, student, ema_decay=MU)
    distilled = fitted(objective, features, steps, 5e-4, seed)
    once = policy.one_step()
    assert once is not None
    return {"diffusion, 10 steps": policy, "diffusion, its network once": once, "manicm (student of it)": distilled}


def measured(steps: int, seeds: tuple[int, ...]) -> dict[str, list[tuple[int, ModeScore]]]:
    """Return label -> network evaluations and score of each seed; says what is done on standard error."""
    rows: dict[str, list[tuple[int, ModeScore]]] = {}
    for seed, name in itertools.product(seeds, HEADS):
        begin = time.monotonic()
        for label, policy in policies_of(name, steps, seed).items():
            score = score_modes(samples_of(policy, seed), torch.Generator().manual_seed(2000 + seed))
            rows.setdefault(label, []).append((policy.nfe, score))
            print(f"seed {seed}, {label}: {_cells(score)}", file=sys.stderr, flush=True)
        print(f"  {steps} steps: {time.monotonic() - begin:.0f} s", file=sys.stderr, flush=True)
    return rows


def drift_starts(steps: int, seeds: Sequence[int]) -> str:
    """Return a Markdown table of drift alone: batch sizes and seeds, which decide where it comes to rest."""
    lines = [f"| drift, batch | {' | '.join(f'seed {s}' for s in seeds)} |", "|---" * (len(seeds) + 1) + "|"]
    for size in DRIFT_BATCHES:
        cells = []
        for seed in seeds:
            objective = AveragedHeadObjective(policy_of(HEADS["drift"], seed), PowerDecay())
            policy = fitted(objective, demonstrations(size), steps, 1e-3, seed)
            cells.append(_cells(score_modes(samples_of(policy, seed), torch.Generator().manual_seed(2000 + seed))))
            print(f"drift, batch {size}, seed {seed}: {cells[-1]}", file=sys.stderr, flush=True)
        lines.append(f"| {size} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cells(score: ModeScore) -> str:
    return f"{score.on_mode:.3f} / {score.smaller_mode:.3f} / {score.energy:.4f}"


def table(rows: Mapping[str, list[tuple[int, ModeScore]]], seeds: tuple[int, ...]) -> str:
    """Return the Markdown table."""
    head = f"| | evaluations | {' | '.join(f'seed {s}' for s in seeds)} |"
    lines = [head, "|---" * (len(seeds) + 2) + "|"]
    for label, scores in rows.items():
        lines.append(f"| {label} | {scores[0][0]} | {' | '.join(_cells(score) for _, score in scores)} |")
    return "\n".join(lines)


def main() -> None:
    """Write the page to the file named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/results/toy_modes.md"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--drift-seeds", type=int, nargs="+", default=[0, 1, 2, 3])
    parser.add_argument("--drift-steps", type=int, default=1000)
    args = parser.parse_args()
    torch.set_num_threads(1)
    begin, seeds = time.monotonic(), tuple(args.seeds)
    text = PAGE.format(
        table=table(measured(args.steps, seeds), seeds),
        starts=drift_starts(args.drift_steps, args.drift_seeds),
        drift_steps=args.drift_steps,
        steps=args.steps,
        batch=BATCH,
        samples=EVAL_SAMPLES,
        seconds=time.monotonic() - begin,
        torch=torch.__version__,
    )
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(text)
    print(text)


PAGE = """# Which one-step methods keep two modes: two-dimensional actions

{table}

Share of samples on a mode / share on the rarer mode (0.5 at best) / energy distance to fresh data (0 at best).

**Both modes are kept** by the student, by MeanFlow with each of its targets, by UCA-Flow's objective and by the mixture
of Gaussians, whose form is that of the data. The average velocities put fewer samples on a mode than the diffusion's
ten steps at the same budget, and share them less evenly; their energy distances are about those of the student.
**Neither mode is met** by the diffusion's network once: it answers with the mean.

**Drift keeps both, more sharply than the other networks, or answers with the mean: chance decides.** A collapsed
generator is a rest of the published field. With one demonstration y for each observation the force on sample i is
P_i sum_j N_ij (y - a_j): towards y, less where its neighbours a_j lie. Where all samples lie together at the mean of
the data, and the data beyond the reach of every temperature (P_i is its floor), its mean over y is 0. Whether a
training finds out of there before its learning rate falls differs from seed to seed and from batch to batch:

{starts}

So look at the spread of its samples before believing a rate of drift, and train more than one seed.

`python scripts/results/toy_modes.py`: {steps} steps of batch {batch} for each method of the first table, the student's
after its teacher's; {drift_steps} steps for each cell of the second. One small MLP for all (the mixture has its own, of
the same width), the package's heads, objectives and optimiser, learning rate 1e-3 (student 5e-4) with warm-up and
cosine, averaged weights. {samples} samples a row, the same noise in each. {seconds:.0f} s of wall time with one thread
on a machine busy with other work, torch {torch}.
"""

if __name__ == "__main__":
    main()
