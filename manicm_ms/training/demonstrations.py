"""Demonstrations read for training: one store, or several of the same task one after another."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from manicm_ms.demos.layout import FIELD_OF_OBS, OPTIONAL_FIELDS
from manicm_ms.demos.remarks import training_remarks
from manicm_ms.demos.sequence_dataset import CLOUD_KEYS, SequenceDataset
from manicm_ms.demos.stats import FieldStats, field_stats, store_stats
from manicm_ms.demos.store import DemoStore
from manicm_ms.errors import ConfigError, SpecMismatchError
from manicm_ms.spec import OBS_KEYS, POINT_CLOUD, ChunkSpec, EnvSpec, require_compatible

Data = Path | str | Sequence[Path]
"""A store of demonstrations, or several."""
_BLOCK_FRAMES = 256  # hashed at a time: what is on the disk need not fit into memory


@dataclass(frozen=True)
class Demos:
    """Demonstrations, read for training.

    Attributes:
        spec: of the environment that they come from.
        dataset: their windows, on the CPU.
        stats: ranges of `action` and of those observations that are scaled by them.
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


def spec_of(data: Data) -> EnvSpec:
    """Return the spec of the demonstrations, the first store's; raises as `read_demos`."""
    with DemoStore.open(store_paths(data)[0]) as store:
        return store.spec


def read_demos(data: Data, chunk: ChunkSpec, keys: Sequence[str] = CLOUD_KEYS, reader: str = "the policy") -> Demos:
    """Read one store, or several as if they were one.

    Args:
        data: the stores, of the same task with observations and actions of the same form.
        chunk: To, Tp, Ta of the windows.
        keys: observations that are learnt from.
        reader: what reads them, for messages.

    Raises:
        StoreError: there is no store, or it is damaged or empty.
        SpecMismatchError: two stores are of different tasks, or do not fit together.
        ConfigError: no store is named, or one twice, no window fits, or a store lacks one of the observations.
    """
    read = CLOUD_KEYS if set(keys) <= set(CLOUD_KEYS) else tuple(key for key in OBS_KEYS if key in keys)
    paths = store_paths(data)
    for path in paths:
        _require_keys(path, read, reader)
    parts = [_read(path, chunk, read) for path in paths]
    return parts[0] if len(parts) == 1 else _joined(parts, read)


def _require_keys(path: Path, keys: Sequence[str], reader: str) -> None:
    """Raise ConfigError where the store lacks one of the observations, with the option that adds it."""
    with DemoStore.open(path) as store:
        missing = [FIELD_OF_OBS[key] for key in keys if FIELD_OF_OBS[key] not in store.fields]
        if missing:
            kept = [name for name in OPTIONAL_FIELDS if name in store.fields or name in missing]
            raise ConfigError(
                f"{path} holds no {' and no '.join(missing)}, which {reader} reads: collect the demonstrations again, "
                f"into another folder, with --extras {' '.join(kept)}"
            )


def _read(path: Path, chunk: ChunkSpec, keys: Sequence[str]) -> Demos:
    with DemoStore.open(path) as store:
        stats = store_stats(store, keys)
        dataset = SequenceDataset.from_store(store, chunk, keys)
        provenance = {
            "path": str(path),
            "env_id": store.spec.env_id,
            "episodes": len(store),
            "frames": len(dataset.action),
            "windows": len(dataset),
            "sha256": content_hash(dataset),
            "demo_seeds": store.seeds.tolist(),
            "collection": store.provenance,
        }
        remarks = tuple(f"{path}: {remark}" for remark in training_remarks(store, dataset))
        return Demos(store.spec, dataset, stats, provenance, remarks)


def content_hash(dataset: SequenceDataset) -> str:
    """Return the SHA-256 of all that is learnt from: the observations in their order, the actions, the windows."""
    digest = hashlib.sha256()
    for values in dataset.frames.values():
        for block in torch.arange(len(values)).split(_BLOCK_FRAMES):
            digest.update(values[block].numpy().tobytes())
    digest.update(dataset.index.numpy().tobytes())
    return digest.hexdigest()


def _joined(parts: Sequence[Demos], keys: Sequence[str]) -> Demos:
    first = parts[0]
    for part in parts[1:]:
        _require_same_task(first, part, keys)
    dataset = SequenceDataset.joined([part.dataset for part in parts])
    arrays: dict[str, Any] = {name: dataset.frames[name] for name in first.stats}
    stores = [part.provenance for part in parts]
    provenance = {
        "path": " ".join(store["path"] for store in stores),
        "env_id": first.spec.env_id,
        **{key: sum(store[key] for store in stores) for key in ("episodes", "frames", "windows")},
        "sha256": hashlib.sha256(" ".join(store["sha256"] for store in stores).encode()).hexdigest(),
        "demo_seeds": [seed for store in stores for seed in store["demo_seeds"]],
        "stores": stores,
    }
    stats = {name: field_stats(array, name) for name, array in arrays.items()}
    return Demos(first.spec, dataset, stats, provenance, tuple(remark for part in parts for remark in part.remarks))


def _require_same_task(first: Demos, other: Demos, keys: Sequence[str]) -> None:
    names = [f"{part.provenance['path']} (of {part.spec.env_id})" for part in (first, other)]
    if first.spec.env_id != other.spec.env_id:
        raise SpecMismatchError(f"{names[0]} and {names[1]} are demonstrations of two tasks: name stores of one")
    require_compatible(other.spec, first.spec, names[1], names[0], keys)
    points = [part.spec.obs.num_points for part in (first, other)]
    if points[0] != points[1] and POINT_CLOUD in keys:
        raise SpecMismatchError(
            f"the clouds of {names[0]} have {points[0]} points and those of {names[1]} {points[1]}: collect one again "
            f"with --num-points {points[0]}"
        )
