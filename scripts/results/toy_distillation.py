#!/usr/bin/env python3
"""Distil a teacher of two-dimensional actions by each formula and measure what the student keeps of it.

Two data sets: "two modes" (the same situation, two equally good actions) and "one mode" (the action is a
function of the situation). Writes a Markdown table; some minutes on one free core.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from manicm_ms.policies.backbones.unet1d import SinusoidalEmbedding
from manicm_ms.policies.heads.consistency_solver import (
    ConsistencySolver,
    CorrectedSolver,
    PublicSolver,
    boundary_scalings,
    consistency_pair,
)
from manicm_ms.policies.heads.diffusion import DiffusionConfig, Guess, epsilon_from_x0

DIFFUSION = DiffusionConfig()
ABAR = DIFFUSION.ddpm().alphas_cumprod
MODES = torch.tensor([[0.6, 0.3], [-0.6, -0.3]])
MODE_STD = 0.03
ON_MODE = 3 * MODE_STD  # distance to the nearer mode below which a sample counts as on it
MU = 0.95  # of the student's moving average, as in the paper
EVAL_SAMPLES = 4000

Solvers = dict[str, Callable[[Tensor], ConsistencySolver]]
SOLVERS: Solvers = {
    "public formula": PublicSolver,
    "public formula, abar_prev[0] = 1": lambda a: PublicSolver(a, final_alpha_bar=1.0),
    "corrected epsilon": lambda a: CorrectedSolver(a, final_alpha_bar=float(a[0])),
    "corrected epsilon, abar_prev[0] = 1": CorrectedSolver,
}


@dataclass(frozen=True)
class Budget:
    """How long to train: optimizer steps of teacher and student."""

    teacher: int = 6000
    student: int = 3000
    batch: int = 256


def two_modes(n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return situations (n, 1), all zero, and actions (n, 2) around either of `MODES`."""
    which = torch.randint(2, (n,), generator=generator)
    return torch.zeros(n, 1), MODES[which] + MODE_STD * torch.randn(n, 2, generator=generator)


def one_mode(n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return situations c (n, 1) in [-1, 1] and actions (n, 2) = 0.7 (cos(pi c), sin(pi c))."""
    c = 2 * torch.rand(n, 1, generator=generator) - 1
    return c, 0.7 * torch.cat([torch.cos(torch.pi * c), torch.sin(torch.pi * c)], dim=-1)


class Network(nn.Module):
    """A small MLP that predicts the clean action from the noisy one, the time and the situation."""

    def __init__(self) -> None:
        super().__init__()
        self.embedding = SinusoidalEmbedding(32)
        layers: list[nn.Module] = [nn.Linear(35, 128), nn.Mish()]
        for _ in range(2):
            layers += [nn.Linear(128, 128), nn.Mish()]
        self.mlp = nn.Sequential(*layers, nn.Linear(128, 2))

    def forward(self, x_t: Tensor, t: Tensor, c: Tensor) -> Tensor:
        """Return x0 (n, 2) for x_t (n, 2), t (n,), c (n, 1)."""
        return self.mlp(torch.cat([x_t, self.embedding(t), c], dim=-1))


def consistency(network: Network, x_t: Tensor, t: Tensor, c: Tensor) -> Tensor:
    """Return f(x_t, t) = c_skip x_t + c_out F(x_t, t), (n, 2)."""
    c_skip, c_out = boundary_scalings(t)
    return c_skip[:, None] * x_t + c_out[:, None] * network(x_t, t, c)


def guess(teacher: Network, x_t: Tensor, t: Tensor, c: Tensor) -> Guess:
    """Return the teacher's x0, not clipped, and the epsilon that goes with it, (n, 2) each."""
    x0 = teacher(x_t, t, c)
    return Guess(x0, epsilon_from_x0(x_t, x0, ABAR[t][:, None]))


Data = Callable[[int, torch.Generator], tuple[Tensor, Tensor]]


def _noisy(x0: Tensor, t: Tensor, generator: torch.Generator) -> Tensor:
    a = ABAR[t][:, None]
    return a.sqrt() * x0 + (1 - a).sqrt() * torch.randn(x0.shape, generator=generator)


def _cosine(optimizer: torch.optim.Optimizer, steps: int) -> torch.optim.lr_scheduler.LRScheduler:
    return torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)


