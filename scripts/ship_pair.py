"""Write a trained pair in half precision, small enough to come with the repository.

`python scripts/ship_pair.py runs/ship checkpoints/slide_block` turns runs/ship/{teacher,student} into
checkpoints/slide_block/{teacher,student}. Evaluate what was written, not what it was made of: rounding changes weights.
"""

from __future__ import annotations

from pathlib import Path

import tyro

from manicm_ms.policies.checkpoint import load_checkpoint, read_manifest, save_checkpoint

NAMES = ("teacher", "student")
LIMIT_MB = 15.0


def main(source: tyro.conf.Positional[Path], target: tyro.conf.Positional[Path]) -> None:
    """Convert the pair and print its size.

    Args:
        source: folder with the trained checkpoints teacher and student.
        target: folder to write them to.
    """
    for name in NAMES:
        policy = load_checkpoint(source / name)
        save_checkpoint(policy, target / name, read_manifest(source / name)["provenance"], dtype="float16")
    size = sum(file.stat().st_size for name in NAMES for file in (target / name).rglob("*") if file.is_file()) / 1e6
    print(f"{target}: {size:.1f} MB")
    if size > LIMIT_MB:
        raise SystemExit(f"more than {LIMIT_MB:g} MB: choose smaller down_dims")


if __name__ == "__main__":
    tyro.cli(main)
