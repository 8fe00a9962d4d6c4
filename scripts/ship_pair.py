"""Write a trained pair in half precision, small enough to come with the repository.

`python scripts/ship_pair.py runs/ship checkpoints/slide_block` turns runs/ship/{teacher,student} into
checkpoints/slide_block/{teacher,student}. Evaluate what was written, not what it was made of: rounding changes weights.
"""

from __future__ import annotations

import json
from pathlib import Path

import tyro

from manicm_ms.policies.checkpoint import load_checkpoint, read_manifest, save_checkpoint

NAMES = ("teacher", "student")
LIMIT_MB = 15.0


def main(
    source: tyro.conf.Positional[Path],
    target: tyro.conf.Positional[Path],
    renamed: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
) -> None:
    """Convert the pair and print its size.

    Args:
        source: folder with the trained checkpoints teacher and student.
        target: folder to write them to.
        renamed: OLD=NEW, the beginning of a path in the provenance and what a reader knows it as; may be repeated.
    """
    for name in NAMES:
        policy = load_checkpoint(source / name)
        provenance = json.dumps(read_manifest(source / name)["provenance"])
        for pair in renamed:
            old, _, new = pair.partition("=")
            provenance = provenance.replace(old, new)
        save_checkpoint(policy, target / name, json.loads(provenance), dtype="float16")
    size = sum(file.stat().st_size for name in NAMES for file in (target / name).rglob("*") if file.is_file()) / 1e6
    print(f"{target}: {size:.1f} MB")
    if size > LIMIT_MB:
        raise SystemExit(f"more than {LIMIT_MB:g} MB: choose smaller down_dims")


if __name__ == "__main__":
    tyro.cli(main)