def train_teacher(data: Data, budget: Budget, seed: int) -> Network:
    """Return a network trained to predict x0 (DDPM loss); the same seed gives the same network."""
    generator = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = Network()
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-3, weight_decay=1e-6)
    schedule = _cosine(optimizer, budget.teacher)
    for _ in range(budget.teacher):
        c, x0 = data(budget.batch, generator)
        t = torch.randint(len(ABAR), (budget.batch,), generator=generator)
        loss = (network(_noisy(x0, t, generator), t, c) - x0).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return network.requires_grad_(False)


def _pair(
    solver: ConsistencySolver, networks: tuple[Network, Network, Network], c: Tensor, x_t: Tensor, index: Tensor
) -> tuple[Tensor, Tensor]:
    """Return `consistency_pair` of (teacher, online, target) under the conditions c."""
    teacher, online, target = networks
    return consistency_pair(
        solver,
        teacher=lambda x, t: guess(teacher, x, t, c),
        online=lambda x, t: consistency(online, x, t, c),
        target=lambda x, t: consistency(target, x, t, c),
        x_t=x_t,
        index=index,
    )


def distil(teacher: Network, solver: ConsistencySolver, data: Data, budget: Budget, seed: int) -> Network:
    """Return the student that consistency distillation makes of `teacher` with one of the solvers."""
    generator = torch.Generator().manual_seed(seed)
    online = copy.deepcopy(teacher).requires_grad_(True)
    target = copy.deepcopy(teacher)
    optimizer = torch.optim.AdamW(online.parameters(), lr=5e-4, weight_decay=1e-6)
    schedule = _cosine(optimizer, budget.student)
    for _ in range(budget.student):
        c, x0 = data(budget.batch, generator)
        index = torch.randint(len(solver), (budget.batch,), generator=generator)
        x_t = _noisy(x0, solver.timesteps[index], generator)
        prediction, wanted = _pair(solver, (teacher, online, target), c, x_t, index)
        optimizer.zero_grad()
        (prediction - wanted).square().mean().backward()
        optimizer.step()
        schedule.step()
        with torch.no_grad():
            for moved, value in zip(target.parameters(), online.parameters(), strict=True):
                moved.lerp_(value, 1 - MU)
    return online.requires_grad_(False)


def sample_ddim(teacher: Network, noise: Tensor, c: Tensor) -> Tensor:
    """Return actions (n, 2) by the teacher's ten DDIM steps (90 ... 0)."""
    scheduler, x = DIFFUSION.ddim(DIFFUSION.num_inference_steps), noise
    for t in scheduler.timesteps.tolist():
        x = scheduler.step(teacher(x, torch.full((len(x),), t), c), t, x, return_dict=False)[0]
    return x


def sample_path(teacher: Network, noise: Tensor, c: Tensor) -> Tensor:
    """Return actions (n, 2) by following the students' own grid (99 ... 9, then the clean action)."""
    solver, x = CorrectedSolver(ABAR), noise
    for i in reversed(range(len(solver))):
        index = torch.full((len(x),), i)
        x = solver.previous(guess(teacher, x, solver.timesteps[index], c), index)
    return x


def sample_student(network: Network, noise: Tensor, c: Tensor) -> Tensor:
    """Return actions (n, 2) in one evaluation from the last time."""
    return consistency(network, noise, torch.full((len(noise),), DIFFUSION.num_train_timesteps - 1), c)


def energy_distance(a: Tensor, b: Tensor) -> float:
    """Return 2 E|A - B| - E|A - A'| - E|B - B'| between samples (n, 2) and (m, 2); 0 for equal distributions."""
    n, m = len(a), len(b)
    within = torch.cdist(a, a).sum() / (n * (n - 1)) + torch.cdist(b, b).sum() / (m * (m - 1))
    return float(2 * torch.cdist(a, b).mean() - within)


@dataclass(frozen=True)
class ModeScore:
    """How well samples cover two modes.

    Attributes:
        on_mode: share within three standard deviations of a mode.
        smaller_mode: share of all samples that are on the rarer mode; 0.5 at best.
        imbalance: |share nearer to the first mode - 0.5|; 0.5 when one mode is lost.
        energy: energy distance to fresh data.
    """

    on_mode: float
    smaller_mode: float
    imbalance: float
    energy: float


def score_modes(samples: Tensor, generator: torch.Generator) -> ModeScore:
    """Score samples (n, 2) against `two_modes`."""
    distance, nearest = torch.cdist(samples, MODES).min(dim=-1)
    on = distance < ON_MODE
    shares = [float((on & (nearest == i)).float().mean()) for i in range(2)]
    imbalance = abs(float((nearest == 0).float().mean()) - 0.5)
    energy = energy_distance(samples, two_modes(len(samples), generator)[1])
    return ModeScore(sum(shares), min(shares), imbalance, energy)


