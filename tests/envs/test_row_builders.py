"""What a batch of rows needs of realism, on N rows: bodies built row by row, and resets of all rows at once.

No batch can be simulated without a GPU; several real scenes on the CPU stand in for its rows.
"""

import numpy as np
import pytest
import sapien
import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.envs.utils.system.backend import parse_sim_and_render_backend

from manicm_ms.envs.maniskill import ManiSkillSimulator
from manicm_ms.envs.row_builders import RowBuilders
from manicm_ms.envs.simulator import SimulatorConfig
from manicm_ms.envs.ur3e_tabletop import UR3eTabletopEnv
from manicm_ms.errors import ConfigError
from manicm_ms.sensing.realism import REALISM, Realism, RealismRows

N = 3


class Rows:
    """The builder's methods of the tasks' base, unbound, on N real scenes without a renderer."""

    num_envs, device = N, torch.device("cpu")
    build_box, build_boxes = UR3eTabletopEnv.build_box, UR3eTabletopEnv.build_boxes
    _row_builders, _builder = UR3eTabletopEnv._row_builders, UR3eTabletopEnv._builder

    def __init__(self, realism):
        backend = parse_sim_and_render_backend("physx_cpu", "none")
        scenes = [sapien.Scene([sapien.physx.PhysxCpuSystem()]) for _ in range(N)]
        self.scene = ManiSkillScene(scenes, device=self.device, backend=backend)
        self.realism, self.half_sizes = realism, {}


@pytest.fixture
def drawn():
    return RealismRows([REALISM.get("d435i+dr").sample(seed, ("cube", "tray")) for seed in range(N)])


def test_each_row_gets_its_own_body(drawn):
    rows = Rows(drawn)
    builder = rows.build_box("cube", (0.03, 0.02, 0.01), (0.5, 0.5, 0.5, 1.0), friction=0.4, mass=0.2)
    assert isinstance(builder, RowBuilders)
    cube = builder.build(name="cube")
    bodies = [entity.find_component_by_type(sapien.physx.PhysxRigidDynamicComponent) for entity in cube._objs]
    assert [body.entity.scene for body in bodies] == rows.scene.sub_scenes
    shapes = [body.collision_shapes[0] for body in bodies]
    np.testing.assert_allclose([body.mass for body in bodies], 0.2 * drawn["cube.mass_factor"], rtol=1e-6)
    frictions = [shape.physical_material.static_friction for shape in shapes]
    np.testing.assert_allclose(frictions, 0.4 * drawn["cube.friction_factor"], rtol=1e-6)
    sizes = np.array([0.03, 0.02, 0.01]) * drawn["cube.size_factor"][:, None]
    np.testing.assert_allclose([shape.half_size for shape in shapes], sizes, rtol=1e-6)
    np.testing.assert_allclose(rows.half_sizes["cube"], sizes, rtol=1e-6)
    assert len(set(frictions)) == N


def test_the_rows_are_one_actor_to_those_who_record_states(drawn):
    rows = Rows(drawn)
    box = ((0.0, 0.0, 0.0), (0.1, 0.1, 0.01))
    builder = rows.build_boxes("tray", [box], (0.5, 0.5, 0.5, 1.0), friction=0.6)
    builder.initial_pose = sapien.Pose((0.1, 0.2, 0.3))
    tray = builder.build_kinematic(name="tray")
    assert list(rows.scene.state_dict_registry.actors) == ["tray"]
    assert tray.px_body_type == "kinematic"
    assert len(tray._objs) == N
    assert all(np.allclose(entity.pose.p, (0.1, 0.2, 0.3)) for entity in tray._objs)
    assert "tray" not in rows.half_sizes


def test_without_realism_one_builder_serves_all_rows():
    builder = Rows(None).build_box("cube", (0.03,) * 3, (0.5, 0.5, 0.5, 1.0), friction=0.4, mass=0.2)
    assert not isinstance(builder, RowBuilders)


def options(realism, reset):
    """Return how a simulator of N rows asks ManiSkill to reset `reset` of them."""
    simulator = ManiSkillSimulator.__new__(ManiSkillSimulator)  # its constructor needs the GPU
    simulator.config = SimulatorConfig(num_rows=N, realism=realism)
    simulator.num_rows, simulator.device, simulator._values = N, torch.device("cpu"), RealismRows([{}] * N)
    return simulator._reset_options(torch.as_tensor(reset))


def test_part_of_a_batch_cannot_be_reset_where_scenes_are_built_anew():
    with pytest.raises(ConfigError, match=r"2 of 3 rows cannot be reset alone.*use backend 'cpu', reset every row"):
        options(REALISM.get("d435i+dr"), [0, 2])
    assert options(REALISM.get("d435i+dr"), [0, 1, 2])["reconfigure"]


@pytest.mark.parametrize("realism", [Realism(), REALISM.get("d435i"), Realism(action_delay=2, lighting=1)])
def test_part_of_a_batch_can_be_reset_where_scenes_stay(realism):
    assert options(realism, [0, 2])["env_idx"].tolist() == [0, 2]
