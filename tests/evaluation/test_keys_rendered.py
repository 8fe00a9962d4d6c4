"""What is rendered is what is read, and an evaluation's environment shows what the collection stored, on a real one."""

from contextlib import closing
from importlib.util import find_spec

import numpy as np
import pytest
import torch

if find_spec("metaworld") is None:
    pytest.skip("the MuJoCo suites are an extra, which is not installed", allow_module_level=True)

from manicm_ms.demos.collect import collect
from manicm_ms.demos.store import DemoStore
from manicm_ms.envs.env_request import EnvRequest
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.errors import ConfigError, StoreError
from manicm_ms.evaluation.play import env_maker
from manicm_ms.evaluation.rollout import rollout
from manicm_ms.policies.methods import make_policy

ENV_ID = "metaworld/reach"


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("reach") / "demos.zarr"
    collect(ENV_ID, 1, path, extras=("image", "voxel_grid"), voxel_size=12)
    return path


def test_an_evaluation_renders_what_the_policy_reads_as_it_was_stored(path):
    with DemoStore.open(path) as store:
        policy = make_policy("voxel_dp", store.spec, size="smoke", seed=0)
        episode = store.episode(0)
    with closing(env_maker(EnvRequest(ENV_ID)).for_policy(policy, 1, "clean")) as env:
        assert policy.keys == ("voxel_grid", "agent_pos")
        assert set(env.single_observation_space) == {*policy.keys, "state"}, (
            "the state's digest tells start states apart"
        )
        first, _ = env.reset(seed=[episode.seed])
        later, *_ = env.step(torch.from_numpy(episode.action[None, :3]))
        result = rollout(env, policy, [episode.seed])[0]
    for key in policy.keys:
        stored = getattr(episode, key)
        np.testing.assert_array_equal(first[key][0, -1].numpy(), stored[0], strict=True)
        np.testing.assert_array_equal(later[key][0].numpy(), stored[2:4], strict=True)
    assert episode.voxel_grid.any()
    assert (episode.voxel_grid[0] != episode.voxel_grid[-1]).any()
    assert result.crashed is None


def test_images_are_those_of_the_environment_asked_for_them_alone(path):
    with DemoStore.open(path) as store:
        episode = store.episode(0)
    config = SimulatorConfig(obs=("image",))
    simulator = ENVS.get(ENV_ID).build(config.specialise(ENVS.get(ENV_ID).spec), config)
    with closing(simulator):
        simulator.reset(torch.zeros(1, dtype=torch.int64), [episode.seed])
        frame = simulator.observe()
    assert list(frame) == ["image"]
    np.testing.assert_array_equal(frame["image"][0].numpy(), episode.image[0], strict=True)


def test_a_store_goes_on_with_grids_of_its_own_size_alone(path):
    assert collect(ENV_ID, 1, path, extras=("image", "voxel_grid"), voxel_size=12).added == 0
    with pytest.raises(StoreError, match="with voxel_size 12 where 32 is asked for"):
        collect(ENV_ID, 2, path, extras=("image", "voxel_grid"))
    with DemoStore.open(path) as store:
        assert store.provenance["command"].endswith("--extras image voxel_grid --voxel-size 12")


def test_what_makes_no_grid_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="voxel_size=12 without voxel grids"):
        collect(ENV_ID, 1, tmp_path / "a.zarr", voxel_size=12)
    entry, config = ENVS.get(ENV_ID), SimulatorConfig(obs=("voxel_grid",), obs_preset="dp3")
    with pytest.raises(ConfigError, match=r"has no voxel_grid: its clouds are cropped to a box of 100\.8 m; use"):
        entry.build(config.specialise(entry.spec), config)
