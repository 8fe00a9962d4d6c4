"""A converted store is read back by lerobot itself, in its own interpreter."""

import json
import subprocess

import numpy as np
import pytest
from store_samples import SPEC, episode, make_store

from manicm_ms.demos.convert import convert
from manicm_ms.demos.convert.base import MissingDependencyError
from manicm_ms.demos.convert.lerobot import features, lerobot_python
from manicm_ms.demos.store import DemoStore

SEEDS = (3, 4)
EXTRAS = ("image", "depth", "privileged_state")
READ_BACK = """
import sys, numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset("manicm_ms/reach", root=sys.argv[1])
items = [data[k] for k in range(len(data))]
arrays = {name: np.stack([np.asarray(item[name]) for item in items]) for name in items[0]}
np.savez(sys.argv[2], fps=data.fps, episodes=data.num_episodes, robot=data.meta.robot_type,
         low=data.meta.stats["action"]["min"], state_names=data.meta.features["observation.state"]["names"], **arrays)
"""


@pytest.fixture(scope="module")
def python():
    try:
        return lerobot_python()
    except MissingDependencyError as error:
        pytest.skip(str(error))


def test_lerobot_reads_what_the_store_holds(python, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HOME", str(tmp_path / "hf"))
    store = make_store(tmp_path / "demos.zarr", SEEDS, EXTRAS)
    with DemoStore.open(store, "a") as writer:
        writer.append(episode(9, success=False))
    out = tmp_path / "reach"
    done = convert(store, "lerobot", out, task="reach the goal")
    read = [python, "-I", "-c", READ_BACK, str(out), str(tmp_path / "back.npz")]
    subprocess.run(read, check=True, capture_output=True, text=True)
    back = np.load(tmp_path / "back.npz", allow_pickle=False)
    with DemoStore.open(store) as reader:
        assert (int(back["episodes"]), int(back["fps"]), str(back["robot"])) == (3, 20, "toy")
        assert set(back["task"].tolist()) == {"reach the goal"}
        assert tuple(back["state_names"]) == SPEC.agent_pos_names
        same = {
            "observation.state": "agent_pos",
            "observation.point_cloud": "point_cloud",
            "observation.depth": "depth",
            "observation.environment_state": "privileged_state",
            "action": "action",
        }
        for theirs, ours in same.items():
            np.testing.assert_array_equal(back[theirs], reader.frames(ours), strict=True)
        pictures = np.moveaxis(back["observation.images.camera"], 1, -1)  # lerobot gives (C, H, W) in [0, 1]
        np.testing.assert_array_equal(np.round(pictures * 255).astype(np.uint8), reader.frames("image"))
        np.testing.assert_array_equal(back["episode_index"], np.repeat([0, 1, 2], reader.lengths))
        np.testing.assert_allclose(back["low"], reader.action.min(axis=0), atol=1e-6)
        ends = np.zeros(done.frames, bool)
        ends[reader.episode_ends - 1] = True
        np.testing.assert_array_equal(back["next.done"].reshape(-1), ends)
        ends[-1] = False  # the third episode is not solved
        np.testing.assert_array_equal(back["next.success"].reshape(-1), ends)
    about = json.loads((out / "meta" / "manicm_ms.json").read_text())
    assert (about["seeds"], about["success"]) == ([3, 4, 9], [True, True, False])
    assert about["provenance"]["expert"] == "sampler"


def test_every_field_has_its_feature():
    described = features(SPEC, ("point_cloud", "agent_pos", "action", *EXTRAS))
    assert described["observation.point_cloud"]["shape"] == [16, 3]
    assert described["observation.images.camera"]["dtype"] == "image"
    for feature in described.values():
        names = feature["names"]
        assert names is None or len(names) in (feature["shape"][0], len(feature["shape"]))
