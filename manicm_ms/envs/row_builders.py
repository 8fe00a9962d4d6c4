"""One body in every row of a scene, built differently in each."""

from __future__ import annotations

from collections.abc import Sequence

import sapien
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.building.actor_builder import ActorBuilder
from mani_skill.utils.structs import Actor


class RowBuilders:
    """Builds one actor whose row k is what `builders[k]` describes; used in place of a single `ActorBuilder`.

    Args:
        scene: the scene of all rows.
        builders: one a row.
    """

    def __init__(self, scene: ManiSkillScene, builders: Sequence[ActorBuilder]) -> None:
        self.scene, self._builders = scene, list(builders)
        for row, builder in enumerate(self._builders):
            builder.set_scene_idxs([row])

    @property
    def initial_pose(self) -> sapien.Pose:
        """Where the bodies stand before the first episode places them."""
        return self._builders[0].initial_pose

    @initial_pose.setter
    def initial_pose(self, pose: sapien.Pose) -> None:
        for builder in self._builders:
            builder.initial_pose = pose

    def build(self, name: str) -> Actor:
        """Build a body that moves."""
        return self._merged(name, [builder.build(f"{name}-{row}") for row, builder in enumerate(self._builders)])

    def build_static(self, name: str) -> Actor:
        """Build a body that never moves."""
        return self._merged(name, [builder.build_static(f"{name}-{row}") for row, builder in enumerate(self._builders)])

    def build_kinematic(self, name: str) -> Actor:
        """Build a body that moves only where it is put."""
        rows = enumerate(self._builders)
        return self._merged(name, [builder.build_kinematic(f"{name}-{row}") for row, builder in rows])

    def _merged(self, name: str, actors: list[Actor]) -> Actor:
        """Return one view of all rows, which recordings of states know under the one name."""
        for actor in actors:
            self.scene.remove_from_state_dict_registry(actor)
        merged = Actor.merge(actors, name=name)
        self.scene.add_to_state_dict_registry(merged)
        return merged
