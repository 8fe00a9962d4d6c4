"""Messages name the value that is wrong, as a person would say it."""

import re
from types import SimpleNamespace

import pytest

from manicm_ms.envs.simulator import SimulatorConfig
from manicm_ms.errors import ConfigError
from manicm_ms.evaluation.protocol import Protocol
from manicm_ms.evaluation.rollout import require_chunk
from manicm_ms.spec import ChunkSpec
from manicm_ms.training.optim import FitConfig, PowerDecay
from manicm_ms.training.presets import StudentPreset


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ChunkSpec(2, 0, 1), "horizon must be at least 1, got 0"),
        (lambda: SimulatorConfig(num_points=-1), "num_points must be at least 1, got -1"),
        (lambda: SimulatorConfig(image_size=(84, 0)), "image_size must be at least 1, got 0"),
        (lambda: Protocol("toy/reach", (1,), num_envs=0), "num_envs must be at least 1, got 0"),
        (lambda: Protocol("toy/reach", (1,), num_envs=1, videos=-1), "videos must be at least 0, got -1"),
        (lambda: FitConfig(steps=0), "steps must be at least 1, got 0"),
        (lambda: FitConfig(steps=200, save_every=0), "save_every must be at least 1, got 0"),
        (lambda: StudentPreset(steps=200, nfe=0), "nfe must be at least 1, got 0"),
        (lambda: PowerDecay(power=0.0), "power must be positive and max_decay in [0, 1), got 0.0 and 0.9999"),
        (
            lambda: require_chunk(SimpleNamespace(chunk=ChunkSpec(2, 4, 3)), ChunkSpec(1, 8, 4)),
            "the env plays 3 actions for 2 frames and the policy 4 actions for 1: make the env with chunk=policy.chunk",
        ),
    ],
)
def test_the_wrong_value_is_named_and_no_dataclass_is_printed(make, message):
    with pytest.raises(ConfigError, match=f"^{re.escape(message)}$"):
        make()
