"""Demonstrations read for training: one store, or several of the same task one after another."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manicm_ms.demos.remarks import training_remarks
from manicm_ms.demos.sequence_dataset import SequenceDataset
from manicm_ms.demos.stats import FieldStats, field_stats, store_stats
from manicm_ms.demos.store import DemoStore
from manicm_ms.errors import ConfigError, SpecMismatchError
from manicm_ms.spec import ACTION, AGENT_POS, POINT_CLOUD, ChunkSpec, EnvSpec, require_compatible

Data = Path | str | Sequence[Path]
"""A store of demonstrations, or several."""


@dataclass(frozen=True)
class Demos:
    """Demonstrations, read for training.

    Attributes:
        spec: of the environment that they come from.
        dataset: their windows, on the CPU.
        stats: ranges of `point_cloud`, `agent_pos` and `action`.
        provenance: path, content hash, sizes, `demo_seeds` (the seed of each episode, so that an evaluation can
            tell what was seen), and the store's own provenance, JSON values; of several stores `stores` holds theirs.
        remarks: what a user should know of them, one sentence each, its store's path in front; see `demos.remarks`.
    """

    spec: EnvSpec
    dataset: SequenceDataset
    stats: Mapping[str, FieldStats]
    provenance: dict[str, Any]
    remarks: tuple[str, ...] = ()


def store_paths(data: Data) -> tuple[Path, ...]:
    """Return the paths of the stores; raise ConfigError where none is named, or one twice."""
    paths = (Path(data),) if isinstance(data, str | Path) else tuple(Path(path) for path in data)
    if not paths:
        raise ConfigError("name at least one store of demonstrations")
    resolved = [path.resolve() for path in paths]
    if twice := [str(path) for k, path in enumerate(paths) if resolved[k] in resolved[:k]]:
        raise ConfigError(f"{twice[0]} is named twice: its demonstrations would count double")
    return paths


def read_demos(data: Data, chunk: ChunkSpec) -> Demos:
    """Read one store, or several as if they were one.

    Args:
        data: the stores, of the same task with observations and actions of the same form.
        chunk: To, Tp, Ta of the windows.

    Raises:
        StoreError: there is no store, or it is damaged or empty.
        SpecMismatchError: two stores are of different tasks, or do not fit together.
        ConfigError: no store is named, or one twice, or no window fits.
    """
    parts = [_read(path, chunk) for path in store_paths(data)]
    return parts[0] if len(parts) == 1 else _joined(parts)


def _read(path: Path, chunk: ChunkSpec) -> Demos:
    with DemoStore.open(path) as store:
        stats = store_stats(store)
        dataset = SequenceDataset.from_store(store, chunk)
        digest = hashlib.sha256()
        for tensor in (dataset.point_cloud, dataset.agent_pos, dataset.action, dataset.index):
            digest.update(tensor.numpy().tobytes())
        provenance = {
            "path": str(path),
            "env_id": store.spec.env_id,
            "episodes": len(store),
            "frames": len(dataset.action),
            "windows": len(dataset),
            "sha256": digest.hexdigest(),
            "demo_seeds": store.seeds.tolist(),
            "collection": store.provenance,
        }
        remarks = tuple(f"{path}: {remark}" for remark in training_remarks(store, dataset))
        return Demos(store.spec, dataset, stats, provenance, remarks)


def _joined(parts: Sequence[Demos]) -> Demos:
    first = parts[0]
    for part in parts[1:]:
        _require_same_task(first, part)
    dataset = SequenceDataset.joined([part.dataset for part in parts])
    arrays = {POINT_CLOUD: dataset.point_cloud, AGENT_POS: dataset.agent_pos, ACTION: dataset.action}
    stores = [part.provenance for part in parts]
    provenance = {
        "path": " ".join(store["path"] for store in stores),
        "env_id": first.spec.env_id,
        **{key: sum(store[key] for store in stores) for key in ("episodes", "frames", "windows")},
        "sha256": hashlib.sha256(" ".join(store["sha256"] for store in stores).encode()).hexdigest(),
        "demo_seeds": [seed for store in stores for seed in store["demo_seeds"]],
        "stores": stores,
    }
    stats = {name: field_stats(array.numpy(), name) for name, array in arrays.items()}
    return Demos(first.spec, dataset, stats, provenance, tuple(remark for part in parts for remark in part.remarks))


def _require_same_task(first: Demos, other: Demos) -> None:
    names = [f"{part.provenance['path']} (of {part.spec.env_id})" for part in (first, other)]
    if first.spec.env_id != other.spec.env_id:
        raise SpecMismatchError(f"{names[0]} and {names[1]} are demonstrations of two tasks: name stores of one")
    require_compatible(other.spec, first.spec, names[1], names[0])
    points = [part.spec.obs.num_points for part in (first, other)]
    if points[0] != points[1]:
        raise SpecMismatchError(
            f"the clouds of {names[0]} have {points[0]} points and those of {names[1]} {points[1]}: collect one again "
            f"with --num-points {points[0]}"
        )
