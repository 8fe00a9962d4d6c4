"""ManiSkill's state contract: what was got, set again, goes on as it did: here, elsewhere, flat and from files."""

import copy
import shutil

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch

import manicm_ms.envs.maniskill  # noqa: F401  (chooses the Vulkan driver before SAPIEN is imported)

from mani_skill.trajectory import replay_trajectory  # isort: skip
from mani_skill.trajectory import utils as trajectory_utils  # isort: skip
from mani_skill.utils.wrappers import RecordEpisode  # isort: skip
from mani_skill.utils.wrappers.cached_reset import CachedResetWrapper  # isort: skip

from manicm_ms.tasks import slide_block, stack_cube, transfer_piece  # isort: skip

from manicm_ms.demos.experts import EXPERTS
from manicm_ms.errors import ConfigError

TASKS = (slide_block, stack_cube, transfer_piece)
SEED = 7
FREE, TOUCHING = 20, {slide_block: 35, stack_cube: 50, transfer_piece: 65}  # steps of the expert: nothing, or an object
AHEAD = 15
MODES = ("pd_ee_target_delta_pose", "pd_ee_delta_pose", "pd_ee_pose", "pd_joint_pos", "pd_joint_delta_pos")


@pytest.fixture(scope="module", params=TASKS, ids=lambda task: task.ENV_ID)
def task(request):
    return request.param


@pytest.fixture
def base(task, plain_env):
    return plain_env(task.GYM_ID).unwrapped


@pytest.fixture
def other(task, plain_env):
    """Another environment of the task, in the middle of another episode."""
    base = plain_env(task.GYM_ID, 1).unwrapped
    base.reset(seed=99)
    play(base, torch.rand(10, 1, 7, generator=torch.Generator().manual_seed(3)) - 0.5)
    return base


def play(base, actions):
    """Play actions (L, 1, Da); return the flat states after them, (L, D)."""
    states = []
    for action in actions:
        base.step(action)
        states.append(base.get_state()[0])
    return torch.stack(states)


def expert_until(task, env, steps):
    """Play the expert for so many steps; return the state there, flat too, then the actions and states that follow."""
    env.reset(seed=SEED, options={"reconfigure": True})
    base = env.unwrapped
    expert = EXPERTS.get(task.ENV_ID)(task.SPEC, 1, torch.device("cpu"), None)
    expert.reset(base.privileged_state(), [SEED], torch.ones(1, dtype=torch.bool))
    for _ in range(steps):
        env.step(expert.act(base.privileged_state()))
    state, flat, actions, states = base.get_state_dict(), base.get_state(), [], []
    for _ in range(AHEAD):
        actions.append(expert.act(base.privileged_state()))
        env.step(actions[-1])
        states.append(base.get_state()[0])
    return state, flat, torch.stack(actions), torch.stack(states)


def test_two_restores_give_the_same_future_to_the_bit_and_that_of_the_run_where_nothing_is_touched(task, base, other):
    state, flat, actions, uninterrupted = expert_until(task, base, FREE)
    base.set_state_dict(state)
    assert torch.equal(base.get_state(), flat)
    first = play(base, actions)
    torch.testing.assert_close(first, uninterrupted, atol=1e-5, rtol=0)  # velocities too: what sleeps goes on sleeping
    base.set_state(flat)
    assert torch.equal(play(base, actions), first)
    other.set_state_dict(state)
    assert torch.equal(play(other, actions), first)


def test_so_they_do_where_something_is_held_or_pushed(task, base, other):
    state, flat, actions, uninterrupted = expert_until(task, base, TOUCHING[task])
    base.set_state_dict(state)
    first = play(base, actions)
    # PhysX tells no state what it keeps of a contact: millimetres and milliradians, where other targets gave 10 cm.
    positions = [13 * k + axis for k in range(len(state["actors"])) for axis in range(3)]
    torch.testing.assert_close(first[:, positions], uninterrupted[:, positions], atol=3e-3, rtol=0)
    base.set_state_dict(state)
    assert torch.equal(play(base, actions), first)
    other.set_state(flat)
    assert torch.equal(play(other, actions), first)


