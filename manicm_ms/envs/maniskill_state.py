"""ManiSkill's state contract: what a state holds, as a dictionary and flat, and a physics scene without a past.

A state of a UR3e task holds, each a copy with N rows::

    actors         each object: pose (7), linear and angular velocity (6)
    articulations  the robot: root pose (7), root velocities (6), joint positions, joint velocities
    controller     what the active controllers remember (manicm_ms.robots.memory)
    asleep         each object: 1 where PhysX lets it sleep, else 0, and the position (3) that this was found at
    task           what the task remembers of its start (`RestorableEnv.remembered`)

Earlier trajectories have no `asleep` and no `task`, and of `controller` the arm's target pose at most. What a state
lacks stays as the environment has it: after `reset` with the episode's seed, as in ManiSkill's replay, that is what it
was (docs/decisions/0018).
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.scene import ManiSkillScene
from torch import Tensor

from manicm_ms.errors import ConfigError
from manicm_ms.robots.memory import replaced_rows

StateDict = dict[str, Any]


def renew_physics(scene: ManiSkillScene) -> None:
    """Move everything in the scene of a CPU into a new PhysX scene; pictures, objects and their states stay.

    PhysX keeps something of earlier contacts that no state holds and that nothing clears (docs/decisions/0010): in a
    used scene, the same state and actions end elsewhere by millimetres as soon as something is touched. The move takes
    1 ms.
    """
    (old,) = scene.sub_scenes
    physics = sapien.physx.PhysxCpuSystem()
    physics.timestep = scene.px.timestep
    new = sapien.Scene([physics] if old.render_system is None else [physics, old.render_system])
    entities = list(old.entities)
    for entity in entities:  # all of them first: an articulation cannot be in two scenes at once
        old.remove_entity(entity)
    for entity in entities:
        new.add_entity(entity)
    scene.sub_scenes[0], scene.px = new, physics


def asleep(scene: ManiSkillScene) -> StateDict:
    """Return what sleeps: name of each object -> (N, 4), a flag and its position; on a GPU the flag is always 0."""
    told = {}
    for name, actor in scene.state_dict_registry.actors.items():
        if actor.px_body_type == "static":
            continue
        told[name] = torch.cat([torch.zeros(len(actor.pose.p), 1, device=actor.pose.p.device), actor.pose.p], dim=1)
        if actor.px_body_type == "dynamic" and not scene.gpu_sim_enabled:
            told[name][:, 0] = float(actor._bodies[0].is_sleeping)
    return told


def put_to_sleep(scene: ManiSkillScene, told: StateDict) -> None:
    """Let the objects sleep that `asleep` told of, on a CPU; an object that PhysX has at rest must not be shaken awake.

    Where an object stands elsewhere than when it was told, the state was edited and all stay awake: one that lost its
    support would float.
    """
    if scene.gpu_sim_enabled:
        return
    flags = {name: torch.as_tensor(values).view(-1, 4) for name, values in told.items()}
    actors = {name: scene.state_dict_registry.actors[name] for name in flags}
    if all(torch.equal(flags[name][:, 1:], actors[name].pose.p) for name in flags):
        for name, actor in actors.items():
            if flags[name][0, 0]:
                actor._bodies[0].put_to_sleep()


@contextmanager
def only_rows(scene: ManiSkillScene, env_idx: Tensor | None) -> Iterator[Tensor]:
    """Let ManiSkill's setters write into the rows `env_idx` (None: those of the present mask); yield the mask (N,)."""
    before = scene._reset_mask
    if env_idx is not None:
        scene._reset_mask = torch.zeros_like(before)
        scene._reset_mask[env_idx] = True
    try:
        yield scene._reset_mask
    finally:
        scene._reset_mask = before


def unflatten(flat: Tensor, present: StateDict, env_id: str) -> StateDict:
    """Return the state dictionary of a flat state (rows, D), of the present layout or one of earlier versions.

    Args:
        flat: as `get_state` returned it.
        present: a state dictionary of the present layout.
        env_id: for the error.

    Raises ConfigError where it has another length than any layout.
    """
    bodies: StateDict = {name: present[name] for name in ("actors", "articulations") if name in present}
    arm = present.get("controller", {}).get("arm", {})
    earlier: StateDict = bodies | {"controller": {"arm": {name: arm[name] for name in ("target_pose",) if name in arm}}}
    layouts = (present, bodies, earlier)
    lengths = [_length(layout) for layout in layouts]
    if flat.shape[1] not in lengths:
        raise ConfigError(
            f"a state of {env_id} in this control mode has {lengths[0]} numbers ({sorted(set(lengths[1:]))} in earlier "
            f"versions), got {flat.shape[1]}: it is of another task, robot or control mode"
        )
    state, rest = _take(layouts[lengths.index(flat.shape[1])], flat)
    assert not rest.shape[1]
    return state


def _length(layout: StateDict) -> int:
    return sum(_length(part) if isinstance(part, dict) else part.shape[1] for part in layout.values())


def _take(layout: StateDict, flat: Tensor) -> tuple[StateDict, Tensor]:
    """Return the dictionary laid out like `layout` from the first columns, and the other columns."""
    state: StateDict = {}
    for name, part in layout.items():
        if isinstance(part, dict):
            state[name], flat = _take(part, flat)
        else:
            state[name], flat = flat[:, : part.shape[1]], flat[:, part.shape[1] :]
    return state, flat


class RestorableEnv(BaseEnv):
    """A ManiSkill environment whose states bring back all that its future depends on.

    Its agent tells what its controllers remember, and takes it back in the rows of `scene._reset_mask`.
    """

    remembered: ClassVar[tuple[str, ...]] = ()
    """Attributes, float tensors (N, k), that keep something of an episode's start: part of the state."""

    def get_state_dict(self) -> StateDict:
        """Return copies of all that the future depends on beside the scene itself: see the module.

        Not in it, as ManiSkill has it: the steps played, and what a scene is built of (sizes, masses, frictions).
        """
        state: StateDict = super().get_state_dict()
        state["asleep"] = asleep(self.scene)
        if self.remembered:
            state["task"] = {name: getattr(self, name).clone() for name in self.remembered}
        return state

    def set_state_dict(self, state: StateDict, env_idx: Tensor | None = None) -> None:
        """Bring back a state, in the rows `env_idx` or in all; parts that it lacks stay as they are.

        On a CPU the same state and actions always give the same future, bit for bit, in this environment and in
        others. From the run that was not interrupted, poses part by less than 1e-5 while nothing is held or pushed;
        then by up to some millimetres within 15 steps, for PhysX does not tell what it keeps of a contact.
        """
        if not self.gpu_sim_enabled:
            renew_physics(self.scene)
            if self._viewer is not None:
                self._setup_viewer()
        super().set_state_dict(state, env_idx)
        with only_rows(self.scene, env_idx) as rows:
            self.agent.set_controller_state(state.get("controller", {}))
            for name, values in state.get("task", {}).items():
                setattr(self, name, replaced_rows(getattr(self, name), rows, values))
        put_to_sleep(self.scene, state.get("asleep", {}))

    def set_state(self, state: Any, env_idx: Tensor | None = None) -> None:
        """Bring back what `get_state` returned, (rows, D), now or in an earlier version; see `set_state_dict`.

        Raises ConfigError for another D.
        """
        flat = torch.atleast_2d(torch.as_tensor(state, device=self.device))
        self.set_state_dict(unflatten(flat, self.get_state_dict(), type(self).__name__), env_idx)
