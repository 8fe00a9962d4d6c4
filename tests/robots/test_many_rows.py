"""What a GPU would run, on a CPU: controllers that are reset in some rows only, and ManiSkill's batched IK."""

from types import SimpleNamespace

import gymnasium as gym
import pytest
import torch
from mani_skill.utils.structs import Pose

import manicm_ms.envs.maniskill  # noqa: F401  (chooses the Vulkan driver before SAPIEN is imported)

from manicm_ms.tasks import stack_cube  # isort: skip

from manicm_ms.demos.experts import EXPERTS
from manicm_ms.robots import memory
from manicm_ms.robots.controllers import LimitedPoseController, OpeningController

N = 4


def poses(n, seed):
    raw = torch.rand(n, 7, generator=torch.Generator().manual_seed(seed))
    raw[:, 3:] /= raw[:, 3:].norm(dim=1, keepdim=True)
    return Pose.create(raw)


def rows_of(controller_class, joints):
    """Return a controller of N rows whose targets differ from what is measured, with a scene that resets all rows."""
    controller = controller_class.__new__(controller_class)
    controller.scene = SimpleNamespace(_reset_mask=torch.ones(N, dtype=torch.bool))
    controller.config = SimpleNamespace(use_target=True)
    controller.articulation = SimpleNamespace(get_qpos=lambda: torch.arange(N * joints).float().view(N, joints))
    controller.active_joint_indices = torch.arange(joints)
    controller.ee_link = SimpleNamespace(pose=poses(N, 0))
    controller.root_link = SimpleNamespace(pose=Pose.create(torch.tensor([[0.0, 0, 0, 1, 0, 0, 0]]).repeat(N, 1)))
    controller._target_pose = poses(N, 1)
    controller._start_qpos, controller._target_qpos = torch.full((N, joints), -1.0), torch.full((N, joints), -2.0)
    return controller


@pytest.mark.parametrize(("controller_class", "joints"), [(LimitedPoseController, 6), (OpeningController, 2)])
def test_rows_that_go_on_keep_their_targets(controller_class, joints):
    controller = rows_of(controller_class, joints)
    controller.beginning = torch.tensor([True, False, True, False])
    controller.reset()
    measured = controller.articulation.get_qpos()
    assert torch.equal(controller._target_qpos[[0, 2]], measured[[0, 2]])
    assert (controller._target_qpos[[1, 3]] == -2).all()
    if controller_class is LimitedPoseController:
        assert torch.equal(controller._target_pose.raw_pose[[1, 3]], poses(N, 1).raw_pose[[1, 3]])
        torch.testing.assert_close(controller._target_pose.raw_pose[[0, 2]], poses(N, 0).raw_pose[[0, 2]])


@pytest.mark.parametrize(("controller_class", "joints"), [(LimitedPoseController, 6), (OpeningController, 2)])
def test_the_rows_are_used_up_and_the_scenes_mask_is_put_back(controller_class, joints):
    controller = rows_of(controller_class, joints)
    controller.beginning = torch.tensor([True, False, False, False])
    controller.reset()
    assert controller.scene._reset_mask.all()
    controller.reset()  # as when a control mode is chosen: nobody named rows
    assert torch.equal(controller._target_qpos, controller.articulation.get_qpos())


@pytest.fixture(scope="module")
def env():
    env = gym.make(stack_cube.GYM_ID, num_envs=1, obs_mode="none", sim_backend="physx_cpu")
    env.reset(seed=0)
    yield env
    env.close()


def test_the_agent_names_the_rows_at_every_reset(env, monkeypatch):
    named = []
    plain = LimitedPoseController.reset
    monkeypatch.setattr(LimitedPoseController, "reset", lambda self: (named.append(self.beginning), plain(self))[1])
    env.reset(seed=1)
    assert [mask.tolist() for mask in named] == [[True]]


def test_the_expert_succeeds_with_the_batched_ik_that_a_gpu_would_use(env):
    """One Levenberg-Marquardt step on pytorch_kinematics' Jacobian a control step; else Pinocchio iterates."""
    kinematics = env.unwrapped.agent.controller.controllers["arm"].kinematics
    kinematics._setup_gpu()
    assert kinematics.use_gpu_ik
    assert int(kinematics.qmask.sum()) == len(kinematics.qmask) == 6, "every joint of the chain is controlled"
    env.reset(seed=0)
    base = env.unwrapped
    expert = EXPERTS.get(stack_cube.ENV_ID)(stack_cube.SPEC, 1, torch.device("cpu"), None)
    expert.reset(base.privileged_state(), [0], torch.ones(1, dtype=torch.bool))
    worst = 0.0
    for _ in range(stack_cube.MAX_EPISODE_STEPS):
        _, _, terminated, _, info = env.step(expert.act(base.privileged_state()))
        arm = base.agent.controller.controllers["arm"]
        qpos = base.agent.robot.get_qpos().clone()
        qpos[:, :6] = arm._target_qpos
        reached = kinematics.pk_chain.forward_kinematics(qpos[:, kinematics.active_ancestor_joint_idxs]).get_matrix()
        worst = max(worst, (reached[:, :3, 3] - arm._target_pose.p).norm().item())
        if terminated.item():
            break
    assert info["success"].item()
    assert worst < 5e-3, "the joints' targets follow the tool's target"


# ---- memory ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("controller_class", "joints"), [(LimitedPoseController, 6), (OpeningController, 2)])
def test_memory_is_taken_back_in_the_marked_rows_as_a_copy(controller_class, joints):
    controller = rows_of(controller_class, joints)
    driven = []
    controller.joints = controller.articulation.set_joint_drive_targets = lambda targets, *_: driven.append(targets)
    told = memory.of(controller)
    wanted = {name: values[:2] + 1 for name, values in told.items()}
    controller.scene._reset_mask = torch.tensor([True, False, True, False])
    controller.beginning = torch.ones(N, dtype=torch.bool)
    memory.restore(controller, wanted)
    now = memory.of(controller)
    for name, values in told.items():
        assert torch.equal(now[name][[0, 2]], wanted[name])
        assert torch.equal(now[name][[1, 3]], values[[1, 3]])
        wanted[name].zero_()  # what was given and what is told are nobody's live tensor
        now[name].zero_()
        assert memory.of(controller)[name].abs().sum() > 0
    assert torch.equal(driven[-1], controller._target_qpos)
    controller.scene._reset_mask = torch.ones(N, dtype=torch.bool)
    controller.reset()  # in the middle of an environment's reset: the restored rows do not begin
    measured = controller.articulation.get_qpos()
    assert torch.equal(controller._target_qpos[[1, 3]], measured[[1, 3]])
    assert not torch.equal(controller._target_qpos[[0, 2]], measured[[0, 2]])
