"""Which environment is asked for: the options that commands share, what identifies them on disk, and how it is made."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from manicm_ms.envs.simulator import ENVS, EnvEntry, SimulatorConfig
from manicm_ms.envs.vec_env import make_vec
from manicm_ms.envs.vector import VecEnv
from manicm_ms.sensing.camera import CameraModel
from manicm_ms.sensing.camera_files import read_camera
from manicm_ms.sensing.realism import Realism, parse_presets, realism_name, resolve_realism

IDEAL, OWN_PRESET = "clean", "manicm_ms"
"""What `realism` and `obs_preset` are where nothing is said."""


@dataclass(frozen=True)
class EnvRequest:
    """An environment as a command asks for it.

    Attributes:
        env_id: for example "ur3e/slide-block".
        backend: "cpu", "gpu" or "auto".
        colors: rgb beside xyz.
        realism: a preset, several separated by commas for what plays each of them, or ranges of one's own.
        camera: YAML file of the cell's depth camera.
        obs_preset: "manicm_ms", or "dp3" for clouds as the public DP3 wrapper makes them.
    """

    env_id: str
    backend: str = "auto"
    _: KW_ONLY
    colors: bool = False
    realism: str | Realism = IDEAL
    camera: Path | None = None
    obs_preset: str = OWN_PRESET

    @property
    def entry(self) -> EnvEntry:
        """The registered environment; raises UnknownNameError where there is none."""
        return ENVS.get(self.env_id)

    @cached_property
    def camera_model(self) -> CameraModel | None:
        """The camera of the file; raises CameraError where it is none."""
        return None if self.camera is None else read_camera(self.camera)

    @property
    def presets(self) -> tuple[str | Realism, ...]:
        """What is played: each preset that `realism` names, or the ranges."""
        return parse_presets(self.realism) if isinstance(self.realism, str) else (self.realism,)

    def require_offered(self) -> None:
        """Raise ConfigError where the environment lacks the camera, a preset or the observations."""
        for preset in self.presets:
            self.entry.require(
                SimulatorConfig(realism=resolve_realism(preset), camera=self.camera_model, obs_preset=self.obs_preset)
            )

    def vec_env(self, num_envs: int, *, realism: str | Realism | None = None, **exchange: Any) -> VecEnv:
        """Return the vector environment.

        Args:
            num_envs: N.
            realism: one of `presets`; None where there is only one.
            **exchange: further arguments of `make_vec`: `obs`, `chunk`, `num_points`, `video`; `colors` overrides.
        """
        asked: dict[str, Any] = {"colors": self.colors, **exchange}
        return make_vec(
            self.env_id, num_envs, self.backend, realism=self.realism if realism is None else realism,
            camera=self.camera_model, obs_preset=self.obs_preset, **asked,
        )  # fmt: skip

    def options(self) -> list[str]:
        """Return the options of a command line that ask for it, `env_id` and `backend` apart; defaults are left out."""
        name = self.realism if isinstance(self.realism, str) else realism_name(self.realism)
        words = ["--colors"] if self.colors else []
        words += ["--obs-preset", self.obs_preset] if self.obs_preset != OWN_PRESET else []
        words += ["--realism", name] if name != IDEAL else []
        return words + (["--camera", str(self.camera)] if self.camera is not None else [])