def test_a_state_of_another_seed_has_not_failed(task, base):
    base.reset(seed=1)
    state = base.get_state_dict()
    base.reset(seed=2)
    base.set_state_dict(state)
    *_, info = base.step(torch.zeros(1, 7))
    assert not info["fail"].item()
    base.reset(seed=2)
    base.set_state(base.get_state())
    *_, info = base.step(torch.zeros(1, 7))
    assert not info["fail"].item()


def test_states_are_copies(task, base):
    def leaves(state):
        return [leaf for part in state.values() for leaf in (leaves(part) if isinstance(part, dict) else [part])]

    base.reset(seed=3)
    state = base.get_state_dict()
    kept = copy.deepcopy(leaves(state))
    expected = (
        2 * len(base.objects) + 1 + 3 + len(base.remembered)
    )  # objects and their sleep, robot, targets, the start
    assert len(kept) == expected
    base.set_state_dict(state)
    play(base, torch.ones(3, 1, 7))
    base.reset(seed=4)
    assert all(map(torch.equal, leaves(state), kept))


def test_an_edited_state_leaves_nothing_asleep_in_the_air(task, base):
    base.reset(seed=3)
    play(base, torch.zeros(12, 1, 7))
    state = base.get_state_dict()
    name = list(base.objects)[-1]
    assert state["asleep"][name][0, 0] == 1
    state["actors"][name][:, 2] += 0.05
    base.set_state_dict(state)
    play(base, torch.zeros(3, 1, 7))
    assert base.objects[name].pose.p[0, 2] < state["actors"][name][0, 2] - 0.01


@pytest.mark.parametrize("mode", MODES)
def test_every_control_mode_goes_on_from_its_targets(plain_env, mode):
    base = plain_env(slide_block.GYM_ID).unwrapped
    base.reset(seed=5)
    base.agent.set_control_mode(mode)
    base.agent.controller.reset()
    generator = torch.Generator().manual_seed(0)

    def actions(count):
        noise = 0.6 * torch.rand(count, 1, 7, generator=generator) - 0.3
        if mode == "pd_joint_pos":
            noise[..., :6] = base.agent.arm_qpos + 0.1 * noise[..., :6]
        elif mode == "pd_ee_pose":
            noise[..., :3] = base.agent.tcp_pose_at_base[:, :3] + 0.1 * noise[..., :3]
            noise[..., 3:6] = torch.tensor([torch.pi, 0, 0])
        return noise

    try:
        play(base, actions(12))
        state, ahead = base.get_state(), actions(AHEAD)
        went = play(base, ahead)
        base.set_state(state)
        torch.testing.assert_close(play(base, ahead), went, atol=1e-5, rtol=0)
        base.set_state(state)
        before = base.agent.arm_qpos
        for _ in range(20):
            base.step(None)  # the drives steer to the targets of the state
        assert (base.agent.arm_qpos - before).abs().max() < 0.5
    finally:
        base.agent.set_control_mode(task_mode := slide_block.SPEC.action.control_mode)
        assert base.agent.control_mode == task_mode


# ---- earlier layouts ------------------------------------------------------------------------------------------------


def test_states_of_the_earlier_layout_load_and_leave_the_rest_as_the_reset_made_it(task, base):
    state, _, actions, _ = expert_until(task, base, 0)  # of the start, where targets are what is measured
    base.set_state_dict(state)
    expected = play(base, actions)
    earlier = {name: state[name] for name in ("actors", "articulations")}
    with_pose = earlier | {"controller": {"arm": {"target_pose": state["controller"]["arm"]["target_pose"]}}}
    for layout in (earlier, with_pose):
        flat = torch.cat([v for part in layout.values() for v in flat_leaves(part)], dim=1)
        for put in (lambda layout=layout: base.set_state_dict(layout), lambda flat=flat: base.set_state(flat)):
            base.reset(seed=SEED)
            put()
            assert torch.equal(play(base, actions), expected)


def flat_leaves(part):
    for value in part.values():
        yield from flat_leaves(value) if isinstance(value, dict) else [value]


def test_a_flat_state_of_another_length_is_refused_in_one_line(task, base):
    with pytest.raises(
        ConfigError, match=r"a state of \w+Env in this control mode has \d+ numbers .*, got 12: "
    ) as error:
        base.set_state(torch.zeros(1, 12))
    assert "\n" not in str(error.value)


# ---- ManiSkill's tools ----------------------------------------------------------------------------------------------


