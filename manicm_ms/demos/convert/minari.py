"""To a Minari data set (Farama), written by Minari's own storage class.

Minari wants what followed the last action too, which a store does not hold: the last observation
stands there twice. Rewards are the sparse ones: 1 at the end of a solved episode, else 0.
"""

from __future__ import annotations

import os
import re
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from manicm_ms.demos.convert.base import EXPORTERS, SIDECAR, Export, MissingDependencyError, Tally
from manicm_ms.demos.store import Episode, frame_shapes
from manicm_ms.errors import ConfigError
from manicm_ms.paths import write_json

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer

_NAME = re.compile(r"[-_\w]+-v\d+")
REMEDY = "pip install 'manicm_ms[minari]'"


@EXPORTERS.register("minari")
def export(job: Export) -> Tally:
    """Write `data/` in Minari's HDF5 format, pictures without loss, and env spec and provenance beside it.

    Raises MissingDependencyError without minari, ConfigError where the output's name is no id of a Minari data set.
    """
    if find_spec("minari") is None:
        raise MissingDependencyError("minari", "minari", REMEDY)
    from minari import MinariDataset, __version__
    from minari.dataset.minari_storage import MinariStorage

    dataset_id = _dataset_id(job.out)
    job.require_space()
    (job.folder / "data").mkdir(parents=True)
    spec, provenance = job.store.spec, job.store.provenance
    storage = MinariStorage.new(
        job.folder / "data",
        observation_space=observation_space(job),
        action_space=gymnasium.spaces.Box(-1.0, 1.0, (spec.action.dim,), np.float32),
        jpeg_encoding=False,
    )
    storage.update_metadata(
        {
            "dataset_id": dataset_id,
            "minari_version": __version__,
            "algorithm_name": f"{provenance.get('expert')}, {provenance.get('style')}",
            "description": f"{job.task} ({spec.env_id}); the last observation of an episode stands there twice",
        }
    )
    tally = Tally(notes=["the last observation of each episode is repeated, rewards are sparse"])
    for number, episode in enumerate(job.episodes()):
        storage.update_episodes([_buffer(episode, job.store.fields)])
        storage.update_episode_metadata([{"success": episode.success}], [number])
        tally.add(episode)
    write_json(job.folder / SIDECAR, job.about())
    assert MinariDataset(storage).total_steps == tally.frames
    return tally


def observation_space(job: Export) -> gymnasium.spaces.Dict:
    """Return the space of what the store holds of a frame: its fields without the action."""
    boxes: dict[str, gymnasium.Space[Any]] = {}
    shapes = frame_shapes(job.store.spec)
    for name in job.store.fields:
        shape, dtype = shapes[name]
        if name == "action":
            continue
        low, high = (0, 255) if dtype == np.uint8 else (-np.inf, np.inf)
        boxes[name] = gymnasium.spaces.Box(low, high, shape, dtype.type)
    return gymnasium.spaces.Dict(boxes)


def _buffer(episode: Episode, fields: tuple[str, ...]) -> EpisodeBuffer:
    from minari.data_collector import EpisodeBuffer

    frames = {name: getattr(episode, name) for name in fields if name != "action"}
    ends = np.zeros(len(episode), bool)
    ends[-1] = True
    return EpisodeBuffer(
        seed=episode.seed if episode.seed >= 0 else None,
        observations={name: np.concatenate([values, values[-1:]]) for name, values in frames.items()},  # (L + 1, ...)
        actions=episode.action,
        rewards=(ends & episode.success).astype(np.float32),
        terminations=ends & episode.success,
        truncations=ends & (not episode.success),
        infos={},
    )


def _dataset_id(out: Path) -> str:
    """Return the id that Minari will know `out` by: its path below Minari's folder, elsewhere its name."""
    root = Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets").absolute()
    out = out.absolute()
    dataset_id = out.relative_to(root).as_posix() if out.is_relative_to(root) else out.name
    if not _NAME.fullmatch(out.name):
        raise ConfigError(
            f"{out.name!r} is no id of a Minari data set: let --out end in a name with a version, like slide-block-v0"
        )
    return dataset_id
