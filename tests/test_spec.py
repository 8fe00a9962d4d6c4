"""Specs refuse what does not fit, and survive JSON."""

import dataclasses
import json

import pytest

from manicm_ms.errors import ConfigError, SpecMismatchError
from manicm_ms.spec import ActionSpec, ChunkSpec, EnvSpec, ObsSpec, require_compatible


@pytest.fixture
def spec():
    return EnvSpec(
        env_id="toy/reach",
        obs=ObsSpec(num_points=64, point_channels=3, agent_pos_dim=3, frame="world"),
        action=ActionSpec(names=("dx [m]", "dy [m]"), control_mode="delta", control_hz=20),
        max_episode_steps=50,
        agent_pos_names=("x [m]", "y [m]", "z [m]"),
        tcp_indices=(0, 1, 2),
        state_layout={"goal": (0, 3)},
    )


@pytest.mark.parametrize(
    ("To", "Tp", "Ta", "fits"), [(2, 4, 3, True), (2, 4, 4, False), (1, 4, 4, True), (0, 4, 1, False)]
)
def test_chunk_lengths(To, Tp, Ta, fits):
    if fits:
        chunk = ChunkSpec(To, Tp, Ta)
        assert list(range(Tp))[chunk.executed] == list(range(To - 1, To - 1 + Ta))
    else:
        with pytest.raises(ConfigError):
            ChunkSpec(To, Tp, Ta)


def test_json_round_trip(spec):
    assert EnvSpec.from_dict(json.loads(json.dumps(spec.to_dict()))) == spec


def test_a_sibling_task_fits(spec):
    require_compatible(spec, dataclasses.replace(spec, env_id="toy/push"), "data", "policy")


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("obs.frame", {"obs": ObsSpec(64, 3, 3, "robot_base")}),
        ("obs.point_channels", {"obs": ObsSpec(64, 6, 3, "world")}),
        ("action.control_mode", {"action": ActionSpec(("dx [m]", "dy [m]"), "absolute", 20)}),
        ("tcp_indices", {"tcp_indices": None}),
    ],
)
def test_a_mismatch_is_named(spec, field, change):
    with pytest.raises(SpecMismatchError, match=field):
        require_compatible(spec, dataclasses.replace(spec, **change), "data", "policy")


def test_number_of_points_may_differ(spec):
    require_compatible(spec, dataclasses.replace(spec, obs=ObsSpec(512, 3, 3, "world")), "data", "policy")