def test_recorded_states_go_on_as_the_recording_did(task, plain_env, other, tmp_path):
    recorder = RecordEpisode(plain_env(task.GYM_ID), str(tmp_path), trajectory_name="t", save_video=False)
    _, _, actions, _ = expert_until(task, recorder, FREE)
    recorder.flush_trajectory()
    with h5py.File(tmp_path / "t.h5") as file:
        rows = trajectory_utils.dict_to_list_of_dicts(file["traj_0/env_states"])
        played = torch.from_numpy(file["traj_0/actions"][:])
    recorder._h5_file.close()  # not the environment, which others use
    assert len(rows) == len(played) + 1 == FREE + AHEAD + 1
    assert rows[0]["controller"]["gripper"]["target_qpos"].shape == (2,)
    other.set_state_dict(rows[FREE])
    assert torch.equal(actions[:, 0], played[FREE:])
    reached = play(other, actions)[-1]
    wanted = torch.cat([torch.from_numpy(np.atleast_1d(leaf)) for leaf in flat_leaves(rows[-1])])
    torch.testing.assert_close(reached, wanted, atol=1e-5, rtol=0)


def test_cached_resets_keep_the_targets(plain_env):
    """ManiSkill resets the controllers after it has set the state: those would take what is measured as the target."""
    env = plain_env(stack_cube.GYM_ID)
    state, _, actions, _ = expert_until(stack_cube, env.unwrapped, FREE)
    env.unwrapped.set_state_dict(state)
    expected = play(env.unwrapped, actions)
    cached = CachedResetWrapper(env, {"env_states": state})
    cached.reset()
    assert torch.equal(play(env.unwrapped, actions), expected)
    env.unwrapped.reset(seed=0)
    agent = env.unwrapped.agent
    assert torch.equal(agent.tcp_target_pose, agent.tcp_pose_at_base), "a new episode starts from what is measured"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A solved Stack Cube episode, as ManiSkill's recorder writes it, and the same as earlier versions wrote it."""
    folder = tmp_path_factory.mktemp("recording")
    env = gym.make(stack_cube.GYM_ID, num_envs=1, obs_mode="none", reward_mode="sparse", sim_backend="physx_cpu")
    recorder = RecordEpisode(env, str(folder), trajectory_name="now", save_video=False)
    recorder.reset(seed=SEED, options={"reconfigure": True})
    expert = EXPERTS.get(stack_cube.ENV_ID)(stack_cube.SPEC, 1, torch.device("cpu"), None)
    expert.reset(env.unwrapped.privileged_state(), [SEED], torch.ones(1, dtype=torch.bool))
    done = False
    while not done:
        *_, terminated, truncated, info = recorder.step(expert.act(env.unwrapped.privileged_state()))
        done = bool(terminated | truncated)
    assert info["success"].item()
    recorder.close()
    for kind in (".h5", ".json"):
        shutil.copy(folder / f"now{kind}", folder / f"earlier{kind}")
    with h5py.File(folder / "earlier.h5", "a") as file:
        states = file["traj_0/env_states"]
        for part in ("asleep", "task", "controller/gripper", "controller/arm/target_qpos"):
            del states[part]
    return folder


@pytest.mark.parametrize(
    ("version", "options", "solved"),
    [
        ("now", ["--use-env-states", "--save-traj"], True),
        ("now", ["--use-first-env-state", "--save-traj"], True),
        ("earlier", ["--save-traj"], True),
        ("earlier", ["--use-env-states"], True),
        ("earlier", ["--use-env-states", "--save-traj"], False),  # ManiSkill copies what earlier files do not hold
    ],
)
def test_maniskills_replay(recording, tmp_path, version, options, solved, capsys):
    for kind in (".h5", ".json"):
        shutil.copy(recording / f"{version}{kind}", tmp_path / f"{version}{kind}")
    arguments = replay_trajectory.parse_args(["--traj-path", str(tmp_path / f"{version}.h5"), *options])
    if not solved:
        with pytest.raises(KeyError, match="target_qpos"):
            replay_trajectory.main(arguments)
        return
    replay_trajectory.main(arguments)
    assert "1/1=100.00% demos saved" in capsys.readouterr().out
    if "--save-traj" in options:
        (written,) = [path for path in tmp_path.glob("*.h5") if path.name != f"{version}.h5"]
        with h5py.File(written) as file:
            assert file["traj_0/env_states/task/white_start"].shape[1] == 7
