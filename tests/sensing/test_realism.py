"""Sampling of realism values: within their ranges, repeatable, independent of what they should not depend on."""

import json

import numpy as np
import pytest

from manicm_ms.errors import ConfigError, UnknownNameError
from manicm_ms.sensing.realism import GAINS, LIGHT, REALISM, TABLE, Realism, RealismRows, objects_of, resolve_realism
from manicm_ms.spec import ActionSpec, EnvSpec, ObsSpec

OBJECTS = ("cube", "block")
SEEDS = range(400)
DR = REALISM.get("d435i+dr")

# name -> (field of Realism, neutral value), written down here a second time on purpose
EXPECTED = {
    "depth_scale_factor": ("depth_scale", 1.0),
    "focal_factor": ("focal", 1.0),
    "centre_u": ("centre", 0.0),
    "centre_v": ("centre", 0.0),
    "table_height": ("table_height", 0.0),
    **{f"extrinsic_{axis}": ("extrinsic_shift", 0.0) for axis in "xyz"},
    **{f"extrinsic_r{axis}": ("extrinsic_turn", 0.0) for axis in "xyz"},
    **{f"camera_{axis}": ("camera_shift", 0.0) for axis in "xyz"},
    **{f"camera_r{axis}": ("camera_turn", 0.0) for axis in "xyz"},
    **{f"{name}_factor": ("gains", 1.0) for name in GAINS},
    **{f"{name}.{channel}": ("color", 0.0) for name in (*OBJECTS, TABLE) for channel in ("red", "green", "blue")},
    **{f"{name}.friction_factor": ("friction", 1.0) for name in (*OBJECTS, TABLE)},
    **{f"{name}.mass_factor": ("mass", 1.0) for name in OBJECTS},
    **{f"{name}.size_factor": ("size", 1.0) for name in OBJECTS},
}


@pytest.fixture(scope="module")
def samples():
    return [DR.sample(seed, OBJECTS) for seed in SEEDS]


def test_clean_draws_nothing():
    assert REALISM.get("clean").sample(3, OBJECTS) == {}
    assert REALISM.get("clean").is_clean
    assert not REALISM.get("clean").builds


def test_every_name_is_there_for_every_seed_and_no_other(samples):
    names = set(EXPECTED) | {"action_delay", "gripper_delay"} | {f"light_{name}" for name in LIGHT}
    assert all(set(sample) == names for sample in samples)


@pytest.mark.parametrize("name", EXPECTED)
def test_values_fill_their_range_evenly(name, samples):
    field, neutral = EXPECTED[name]
    reach = getattr(DR, field)
    unit = (np.array([sample[name] for sample in samples]) - neutral) / reach
    assert np.abs(unit).max() <= 1 + 1e-9
    # Uniform on -1..1: mean 0, standard deviation 1 / sqrt(3); five standard errors of 400 draws.
    assert abs(unit.mean()) < 5 / np.sqrt(3 * len(unit))
    assert unit.std() == pytest.approx(1 / np.sqrt(3), rel=0.12)


def test_delays_are_whole_steps_and_each_is_met(samples):
    for name in ("action_delay", "gripper_delay"):
        assert {sample[name] for sample in samples} == set(range(getattr(DR, name) + 1))


def test_the_lamp_stays_in_its_ranges(samples):
    for name, (low, high) in LIGHT.items():
        values = [sample[f"light_{name}"] for sample in samples]
        assert low <= min(values) < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < max(values) <= high


def test_the_same_seed_gives_the_same_values_and_another_seed_others(samples):
    assert DR.sample(7, OBJECTS) == samples[7]
    assert all(samples[7][name] != samples[8][name] for name in EXPECTED)


def test_values_are_uncorrelated(samples):
    table = np.array([[sample[name] for name in EXPECTED] for sample in samples])
    correlation = np.corrcoef(table.T) - np.eye(len(EXPECTED))
    assert np.abs(correlation).max() < 6 / np.sqrt(len(samples))


def test_an_object_does_not_depend_on_the_others():
    both, alone = DR.sample(5, OBJECTS), DR.sample(5, ("block",))
    assert {name: both[name] for name in alone} == alone


def test_fixed_objects_keep_size_and_mass():
    drawn = DR.sample(5, OBJECTS, fixed=("cube",))
    assert {name for name in drawn if name.startswith("cube.")} == {
        "cube.friction_factor", "cube.red", "cube.green", "cube.blue"
    }  # fmt: skip
    free = DR.sample(5, OBJECTS)
    assert {name: free[name] for name in drawn} == drawn


def test_presets_share_the_draws_that_both_use():
    wide, narrow = DR.sample(11, OBJECTS), REALISM.get("d435i").sample(11, OBJECTS)
    assert narrow
    assert {name: wide[name] for name in narrow} == narrow


def test_what_is_fixed_when_a_scene_is_built_is_told_apart():
    assert DR.builds
    assert not REALISM.get("d435i").builds
    assert Realism(table_height=0.001).builds
    assert not Realism(action_delay=2, gripper_delay=1, lighting=1, extrinsic_shift=0.01).builds


def test_a_realism_is_recorded_as_plain_json():
    stored = DR.to_dict()
    assert json.loads(json.dumps(stored)) == stored
    assert stored["friction"] == DR.friction
    assert stored["depth"]["baseline"] == DR.depth.baseline


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"friction": -0.1}, "friction must not be negative"),
        ({"mass": 1.0}, "mass is relative: it must be below 1"),
        ({"size": float("nan")}, "size must not be negative"),
        ({"lighting": 2}, "lighting is 0 or 1"),
        ({"action_delay": 1.5}, "action_delay is 0 to 20 control steps"),
        ({"gripper_delay": 21}, "gripper_delay is 0 to 20 control steps"),
    ],
)
def test_senseless_ranges_are_refused(bad, message):
    with pytest.raises(ConfigError, match=message):
        Realism(**bad)


def test_an_unknown_preset_is_refused_with_the_nearest():
    with pytest.raises(UnknownNameError, match=r"realism preset 'd435': did you mean 'd435i'\?"):
        resolve_realism("d435")
    assert resolve_realism(DR) is DR


def test_rows_give_columns_and_neutral_values():
    rows = RealismRows([{"cube.mass_factor": 1.5, "camera_x": 0.01}, {}])
    assert rows["cube.mass_factor"].tolist() == [1.5, 1.0]
    assert rows.vectors("camera_x", "camera_y").tolist() == [[0.01, 0.0], [0.0, 0.0]]
    other = rows.replaced([1], [{"camera_y": 0.02}])
    assert other.vectors("camera_x", "camera_y").tolist() == [[0.01, 0.0], [0.0, 0.02]]
    assert rows["camera_y"].tolist() == [0.0, 0.0]


def test_objects_are_those_whose_poses_the_state_holds():
    layout = {
        "tcp_pose": (0, 7),
        "tcp_target_pose": (7, 14),
        "opening": (14, 15),
        "cube_pose": (15, 22),
        "lid_pose": (22, 29),
    }
    spec = EnvSpec("toy/x", ObsSpec(8, 3, 1, "world"), ActionSpec(("x",), "y", 20.0), 10, ("p",), state_layout=layout)
    assert objects_of(spec) == ("cube", "lid")
