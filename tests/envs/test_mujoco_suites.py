"""Adroit and Meta-World through `make_vec`: the contract on some tasks of each, and what cannot be asked of them."""

import subprocess
import sys
from contextlib import closing
from importlib.util import find_spec

import pytest
import torch

if find_spec("metaworld") is None:
    pytest.skip("the MuJoCo suites are an extra, which is not installed", allow_module_level=True)

from manicm_ms.envs.backends import resolve_backend
from manicm_ms.envs.conformance import check_vec_env
from manicm_ms.envs.simulator import ENVS
from manicm_ms.envs.vec_env import make_vec
from manicm_ms.errors import BackendError, ConfigError, RenderDeviceError, UnknownNameError
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, STATE, ChunkSpec

SOME = ("metaworld/reach", "metaworld/stick-pull", "adroit/hammer", "adroit/pen")


@pytest.mark.parametrize("env_id", SOME)
def test_keeps_the_contract(env_id):
    assert [f"{r.name}: {r.detail}" for r in check_vec_env(env_id) if not r.passed] == []


def test_policies_histories_and_colours():
    chunk = ChunkSpec(2, 4, 3)
    with closing(make_vec("metaworld/button-press", chunk=chunk, colors=True, num_points=300, video=True)) as env:
        obs, _ = env.reset(seed=[3])
        assert obs[POINT_CLOUD].shape == (1, 2, 300, 6)
        assert obs[POINT_CLOUD][..., 3:].min() >= 0
        assert obs[POINT_CLOUD][..., 3:].max() <= 1
        assert obs[POINT_CLOUD][..., 3:].std() > 0.05, "points have colours of their own"
        _, _, terminated, _, info = env.step(torch.zeros(1, 3, 4))
        assert info["elapsed_steps"].tolist() == [3]
        assert not terminated.any()
        frames = env.render_video_frames()
    assert frames.shape == (1, 360, 480, 3)
    assert frames.float().std() > 10


# ---- what cannot be asked -------------------------------------------------------------------------------------------


def test_a_gpu_batch_is_refused_and_auto_takes_the_cpu():
    with pytest.raises(BackendError, match=r"adroit/door has no gpu backend.*backend='cpu'"):
        make_vec("adroit/door", backend="gpu")
    assert resolve_backend("auto", ENVS.get("metaworld/reach")) == "cpu"


@pytest.mark.parametrize("options", [{"realism": "d435i"}, {"camera": "assets/cameras/d435i.yaml"}])
def test_realism_and_cameras_are_refused(options):
    with pytest.raises(ConfigError, match="metaworld/reach has no realism presets and no camera file"):
        make_vec("metaworld/reach", **options)


def test_unknown_preset_lists_those_that_exist():
    with pytest.raises(ConfigError, match="unknown obs_preset 'dp4': choose from manicm_ms, dp3"):
        make_vec("metaworld/reach", obs_preset="dp4")
    with pytest.raises(ConfigError, match="ur3e/slide-block has no obs_preset 'dp3': use manicm_ms"):
        make_vec("ur3e/slide-block", obs_preset="dp3")


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        ("button-press-v2", "it is called 'metaworld/button-press' here"),
        ("metaworld/peg-insert-side-v3", "it is called 'metaworld/peg-insert-side' here"),
        ("AdroitHandDoor-v1", "it is called 'adroit/door' here"),
        ("metaworld/buton-press", "did you mean 'metaworld/button-press'?"),
        ("adroit/relocate", "known: .*adroit/door"),
    ],
)
def test_names_that_are_not_ours(asked, answer):
    with pytest.raises(UnknownNameError, match=answer) as error:
        make_vec(asked)
    assert "\n" not in str(error.value)


def test_adroit_has_no_normalised_reward():
    env = make_vec("adroit/door", obs=(AGENT_POS,), reward_mode="normalized_dense")
    with closing(env), pytest.raises(ConfigError, match="its dense reward has no bounds"):
        env.reset(seed=[1])


def test_without_opengl_physics_works_and_rendering_says_what_to_do(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    code = """
if __name__ == "__main__":
    from manicm_ms.envs.vec_env import make_vec
    from manicm_ms.errors import RenderDeviceError
    env = make_vec("metaworld/reach", obs=("agent_pos", "state"))
    print(env.reset(seed=[1])[0]["state"].shape)
    env.close()
    env = make_vec("metaworld/reach")
    try:
        env.reset(seed=[1])
    except RenderDeviceError as error:
        print(error)
    env.close()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    first, second = done.stdout.strip().splitlines()
    assert first == "torch.Size([1, 39])"
    assert second.startswith("no OpenGL to render with")
    assert "make setup" in second
    assert RenderDeviceError.__name__ not in done.stderr


def test_the_suites_tables_load_no_simulator():
    """Listing environments imports every task's file; those of the UR3e bring ManiSkill, the suites' bring nothing."""
    code = "import sys, manicm_ms.tasks.adroit, manicm_ms.tasks.metaworld; print(*sorted(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "manicm_ms.tasks.metaworld" in loaded
    assert not {"mujoco", "metaworld", "gymnasium_robotics", "OpenGL", "sapien"} & loaded


def test_reward_modes():
    moved = torch.tensor([[0.0, 0.0, 0.5, 0.0]])
    rewards = {}
    for mode in ("sparse", "dense", "normalized_dense", "none"):
        with closing(make_vec("metaworld/reach", obs=(STATE,), reward_mode=mode)) as env:
            env.reset(seed=[1])
            rewards[mode] = env.step(moved)[1].item()
    assert rewards["sparse"] == rewards["none"] == 0
    assert 0 < rewards["normalized_dense"] <= 1
    assert rewards["dense"] == pytest.approx(10 * rewards["normalized_dense"])