@dataclass(frozen=True)
class FitScore:
    """How well samples match a function: root mean square error, and the scale of the best multiple of the truth."""

    rmse: float
    scale: float


def score_fit(samples: Tensor, truth: Tensor) -> FitScore:
    """Score samples (n, 2) against the actions (n, 2) that belong to the same situations."""
    rmse = float((samples - truth).square().sum(-1).mean().sqrt())
    return FitScore(rmse, float((samples * truth).sum() / truth.square().sum()))


def run(data: Data, budget: Budget, seed: int, solvers: Solvers) -> tuple[dict[str, Tensor], Tensor]:
    """Return the samples (n, 2) of each row of the table, and the true actions of the same situations."""
    teacher = train_teacher(data, budget, seed)
    generator = torch.Generator().manual_seed(1000 + seed)
    c, truth = data(EVAL_SAMPLES, generator)
    noise = torch.randn(EVAL_SAMPLES, 2, generator=generator)
    last = torch.full((EVAL_SAMPLES,), DIFFUSION.num_train_timesteps - 1)
    rows = {
        "teacher, DDIM 10 steps": sample_ddim(teacher, noise, c),
        "teacher, 10 steps on the solver's grid": sample_path(teacher, noise, c),
        "teacher, 1 step": teacher(noise, last, c),
    }
    for name, make in solvers.items():
        rows[f"student, {name}"] = sample_student(distil(teacher, make(ABAR), data, budget, seed), noise, c)
    return rows, truth


def table(budget: Budget, seeds: tuple[int, ...]) -> str:
    """Return the Markdown table of both data sets for each seed."""
    cells: dict[str, list[str]] = {}
    for seed in seeds:
        rows, _ = run(two_modes, budget, seed, SOLVERS)
        for name, samples in rows.items():
            s = score_modes(samples, torch.Generator().manual_seed(2000 + seed))
            text = f"{s.on_mode:.3f} / {s.smaller_mode:.3f} / {s.imbalance:.3f} / {s.energy:.4f}"
            cells.setdefault(name, []).append(text)
    for seed in seeds:
        rows, truth = run(one_mode, budget, seed, SOLVERS)
        for name, samples in rows.items():
            f = score_fit(samples, truth)
            cells[name].append(f"{f.rmse:.4f} / {f.scale:.4f}")
    head = [f"two modes, seed {s}" for s in seeds] + [f"one mode, seed {s}" for s in seeds]
    lines = [f"| | {' | '.join(head)} |", "|---" * (len(head) + 1) + "|"]
    return "\n".join(lines + [f"| {name} | {' | '.join(texts)} |" for name, texts in cells.items()])


def main() -> None:
    """Write the table to the file named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/results/toy_distillation.md"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--teacher-steps", type=int, default=Budget.teacher)
    parser.add_argument("--student-steps", type=int, default=Budget.student)
    args = parser.parse_args()
    torch.set_num_threads(1)
    begin = time.monotonic()
    budget = Budget(args.teacher_steps, args.student_steps)
    text = PAGE.format(
        table=table(budget, tuple(args.seeds)),
        teacher=budget.teacher,
        student=budget.student,
        samples=EVAL_SAMPLES,
        seconds=time.monotonic() - begin,
        torch=torch.__version__,
    )
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(text)
    print(text)


PAGE = """# What the distillation formula decides: two-dimensional actions

{table}

Two modes: share of samples on a mode / share on the rarer mode (0.5 at best) / imbalance (0.5: one mode is lost) /
energy distance to fresh data (0 at best). One mode: root mean square error / scale of the best multiple of the truth.

The public formula's step back holds x_t only through the teacher's guess at x0, which at noisy times is the mean of
the modes: all paths meet in one point, and which mode was meant is lost. Its abar_prev[0] = alphas_cumprod[0] leaves
noise of standard deviation 0.025 in the lowest time's targets, which costs precision (one mode) with either epsilon.

`python scripts/results/toy_distillation.py`: an MLP teacher of {teacher} steps, students of {student} steps that
start from it (100 noise times, 10 solver steps, mu 0.95, no clipping), {samples} samples a row, the same noise in each.
{seconds:.0f} s of wall time with one thread, torch {torch}.
"""

if __name__ == "__main__":
    main()
