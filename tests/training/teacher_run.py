"""Trains a small teacher on a store, as a script, for tests that kill it: store, output folder, number of processes."""

import sys
from dataclasses import replace
from pathlib import Path

from manicm_ms.training.presets import TEACHER_PRESETS
from manicm_ms.training.train import train as train_policy

PRESET = replace(
    TEACHER_PRESETS.get("quick"),
    steps=80,
    batch_size=32,
    warmup_steps=5,
    log_every=1,
    save_every=7,
    changes={"inputs": {"points": {"max_points": 32}}, "backbone": {"down_dims": (16, 32)}},
)


def train(data, out, num_devices=1):
    """Train into `out` with bfloat16 products, as `quick` does where the CPU has them."""
    return train_policy(
        "simple_dp3", Path(data), Path(out), PRESET, device="cpu", precision="bf16-mixed", num_devices=num_devices
    )


if __name__ == "__main__":
    train(sys.argv[1], sys.argv[2], int(sys.argv[3]))
