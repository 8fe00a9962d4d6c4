"""Presets of teachers and students: everything that decides a training, named, documented and overridable."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from manicm_ms.errors import ConfigError, require_at_least
from manicm_ms.policies.points import POINT_CHOICES
from manicm_ms.registry import Registry
from manicm_ms.spec import ChunkSpec
from manicm_ms.training.optim import FitConfig


@dataclass(frozen=True, kw_only=True)
class TeacherPreset(FitConfig):
    """How to train a diffusion teacher.

    Attributes:
        n_obs_steps: To, frames read.
        horizon: Tp, actions predicted.
        n_action_steps: Ta, actions executed.
        prediction_type: what the network predicts: "sample" (x0) or "epsilon" (noise).
        cloud_frame: "base" leaves the cloud where it is and scales it to [-1, 1]; "tcp" takes it relative to the
            tool centre point, in units of `cloud_scale`: 20 of 50 episodes more on Meta-World's pick-place. "auto" is
            tcp where agent_pos holds that point, else base (a hand without an arm's tool, as Adroit's).
        cloud_scale: metres that become 1 with `cloud_frame` "tcp"; unused with "base".
        points: points read of each cloud, in training and when acting; None uses them all.
        acting_points: which ones when acting: "prefix" (clouds are stored in farthest-point order, so a prefix is a
            coarser cloud) or "random" (drawn anew for each decision, from its noise).
        training_points: which ones in each step of training: "random" or "prefix".
        min_state_range: least range of a channel of agent_pos in its unit (metres, radians, entries of a rotation): a
            channel that moves less in the demonstrations is not stretched to [-1, 1]. 0 stretches it, as DP3 does.
        down_dims: channels of the U-Net's stages, or None for the policy's own.
        ema_power: of the averaged weights, which are the teacher in the end; see `PowerDecay`.
        ema_max_decay: never keep more than this of the old average.
        precision: used unless the command names another; see `resolve_precision`.
    """

    n_obs_steps: int = 2
    horizon: int = 4
    n_action_steps: int = 3
    prediction_type: str = "sample"
    cloud_frame: str = "base"
    cloud_scale: float = 0.15
    points: int | None = None
    acting_points: str = "prefix"
    training_points: str = "random"
    min_state_range: float = 0.0
    down_dims: tuple[int, ...] | None = None
    ema_power: float = 0.75
    ema_max_decay: float = 0.9999
    precision: str = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.points is not None and self.points < 1:
            raise ConfigError(f"points must be at least 1 or None, got {self.points}")
        POINT_CHOICES.get(self.acting_points)
        POINT_CHOICES.get(self.training_points)
        if self.cloud_scale <= 0:
            raise ConfigError(f"cloud_scale must be positive (metres), got {self.cloud_scale}")
        if not self.min_state_range >= 0:
            raise ConfigError(f"min_state_range must be at least 0, got {self.min_state_range}")
        _ = self.chunk  # checks the three lengths against each other

    @property
    def chunk(self) -> ChunkSpec:
        """To, Tp, Ta."""
        return ChunkSpec(self.n_obs_steps, self.horizon, self.n_action_steps)


@dataclass(frozen=True, kw_only=True)
class StudentPreset(FitConfig):
    """How to distil a teacher into a one-step student.

    Attributes:
        objective: name in `DISTILLATIONS`: "consistency", or "public-consistency" for comparison only.
        skip: k, training timesteps that one step of the solver spans.
        mu: share that the target network keeps at each step, in [0, 1).
        draws: random point subsets for which the frozen encoder's features are computed, once each, where the
            teacher reads fewer points than are stored; with the full cloud there is only one.
        nfe: network evaluations of the student when acting: 1, or 4 for a little more precision.
        precision: used unless the command names another; see `resolve_precision`.
    """

    objective: str = "consistency"
    skip: int = 10
    mu: float = 0.95
    draws: int = 4
    nfe: int = 1
    precision: str = "auto"

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(1, skip=self.skip, draws=self.draws, nfe=self.nfe)
        if not 0 <= self.mu < 1:
            raise ConfigError(f"mu must lie in [0, 1), got {self.mu}")


_ADDED_LATER = {"acting_points": "prefix", "training_points": "random", "min_state_range": 0.0}
"""Fields that presets got after runs were made with them, with what those runs did."""


def preset_identity(preset: FitConfig) -> dict[str, Any]:
    """Return the fields that tell one preset from another, JSON values.

    A field that was added later is left out where it says what was done before, so that older runs still are the same
    run: they go on, or are found finished.
    """
    values = asdict(preset)
    return {k: v for k, v in values.items() if not (k in _ADDED_LATER and v == _ADDED_LATER[k])}


TEACHER_PRESETS: Registry[TeacherPreset] = Registry("teacher preset")
STUDENT_PRESETS: Registry[StudentPreset] = Registry("student preset")

TEACHER_PRESETS.add(
    "quick",  # two minutes on one CPU core: small U-Net, a quarter of the points, hand-relative cloud
    TeacherPreset(
        steps=1500,
        batch_size=64,
        learning_rate=1e-3,
        warmup_steps=100,
        clip_norm=1.0,
        cloud_frame="auto",
        points=128,
        min_state_range=0.02,
        down_dims=(64, 128, 256),
    ),
)
TEACHER_PRESETS.add(
    "smoke",  # some seconds: shows that everything runs, and learns next to nothing
    TeacherPreset(
        steps=30,
        batch_size=16,
        warmup_steps=5,
        cloud_frame="auto",
        points=64,
        min_state_range=0.02,
        down_dims=(32, 64),
        save_every=15,
    ),
)
TEACHER_PRESETS.add(
    "paper",  # DP3's public configuration with the horizon of the ManiCM paper, section 4.1
    TeacherPreset(
        epochs=3000,
        batch_size=128,
        learning_rate=1e-4,
        warmup_steps=500,
        clip_norm=None,
        n_action_steps=2,
        log_every=100,
        save_every=2000,
        precision="32-true",
    ),
)
STUDENT_PRESETS.add(
    "quick",
    StudentPreset(steps=200, batch_size=64, learning_rate=5e-4, warmup_steps=50, clip_norm=1.0, save_every=100),
)
STUDENT_PRESETS.add("smoke", StudentPreset(steps=20, batch_size=16, warmup_steps=5, draws=1, save_every=10))
STUDENT_PRESETS.add(
    "paper",  # ManiCM, section 4.1
    StudentPreset(
        epochs=3000,
        batch_size=128,
        learning_rate=5e-5,
        warmup_steps=500,
        clip_norm=None,
        log_every=100,
        save_every=2000,
        precision="32-true",
    ),
)
