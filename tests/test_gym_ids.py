"""`import manicm_ms` makes ids known to Gymnasium; what they name is imported when it is made, and keeps its checks."""

import json
import re
import subprocess
import sys
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import manicm_ms
from manicm_ms import gym_ids
from manicm_ms.envs.numpy_arrays import NumpyVecEnv
from manicm_ms.envs.simulator import ENVS
from manicm_ms.envs.single import SingleEnv
from manicm_ms.errors import ActionError, ConfigError

suites = pytest.mark.skipif(find_spec("metaworld") is None, reason="the MuJoCo suites are an extra")

# Nothing is imported before but Gymnasium; every warning is an error, and what ManiSkill logs goes to stderr.
FRESH = """
import sys, warnings
warnings.simplefilter("error", UserWarning)
import gymnasium
try:
    gymnasium.make("manicm_ms:UR3eStackPlates-v1")
except gymnasium.error.NameNotFound:
    spec = gymnasium.spec("UR3eStackCube-v1")  # known without a line that imports the package
assert not {"torch", "sapien", "mani_skill", "mujoco"} & set(sys.modules)
import mani_skill.envs
from mani_skill.utils.registration import REGISTERED_ENVS
assert "UR3eStackCube-v1" not in REGISTERED_ENVS
import manicm_ms.tasks.stack_cube
assert gymnasium.spec("UR3eStackCube-v1") is spec
env = gymnasium.make("manicm_ms:UR3eStackCube-v1", obs_mode="state")
from mani_skill.utils.wrappers import CPUGymWrapper, RecordEpisode
from mani_skill.vector.wrappers.gymnasium import ManiSkillVectorEnv
env = ManiSkillVectorEnv(RecordEpisode(env, sys.argv[1], save_video=False), record_metrics=True)
env.reset(seed=0)
print(env.step(env.action_space.sample())[0].shape, REGISTERED_ENVS["UR3eStackCube-v1"].cls.__name__)
env.close()
"""


