"""A complete training small enough to be killed often: a two-layer regression with noisy inputs and an average.

Run as a script it trains into the folder it is given, for tests that kill it.
"""

import sys
import time
from pathlib import Path

import torch
from torch import nn

from manicm_ms.training.device import make_fabric
from manicm_ms.training.loop import Objective, fit
from manicm_ms.training.optim import FitConfig, PowerDecay, averaged
from manicm_ms.training.run_folder import open_run

CONFIG = FitConfig(steps=120, batch_size=16, learning_rate=1e-2, warmup_steps=10, log_every=7, save_every=3)
IDENTITY = {"task": "tiny", "steps": 120}


class TinyData:
    """y = sin(x) at 50 places."""

    def __init__(self):
        self.x = torch.linspace(-2, 2, 50)[:, None]

    def __len__(self):
        return len(self.x)

    def batch(self, indices):
        x = self.x[indices]
        return {"x": x, "y": x.sin()}


class TinyObjective(Objective):
    """Fits y from x plus noise and keeps an average of the network; `reference` is never trained."""

    constant = ("reference.",)

    def __init__(self, seed=0):
        super().__init__()
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.network = nn.Sequential(nn.Linear(1, 64), nn.Tanh(), nn.Linear(64, 1))
        self.average = averaged(self.network, PowerDecay(0.75))
        self.reference = nn.Linear(1, 1).requires_grad_(False)
        self.seen = []

    def forward(self, batch, generator):
        noise = torch.randn(batch["x"].shape, generator=generator)
        self.seen.append(float(noise.sum()))
        return ((self.network(batch["x"] + 0.01 * noise) - batch["y"]) ** 2).mean()

    def after_step(self):
        self.average.update_parameters(self.network)


def train(out, *, objective=None, config=CONFIG, identity=IDENTITY, data=None, console=None):
    """Train into `out`; return the objective and what `fit` says."""
    objective = objective or TinyObjective()
    fabric = make_fabric(torch.device("cpu"), "32-true")
    with open_run(Path(out), identity) as run:
        result = fit(objective, data or TinyData(), config, run, fabric, seed=5, console=console)
    return objective, result


class SlowData(TinyData):
    """The same data, at a pace that leaves time for a signal to land between two steps."""

    def batch(self, indices):
        time.sleep(0.05)
        return super().batch(indices)


if __name__ == "__main__":
    torch.set_num_threads(1)
    train(sys.argv[1], data=SlowData())
