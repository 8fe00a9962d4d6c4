"""A fake that lets the batched code of any task run on N rows without a simulator: a CPU scene has but one row.

The fakes keep ManiSkill's rule: a setter writes the rows of `scene._reset_mask`, and takes one value for each of them.
What the task itself does, from `_load_objects` to `reward_terms`, is the task's own code, and so is the test of a grasp
(`UR3eAG95.is_grasping`); only bodies, joints and contact forces are made up here.
"""

import torch
from mani_skill.envs.utils.randomization.batched_rng import BatchedRNG
from mani_skill.utils.structs import Pose

from manicm_ms.robots.ur3e_ag95 import UR3eAG95


class FakeScene:
    """Which rows are being reset, and which forces (N, 3) act between two bodies."""

    def __init__(self, n):
        self._reset_mask = torch.ones(n, dtype=torch.bool)
        self.forces = {}

    def get_pairwise_contact_forces(self, first, second):
        return self.forces.get((first, second), torch.zeros(len(self._reset_mask), 3))

    def write(self, rows, values):
        """Write `values` into the rows being reset, one for each of them."""
        mask = self._reset_mask
        if len(values) != int(mask.sum()):
            raise AssertionError(f"{len(values)} values for {int(mask.sum())} rows being reset")
        rows[mask] = values.to(rows.dtype)


class FakeActor:
    def __init__(self, scene, n):
        self._scene = scene
        self.raw = torch.zeros(n, 7)
        self.raw[:, 3] = 1.0
        self.linear_velocity, self.angular_velocity = torch.zeros(n, 3), torch.zeros(n, 3)

    @property
    def pose(self):
        return Pose.create(self.raw.clone())

    def set_pose(self, pose):
        self._scene.write(self.raw, pose.raw_pose)

    def is_static(self, lin_thresh, ang_thresh):
        return (self.linear_velocity.norm(dim=1) <= lin_thresh) & (self.angular_velocity.norm(dim=1) <= ang_thresh)


class FakeBuilder:
    def __init__(self, scene, n):
        self.build = self.build_kinematic = self.build_static = lambda name: FakeActor(scene, n)


class FakeRobot:
    def __init__(self, n):
        self.qpos = torch.zeros(n, 8)
        self.set_pose = lambda pose: None  # the base never moves
        self.get_qpos = lambda: self.qpos


class FakeAgent:
    _finger_columns = (6, 7)
    device = torch.device("cpu")
    opening = UR3eAG95.opening
    pad_forces = UR3eAG95.pad_forces
    is_grasping = UR3eAG95.is_grasping

    def __init__(self, scene, n):
        self.scene, self.robot = scene, FakeRobot(n)
        self.tcp, self.left_finger, self.right_finger = (FakeActor(scene, n) for _ in range(3))

    def reset(self, qpos):
        self.scene.write(self.robot.qpos, qpos)

    @property
    def tcp_pose(self):
        return self.tcp.pose


class FakeTask:
    """N rows of a task: everything that is not made up here is looked up in the environment class and bound to this."""

    device = torch.device("cpu")

    def __init__(self, env_class, n):
        self._env_class, self.num_envs = env_class, n
        self.scene = FakeScene(n)
        self.agent = FakeAgent(self.scene, n)
        self.half_sizes, self.base_position = {}, torch.zeros(n, 3)
        self.objects = self._load_objects()
        self._batched_episode_rng = BatchedRNG.from_seeds([0] * n)

    def __getattr__(self, name):
        found = getattr(object.__getattribute__(self, "_env_class"), name)
        return found.__get__(self) if hasattr(found, "__get__") else found

    def build_box(self, name, half_size, color, *, friction, mass=None):
        self.half_sizes[name] = torch.tensor([half_size]).repeat(self.num_envs, 1)
        return FakeBuilder(self.scene, self.num_envs)

    def build_boxes(self, name, parts, color, *, friction, mass=None):
        return FakeBuilder(self.scene, self.num_envs)

    def reset(self, rows, seeds):
        """Reset `rows` with `seeds`, as ManiSkill does for `options={"env_idx": rows}`."""
        rows = torch.as_tensor(rows)
        self.scene._reset_mask = torch.zeros(self.num_envs, dtype=torch.bool)
        self.scene._reset_mask[rows] = True
        self._batched_episode_rng[rows] = BatchedRNG.from_seeds(list(seeds))
        self._initialize_episode(rows, {})
        self.scene._reset_mask[:] = True

    def hold(self, name, newtons, row=0):
        """Let both pads press on an object, each with `newtons` along its own opening direction."""
        for finger in (self.agent.left_finger, self.agent.right_finger):
            self.press(finger, name, (newtons, 0.0, 0.0), row)

    def press(self, finger, name, force, row=0):
        """Let an object press on a finger with a force (3,) N."""
        key = (finger, self.objects[name])
        self.scene.forces.setdefault(key, torch.zeros(self.num_envs, 3))[row] = torch.tensor(force)

    def tensors(self):
        """Return everything that rows keep, by name, (N, ...) each; writing into them changes the rows."""
        bodies = self.objects | {part: getattr(self.agent, part) for part in ("tcp", "left_finger", "right_finger")}
        kept = {name: value for name, value in vars(self).items() if isinstance(value, torch.Tensor)}
        kept |= {f"{name} size": value for name, value in self.half_sizes.items()}
        for name, body in bodies.items():
            kept |= {f"{name} pose": body.raw, f"{name} v": body.linear_velocity, f"{name} w": body.angular_velocity}
        for thing, actor in self.objects.items():
            for side, finger in (("left", self.agent.left_finger), ("right", self.agent.right_finger)):
                force = self.scene.forces.setdefault((finger, actor), torch.zeros(self.num_envs, 3))
                kept[f"{thing} on {side}"] = force
        return kept | {"qpos": self.agent.robot.qpos}

    def single(self, row):
        """Return a one-row copy of a row."""
        one = FakeTask(self._env_class, 1)
        mine = self.tensors()
        for name, value in one.tensors().items():
            value.copy_(mine[name][row : row + 1])
        return one


def fresh(env_class, n, first_seed=0):
    """Return N rows at the start of the episodes first_seed, first_seed + 1, ..."""
    env = FakeTask(env_class, n)
    env.reset(range(n), range(first_seed, first_seed + n))
    return env


def flags(env, untouched):
    """Return the names of the facts that hold in row 0; the other rows must show exactly those of `untouched`."""
    facts = {name: values.tolist() for name, values in env.evaluate().items()}
    for name, values in facts.items():
        assert values[1:] == [name in untouched] * (env.num_envs - 1), f"{name} of the untouched rows"
    return {name for name, values in facts.items() if values[0]}


def turned(angle, axis):
    """Return the quaternion wxyz of a rotation by `angle` rad about a coordinate axis (0, 1, 2)."""
    q = torch.zeros(4)
    q[0], q[1 + axis] = torch.cos(torch.tensor(angle / 2)), torch.sin(torch.tensor(angle / 2))
    return q
