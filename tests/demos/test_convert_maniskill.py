"""Converted Slide Block demonstrations are replayed by ManiSkill's own replay_trajectory, by actions and by states."""

import json
from dataclasses import replace

import h5py
import manicm_ms.tasks.slide_block  # noqa: F401  (registers the id, and chooses the Vulkan driver before SAPIEN)
import numpy as np
import pytest
from store_samples import PROVENANCE
from toy_point_mass import ENV_ID as TOY

from mani_skill.trajectory import replay_trajectory  # isort: skip

from manicm_ms.demos.collect import collect_episodes
from manicm_ms.demos.convert import convert
from manicm_ms.demos.store import DemoStore
from manicm_ms.envs.simulator import ENVS
from manicm_ms.errors import ConfigError, ManicmError

ENV_ID, GYM_ID = "ur3e/slide-block", "UR3eSlideBlock-v1"
EPISODES = 2


@pytest.fixture(scope="module")
def episodes():
    return collect_episodes(ENV_ID, EPISODES, seed=40)


def write_store(path, episodes, env_id=ENV_ID):
    with DemoStore.create(path, ENVS.get(env_id).spec, PROVENANCE | {"backend": "cpu"}) as store:
        for episode in episodes:
            store.append(episode)
    return path


@pytest.fixture(scope="module")
def converted(tmp_path_factory, episodes):
    folder = tmp_path_factory.mktemp("converted")
    return convert(write_store(folder / "demos.zarr", episodes), "maniskill", folder / "maniskill")


def test_the_files_hold_the_demonstrations(converted, episodes):
    assert converted.episodes == EPISODES
    assert converted.frames == sum(map(len, episodes))
    # Played again bit for bit: the same scene, the same actions, the same physics.
    assert "differs from the store's by at most 0" in converted.notes[0]
    about = json.loads((converted.path / "trajectory.json").read_text())
    assert about["env_info"]["env_id"] == GYM_ID
    assert about["env_info"]["env_kwargs"]["control_mode"] == "pd_ee_target_delta_pose"
    with h5py.File(converted.path / "trajectory.h5") as file:
        assert set(file) == {f"traj_{k}" for k in range(EPISODES)}
        for k, (listed, episode) in enumerate(zip(about["episodes"], episodes, strict=True)):
            assert (listed["episode_id"], listed["episode_seed"]) == (k, episode.seed)
            assert listed["reset_kwargs"] == {"seed": episode.seed, "options": {"reconfigure": True}}
            assert (listed["success"], listed["elapsed_steps"]) == (True, len(episode))
            trajectory = file[f"traj_{k}"]
            np.testing.assert_array_equal(trajectory["actions"], episode.action)
            assert trajectory["success"][:].tolist() == [False] * (len(episode) - 1) + [True]
            states = trajectory["env_states"]
            assert states["actors/block"].shape == (len(episode) + 1, 13)
            assert np.ptp(states["actors/block"][:, :2], axis=0).max() > 0.05  # the block was slid


def replay(converted, *options):
    """Run ManiSkill's command in this process; return the success of each episode and the h5 file, as it wrote them."""
    before = set(converted.path.glob("*.json"))
    source = str(converted.path / "trajectory.h5")
    replay_trajectory.main(replay_trajectory.parse_args(["--traj-path", source, "--save-traj", *options]))
    (written,) = set(converted.path.glob("*.json")) - before
    return [e["success"] for e in json.loads(written.read_text())["episodes"]], written.with_suffix(".h5")


def test_replay_trajectory_succeeds_by_actions(converted, episodes):
    success, written = replay(converted, "-o", "state")
    assert success == [True] * EPISODES  # without --allow-failure: one that fails is not written
    with h5py.File(written) as file, h5py.File(converted.path / "trajectory.h5") as ours:
        for k in range(EPISODES):
            assert file[f"traj_{k}/obs"].shape[0] == len(episodes[k]) + 1
            for name in ("block", "cube"):
                path = f"traj_{k}/env_states/actors/{name}"
                np.testing.assert_array_equal(file[path], ours[path])


def test_replay_trajectory_succeeds_by_states_and_gives_clouds(converted):
    success, written = replay(converted, "--use-env-states", "-o", "pointcloud", "--count", "1")
    assert success == [True]
    with h5py.File(written) as file:
        xyzw = file["traj_0/obs/pointcloud/xyzw"]
        assert np.isfinite(xyzw[:]).all()
        assert (xyzw[..., 3] == 1).any()


def test_what_is_not_solved_again_is_left_out_or_refused(tmp_path, episodes):
    idle = replace(episodes[0], action=np.zeros_like(episodes[0].action))
    done = convert(write_store(tmp_path / "some.zarr", [idle, episodes[1]]), "maniskill", tmp_path / "some")
    assert done.episodes == 1
    about = json.loads((done.path / "trajectory.json").read_text())
    assert [listed["episode_seed"] for listed in about["episodes"]] == [episodes[1].seed]
    with h5py.File(done.path / "trajectory.h5") as file:
        (kept,) = file.values()
        np.testing.assert_array_equal(kept["actions"], episodes[1].action)
    assert f"left out: seeds [{idle.seed}]" in done.notes[1]
    with pytest.raises(ManicmError, match=r"none of the 1 episodes .* is solved again"):
        convert(write_store(tmp_path / "none.zarr", [idle]), "maniskill", tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_a_task_of_another_simulator_is_refused(tmp_path):
    toy = write_store(tmp_path / "toy.zarr", collect_episodes(TOY, 1), TOY)
    with pytest.raises(ConfigError, match="does not run on ManiSkill"):
        convert(toy, "maniskill", tmp_path / "out")
    assert not (tmp_path / "out").exists()
