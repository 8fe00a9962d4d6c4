"""The experts' benchmark: its torques are those of inverse dynamics, and it goes on where it was stopped."""

import itertools
import json

import numpy as np
import pytest
import torch

from manicm_ms.bench import expert as bench_expert
from manicm_ms.cli import main
from manicm_ms.demos.experts import EXPERTS
from manicm_ms.envs.chunk import ActionChunk
from manicm_ms.envs.simulator import ENVS, SimulatorConfig
from manicm_ms.robots.ur3e_ag95 import JOINT_EFFORT
from manicm_ms.spec import STATE

ENV_ID, STEPS, DT = "ur3e/slide-block", 20, 1 / 200


@pytest.fixture(scope="module")
def measured():
    """Torques, joint positions and velocities of every physics step of some control steps of an expert."""
    torch.set_num_threads(1)
    config = SimulatorConfig(obs=(STATE,))
    entry = ENVS.get(ENV_ID)
    rows = ActionChunk(entry.build(config.specialise(entry.spec), config))
    meter = bench_expert.TorqueMeter(rows.simulator)
    history, _ = rows.reset(torch.zeros(1, dtype=torch.int64), [0])
    meter.start()
    expert = EXPERTS.get(ENV_ID)(entry.spec, 1, torch.device("cpu"), None)
    expert.reset(history[STATE][:, -1], [0], torch.ones(1, dtype=torch.bool))
    robot, motion, sample = meter._robot, [], meter._sample

    def note():
        sample()
        motion.append((robot.get_qpos().astype(float), robot.get_qvel().astype(float)))

    rows.simulator.env._after_simulation_step = note
    for _ in range(STEPS):
        history, _, _ = rows.step(expert.act(history[STATE][:, -1])[:, None])
    yield meter, np.array(motion)
    rows.simulator.close()


def dynamics(meter, qpos, qvel, acceleration):
    return np.asarray(meter._model.compute_inverse_dynamics(qpos, qvel, acceleration)).ravel()


def test_torque_is_what_the_motion_needs(measured):
    """Newton-Euler (Pinocchio) of the positions, velocities and accelerations seen, without gravity."""
    meter, motion = measured
    assert len(motion) == len(meter.drive) == STEPS * 10
    still = np.zeros(8)
    needed = []
    for (_, before), (qpos, qvel) in itertools.pairwise(motion):
        needed.append(dynamics(meter, qpos, qvel, (qvel - before) / DT) - dynamics(meter, qpos, still, still))
    needed, torque = np.array(needed)[:, :6], np.array(meter.drive)[1:, :6]
    assert np.abs(needed).max() > 5.0, "or there is nothing to compare"
    np.testing.assert_allclose(torque, needed, atol=0.03 * np.abs(needed).max())
    for joint in range(4):  # the last two hardly move
        assert np.corrcoef(torque[:, joint], needed[:, joint])[0, 1] > 0.99


def test_the_weight_is_added_for_the_real_arm(measured):
    meter, motion = measured
    weight = np.array(meter.real) - np.array(meter.drive)
    still = np.zeros(8)
    np.testing.assert_allclose(weight[-1], dynamics(meter, motion[-1][0], still, still), atol=1e-6)
    assert abs(weight[-1][1]) > 5.0, "the shoulder carries the arm"
    assert abs(weight[-1][0]) < 1e-3, "the pan joint turns about the vertical"


def test_the_largest_are_of_each_arm_joint(measured):
    meter, _ = measured
    drive, real = meter.largest()
    assert drive.shape == real.shape == (6,)
    np.testing.assert_array_equal(drive, np.abs(meter.drive).max(axis=0)[:6])
    assert (real < JOINT_EFFORT).all()


def test_episodes_on_disk_are_not_played_again(tmp_path):
    records = tmp_path / "expert.jsonl"
    first = bench_expert.run(ENV_ID, "one-sided", range(1), records)
    with records.open("a") as file:
        file.write('{"seed": 1, "succ')  # as a kill leaves it
    altered = json.loads(records.read_text().splitlines()[0]) | {"steps": 999}
    records.write_text("\n".join([json.dumps(altered), *records.read_text().splitlines()[1:]]))
    both = bench_expert.run(ENV_ID, "one-sided", range(2), records)
    assert both[0].steps == 999, "read, not played"
    assert both[1].success
    again = bench_expert.run(ENV_ID, "one-sided", range(2), records)
    assert [episode.seed for episode in again] == [0, 1]
    np.testing.assert_allclose(again[1].joint_torque, both[1].joint_torque)
    assert first[0].joint_speed.shape == (6,)
    page = bench_expert._page(2, {"ur3e/slide-block": again}, "manicm-ms bench expert --episodes 2")
    assert "2/2" in page
    assert "| elbow | 28.0 |" in page
    assert page.endswith("Made by `manicm-ms bench expert --episodes 2`.\n")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--env", "ur3e/slide-blok"], "did you mean 'ur3e/slide-block'"),
        (["--env", "ur3e/stack-cube", "--styles", "two-sided"], "two-sided"),
        (["--episodes", "0"], "at least 1"),
    ],
)
def test_bad_input_is_one_line_and_plays_nothing(words, said, tmp_path, capsys):
    records = tmp_path / "records"
    with pytest.raises(SystemExit) as end:
        main(["bench", "expert", "--records", str(records), *words])
    assert end.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("manicm-ms: ")
    assert said in line
    assert not records.exists()
