"""One decision under two checkouts of the package, in turn: is it slower after a change than before?

python scripts/results/decision_ratio.py CHECKPOINT ../before/.venv/bin/python .venv/bin/python

Each interpreter loads the checkpoint in a process of its own. The two take turns of 20 decisions, so that a machine
that is slow for a while is slow for both, and their ratio is taken turn by turn. Times are CPU times of one thread.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import tyro

WORKER = """
import json, sys, time, torch
from pathlib import Path
from manicm_ms.policies.checkpoint import load_checkpoint
torch.set_num_threads(1)
policy = load_checkpoint(Path(sys.argv[1]))
obs_spec, chunk, generator = policy.spec.obs, policy.chunk, torch.Generator().manual_seed(0)
frames = (1, chunk.n_obs_steps)
obs = {"point_cloud": torch.rand(*frames, obs_spec.num_points, obs_spec.point_channels, generator=generator),
       "agent_pos": torch.rand(*frames, obs_spec.agent_pos_dim, generator=generator)}
noise = torch.randn(policy.noise_draws, 1, chunk.horizon, policy.spec.action.dim, generator=generator)
for line in sys.stdin:
    start = time.thread_time_ns()
    for _ in range(20):
        policy.decide(obs, noise, None)
    print(json.dumps((time.thread_time_ns() - start) / 20e6), flush=True)
"""


def main(
    checkpoint: tyro.conf.Positional[Path],
    before: tyro.conf.Positional[Path],
    after: tyro.conf.Positional[Path],
    turns: int = 60,
) -> None:
    """Print the median time of a decision under both, milliseconds, and their ratio with its quartiles.

    Args:
        checkpoint: folder that both read.
        before: interpreter of one checkout.
        after: interpreter of the other.
        turns: of each; three more are not counted.
    """
    command = ["-c", WORKER, str(checkpoint.resolve())]
    workers = [
        subprocess.Popen([str(python), *command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        for python in (before, after)
    ]
    times = np.array([[_turn(worker) for worker in workers] for _ in range(3 + turns)])[3:]
    for worker in workers:
        worker.communicate()
    first, second = np.median(times, axis=0)
    low, ratio, high = np.percentile(times[:, 1] / times[:, 0], [25, 50, 75])
    print(f"{checkpoint}: {first:.2f} ms before, {second:.2f} ms after; ratio {ratio:.3f} ({low:.3f} to {high:.3f})")


def _turn(worker: subprocess.Popen[str]) -> float:
    assert worker.stdin is not None
    assert worker.stdout is not None
    worker.stdin.write("go\n")
    worker.stdin.flush()
    answer = worker.stdout.readline()
    if not answer:
        sys.exit(f"{worker.args!r} ended: can its checkout read the checkpoint?")
    return float(json.loads(answer))


if __name__ == "__main__":
    tyro.cli(main)