def test_an_id_is_enough_and_later_imports_register_nothing_twice(tmp_path):
    done = subprocess.run([sys.executable, "-c", FRESH, tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[0].endswith("StackCubeEnv")
    assert "regist" not in done.stderr.lower()


def test_importing_the_package_twice_warns_of_nothing(recwarn):
    before = dict(gymnasium.registry)
    gym_ids.register()
    assert dict(gymnasium.registry) == before
    assert not recwarn.list


def test_the_table_says_what_the_tasks_say():
    from manicm_ms.envs.maniskill import gym_id, registration

    assert {env_id for env_id in ENVS.names() if env_id.split("/")[0] in ("ur3e", "adroit", "metaworld")} == set(
        gym_ids.OURS
    )
    for env_id, steps in gym_ids.OURS.items():
        assert ENVS.get(env_id).spec.max_episode_steps == steps, env_id
    ours = {gym_id(env_id): ENVS.get(env_id).spec for env_id in gym_ids.OURS if env_id.startswith("ur3e/")}
    assert set(ours) == set(gym_ids.MANISKILL)
    for name, (entry_point, steps) in gym_ids.MANISKILL.items():
        task = registration.REGISTERED_ENVS[name]
        assert entry_point == f"{task.cls.__module__}:{task.cls.__name__}"
        assert steps == task.max_episode_steps == ours[name].max_episode_steps


@pytest.mark.parametrize("name", [*gym_ids.MANISKILL, "ur3e/slide-block", "adroit/pen", "metaworld/reach"])
def test_specs_become_json_and_come_back(name):
    text = gymnasium.spec(name).to_json()
    assert json.loads(text)["max_episode_steps"] == gymnasium.spec(name).max_episode_steps
    assert EnvSpec.from_json(text) == gymnasium.spec(name)


def test_a_task_of_ones_own_is_registered_the_same_way():
    from manicm_ms.tasks.slide_block import SlideBlockEnv

    from manicm_ms.envs.maniskill import register_env

    class OwnEnv(SlideBlockEnv):
        """Slide Block once more."""

    assert register_env("UR3eOwn-v7", max_episode_steps=9)(OwnEnv) is OwnEnv
    spec = gymnasium.spec("UR3eOwn-v7")
    assert spec.max_episode_steps == 9
    assert json.loads(spec.to_json())["entry_point"].endswith("OwnEnv")


# ---- one row of ours ------------------------------------------------------------------------------------------------


@suites
@pytest.mark.filterwarnings("ignore:.*Box observation space m")
@pytest.mark.parametrize(("env_id", "options"), [("metaworld/reach", {}), ("adroit/pen", {"obs": ("state",)})])
def test_gymnasiums_checker_passes(env_id, options):
    with closing(gymnasium.make(env_id, **options)) as env:
        check_env(env.unwrapped, skip_render_check=True)


def test_a_row_of_the_ur3e_keeps_to_its_spaces():
    """Of the checker only this: each of its many resets builds a scene."""
    torch.set_num_threads(1)
    with closing(gymnasium.make("ur3e/slide-block", image_size=(32, 32), colors=True)) as env:
        obs, _ = env.reset(seed=1)
        assert obs in env.observation_space
        obs, *_ = env.step(env.action_space.sample())
    assert obs in env.observation_space
    assert obs["point_cloud"].shape == (512, 6)


@suites
def test_a_row_is_that_of_the_seed_and_ends_at_its_time_limit():
    env = gymnasium.make("adroit/pen", obs=("state", "agent_pos"), render_mode="rgb_array")
    with closing(env):
        starts = [env.reset(seed=seed)[0]["state"] for seed in (5, None, 5, None)]
        assert np.array_equal(starts[0], starts[2])
        assert np.array_equal(starts[1], starts[3]), "the seed decides what follows without one"
        assert not np.array_equal(starts[0], starts[1])
        before = starts[0].copy()
        _, reward, terminated, truncated, info = env.step(np.zeros(24, np.float32))
        assert np.array_equal(starts[0], before), "what was handed out stays as it was"
        assert (type(reward), terminated, truncated) == (float, False, False)
        assert info["elapsed_steps"] == 1
        assert env.render().shape == (360, 480, 3)
        for bad in (np.full(24, np.nan), np.zeros(3)):
            with pytest.raises(ActionError, match=r"adroit/pen takes actions of shape \(24,\)"):
                env.unwrapped.step(bad)
        with pytest.raises(ConfigError, match="adroit/pen has no reset options, got \\['goal'\\]"):
            env.reset(options={"goal": 1})
        with pytest.raises(ConfigError, match="seed -1 is out of range"):
            env.reset(seed=-1)


def test_an_unknown_render_mode_is_refused():
    with pytest.raises(ConfigError, match="ur3e/slide-block has no render_mode 'human': use 'rgb_array' or None"):
        SingleEnv("ur3e/slide-block", render_mode="human")


@suites
def test_the_page_s_example_runs():
    page = (Path(__file__).parents[1] / "docs" / "suites.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(.*?)^```$", page, re.DOTALL | re.MULTILINE)
    told = {}
    exec(block, told)
    assert told["obs"]["state"].shape == (39,)


# ---- many rows ------------------------------------------------------------------------------------------------------


@suites
def test_gymnasiums_make_vec_is_ours():
    with closing(gymnasium.make_vec("metaworld/reach", num_envs=2, obs=("state",), reward_mode="dense")) as env:
        assert isinstance(env, NumpyVecEnv)
        assert env.unwrapped.spec.id == "metaworld/reach"
        obs, _ = env.reset(seed=0)
        assert obs["state"].shape == (2, 39)
        assert isinstance(env.step(env.action_space.sample())[1], np.ndarray)
    with pytest.raises(ConfigError, match="reach has 200 control steps, which max_episode_steps cannot change"):
        gymnasium.make_vec("metaworld/reach", num_envs=1, max_episode_steps=7)


@pytest.mark.parametrize("name", ["UR3eStackCube-v1", "PickCube-v1"])
def test_ids_of_maniskill_have_no_vector_form_in_gymnasium(name):
    import manicm_ms.envs.maniskill  # noqa: F401  (registers ManiSkill's own)

    with pytest.raises(gymnasium.error.Error, match="additional_wrappers"):
        gymnasium.make_vec(name, num_envs=2)


def test_the_package_exports_what_it_says():
    for name in manicm_ms.__all__:
        assert getattr(manicm_ms, name) is not None
    with pytest.raises(AttributeError):
        _ = manicm_ms.make_nothing
