"""What every suite must offer: n rows of one task in one process, advanced and observed separately.

Observation is apart from motion because rendering dominates the cost: the episode logic above asks for a frame only
where a policy will read it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from manicm_ms.errors import ConfigError, require_at_least
from manicm_ms.registry import TASKS, Registry
from manicm_ms.sensing.camera import CameraModel
from manicm_ms.sensing.realism import Realism, RealismSample, objects_of
from manicm_ms.spec import AGENT_POS, DP3_FRAME, OBS_KEYS, POINT_CLOUD, VOXEL_SIZE, EnvSpec

MOST_CELLS = 256
"""Along a side of a voxel grid: a frame of 256^3 takes 16 MiB without colours."""
OBS_PRESETS = ("manicm_ms", "dp3")
"""How observations are made: the package's own way, and that of the public DP3 wrapper (Adroit and Meta-World)."""
REWARD_MODES = ("sparse", "dense", "normalized_dense", "none")


class StepResult(NamedTuple):
    """What one control step of n rows brought.

    Attributes:
        reward: (n,) float32.
        terminated: (n,) bool, the task ended (success or failure), not the time.
        info: name -> (n,) tensor; always the same names, "success" (bool) among them.
    """

    reward: Tensor
    terminated: Tensor
    info: dict[str, Tensor]


@dataclass(frozen=True)
class SimulatorConfig:
    """How a simulator is asked to be built.

    Attributes:
        num_rows: n, rows simulated together in this process.
        obs: observation keys that `observe` returns; nothing else is rendered.
        num_points: P, points of a cloud.
        colors: append rgb in [0, 1] to the cloud's xyz.
        image_size: (H, W) of the camera, pixels.
        voxel_size: V, cells along each side of a voxel grid.
        video: make `render_video_frames` available (building takes some seconds longer).
        reward_mode: one of `REWARD_MODES`.
        device: "cpu", or the accelerator that simulates and renders.
        obs_preset: one of `OBS_PRESETS`; an environment's entry says which of them it has.
        realism: what is drawn for each episode beside the task's own randomisation.
        camera: the depth camera of the cell with its native intrinsics; None takes the ideal camera where `realism` is
            clean, else the D435i that the package ships.
    """

    num_rows: int = 1
    obs: tuple[str, ...] = (POINT_CLOUD, AGENT_POS)
    num_points: int = 512
    colors: bool = False
    image_size: tuple[int, int] = (84, 84)
    voxel_size: int = VOXEL_SIZE
    video: bool = False
    reward_mode: str = "sparse"
    device: str = "cpu"
    obs_preset: str = "manicm_ms"
    realism: Realism = Realism()  # noqa: RUF009 (it is frozen)
    camera: CameraModel | None = None

    def __post_init__(self) -> None:
        unknown = [key for key in self.obs if key not in OBS_KEYS]
        if unknown or not self.obs:
            raise ConfigError(f"unknown observation keys {unknown}: choose from {', '.join(OBS_KEYS)}")
        if self.reward_mode not in REWARD_MODES:
            raise ConfigError(f"unknown reward_mode {self.reward_mode!r}: choose from {', '.join(REWARD_MODES)}")
        if self.obs_preset not in OBS_PRESETS:
            raise ConfigError(f"unknown obs_preset {self.obs_preset!r}: choose from {', '.join(OBS_PRESETS)}")
        if self.voxel_size > MOST_CELLS:
            raise ConfigError(f"voxel_size must be at most {MOST_CELLS} cells along a side, got {self.voxel_size}")
        require_at_least(
            1, num_envs=self.num_rows, num_points=self.num_points, image_size=min(self.image_size),
            voxel_size=self.voxel_size,
        )  # fmt: skip

    def require_ideal(self, env_id: str) -> None:
        """Raise ConfigError unless realism and camera are left out: for simulators that know neither."""
        if not self.realism.is_clean or self.camera is not None:
            raise ConfigError(f"{env_id} has no realism presets and no camera file: use realism 'clean' and no camera")

    def specialise(self, spec: EnvSpec) -> EnvSpec:
        """Return `spec` with the shapes of clouds, images and grids that this configuration asks for."""
        obs = replace(
            spec.obs, num_points=self.num_points, point_channels=6 if self.colors else 3, image_size=self.image_size,
            voxel_size=self.voxel_size,
        )  # fmt: skip
        if self.obs_preset == "dp3":  # its clouds are in a frame of their own, agent_pos is not
            return replace(spec, obs=replace(obs, frame=DP3_FRAME), tcp_indices=None)
        return replace(spec, obs=obs)


class Simulator(ABC):
    """n rows of one task. Tensors live on `device`; rows never influence each other.

    One that does not apply `SimulatorConfig.realism` and `camera` says so by `SimulatorConfig.require_ideal`.
    """

    spec: EnvSpec
    device: torch.device
    num_rows: int

    @abstractmethod
    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """Start new episodes in `rows` (k,) int64 with `seeds` (length k); leave the other rows untouched."""

    @abstractmethod
    def step(self, actions: Tensor) -> StepResult:
        """Play one action (n, Da) in [-1, 1] in every row for one control period."""

    @abstractmethod
    def observe(self) -> dict[str, Tensor]:
        """Return the present frame: each asked key (n, ...)."""

    @abstractmethod
    def render_video_frames(self) -> Tensor:
        """Return what the wide camera sees, (n, H, W, 3) uint8."""

    @abstractmethod
    def close(self) -> None:
        """Free renderers and physics; a second call does nothing."""


@dataclass(frozen=True)
class DemoRule:
    """Which episodes of an expert become demonstrations of a task, and where they are cut.

    Attributes:
        success_steps: environment steps with success that an episode must hold.
        tail_steps: control steps kept after the first success, so that a policy also sees the solved task and learns
            to rest. A task whose success must hold to the end wants all of them.
    """

    success_steps: int = 1
    tail_steps: int = 8


@dataclass(frozen=True)
class EnvEntry:
    """A registered environment.

    Attributes:
        spec: what is fixed about it.
        build: makes a simulator from the specialised spec and a configuration.
        module: dotted name of the module whose import registers it; worker processes import that one only.
        fixed: objects of the privileged state that never move, and keep their size and mass under every realism.
        backends: where it can be simulated: "cpu", "gpu" or both.
        obs_presets: those of `OBS_PRESETS` that it has.
        has_realism: whether it knows realism presets and camera files.
        preload: modules that take long to import and that worker processes may share; a missing one is no error.
        demos: which episodes of its expert become demonstrations.
        group: column of the benchmark's table that it belongs to; empty for that of its suite.
        seed_limit: seeds lie in [0, seed_limit); ManiSkill's random streams take 32 bits.
    """

    spec: EnvSpec
    build: Callable[[EnvSpec, SimulatorConfig], Simulator]
    module: str
    fixed: tuple[str, ...] = ()
    backends: tuple[str, ...] = ("cpu", "gpu")
    obs_presets: tuple[str, ...] = ("manicm_ms",)
    has_realism: bool = True
    preload: tuple[str, ...] = ()
    demos: DemoRule = DemoRule()
    group: str = ""
    seed_limit: int = 2**32

    def require(self, config: SimulatorConfig) -> None:
        """Raise ConfigError where `config` asks for what this environment does not have."""
        if config.obs_preset not in self.obs_presets:
            raise ConfigError(
                f"{self.spec.env_id} has no obs_preset {config.obs_preset!r}: use {' or '.join(self.obs_presets)}"
            )
        if not self.has_realism:
            config.require_ideal(self.spec.env_id)

    def conditions(self, realism: Realism, seed: int) -> RealismSample:
        """Return what `realism` draws for the episode with this seed: what the simulator applies and others record."""
        return realism.sample(seed, objects_of(self.spec), self.fixed)


ENVS: Registry[EnvEntry] = Registry("env id", package=TASKS, group=TASKS)
