"""Rows of a ManiSkill task as a `Simulator`: one row on a CPU, many on a GPU; native point clouds from the camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from manicm_ms import gym_ids
from manicm_ms.machine import sapien_gpu, vulkan

vulkan.prepare()  # before SAPIEN is first imported

import mani_skill.envs  # noqa: E402, F401  (registers ManiSkill's own ids)
from mani_skill.envs.sapien_env import BaseEnv  # noqa: E402
from mani_skill.utils import registration  # noqa: E402

from manicm_ms.envs.cameras import CLOUD_POSITION, COLOR, cloud_shader, set_cloud_formats  # noqa: E402
from manicm_ms.envs.delay import ActionDelay  # noqa: E402
from manicm_ms.envs.simulator import ENVS, Simulator, SimulatorConfig, StepResult  # noqa: E402
from manicm_ms.envs.ur3e_tabletop import UR3eTabletopEnv  # noqa: E402
from manicm_ms.envs.views import CROPPED_KEYS, CameraView, IdealView, View  # noqa: E402
from manicm_ms.errors import ConfigError  # noqa: E402
from manicm_ms.robots.ur3e_ag95 import TCP_STEP, opening_to_action  # noqa: E402
from manicm_ms.sensing.camera import CameraModel, require_view  # noqa: E402
from manicm_ms.sensing.camera_files import default_camera  # noqa: E402
from manicm_ms.sensing.point_cloud import Box  # noqa: E402
from manicm_ms.sensing.realism import RealismRows  # noqa: E402
from manicm_ms.spec import AGENT_POS, DEPTH, IMAGE, STATE, EnvSpec  # noqa: E402

VIDEO_SHADER = "default"
_RENDERED = CROPPED_KEYS | {IMAGE, DEPTH}
_NO_VULKAN = ("failed to find a rendering device", "vk::")
"""How SAPIEN words it when no driver, or no device that can render, is there."""


class ManiSkillSimulator(Simulator):
    """Rows of a registered UR3e task.

    Args:
        spec: the environment's spec, already specialised.
        config: how to build it.
        gym_id: the id that the task is registered under with ManiSkill, for example "UR3eSlideBlock-v1".

    Raises:
        RenderDeviceError: SAPIEN finds no Vulkan device.
        CameraError: the configured camera sees nothing of the workspace.
    """

    def __init__(self, spec: EnvSpec, config: SimulatorConfig, gym_id: str) -> None:
        self.spec, self.config, self.num_rows = spec, config, config.num_rows
        self._entry = ENVS.get_registered(spec.env_id)
        if config.camera is not None:
            require_view(config.camera, workspace_of(spec.env_id), spec.env_id)
        camera = config.camera or (None if config.realism.is_clean else default_camera())
        size = config.image_size if camera is None else (camera.crop.height, camera.crop.width)
        self.env = _make(gym_id, spec, config, camera, size)
        self.device = self.env.device
        self._camera = self.env._sensors["d435i"]
        self._view: View = (
            IdealView(self.env, config, spec.obs)
            if camera is None
            else CameraView(self.env, config, camera, spec.obs, self.device)
        )
        longest = config.realism.action_delay + config.realism.gripper_delay
        self._delay = ActionDelay(self.num_rows, spec.action.dim, longest, self.device) if longest else None
        self._values = RealismRows([{}] * self.num_rows)
        self._steps = torch.zeros(self.num_rows, dtype=torch.int64)  # control steps since each row's reset
        self._closed = False

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """See `Simulator.reset`.

        Raises:
            ConfigError: part of a batch is to be reset under a realism that builds each episode's scene anew.
        """
        drawn = [self._entry.conditions(self.config.realism, seed) for seed in seeds]
        self._values = self._values.replaced(rows.tolist(), drawn)
        every = np.zeros(self.num_rows, dtype=np.int64)  # rows that are not reset never draw from their seed
        every[rows.cpu().numpy()] = np.asarray(seeds, dtype=np.int64)
        self.env.reset(seed=every.tolist(), options=self._reset_options(rows))
        self._camera = self.env._sensors["d435i"]
        self._view.start(rows, seeds, RealismRows(drawn))
        self._steps[rows.cpu()] = 0
        if self._delay is not None:
            self._start_delay(self._delay, rows, RealismRows(drawn))

    def _reset_options(self, rows: Tensor) -> dict[str, Any]:
        """Return how ManiSkill is to reset `rows`: one row alone gets a fresh scene, rows of a batch cannot.

        PhysX keeps something of earlier contacts: in a used scene the same seed parts by millimetres from its
        first run as soon as something is touched (docs/decisions/0010). A new scene costs 0.03 s. Where realism
        changes what a scene is built of, a batch gets a new one too, which only all its rows together can.
        """
        builds = self.config.realism.builds
        if self.num_rows > 1 and not builds:
            return {"env_idx": rows.to(self.device)}
        if len(rows) < self.num_rows:
            raise ConfigError(
                f"{len(rows)} of {self.num_rows} rows cannot be reset alone under this realism, whose scenes are built "
                "anew for each episode: use backend 'cpu', reset every row at once, or the preset 'd435i'"
            )
        set_cloud_formats()
        return {"reconfigure": True, "realism": self._values if builds else None}

    def _start_delay(self, delay: ActionDelay, rows: Tensor, values: RealismRows) -> None:
        """Fill the queues with what the robot does at rest: no motion, the opening that it was told last."""
        resting = torch.zeros(len(rows), self.spec.action.dim, device=self.device)
        resting[:, -1] = opening_to_action(self.env.agent.opening_target[rows.to(self.device)])
        late = torch.tensor(values["action_delay"], dtype=torch.int64)[:, None].repeat(1, self.spec.action.dim)
        late[:, -1] += torch.tensor(values["gripper_delay"], dtype=torch.int64)
        delay.start(rows, late, resting)

    def step(self, actions: Tensor) -> StepResult:
        """See `Simulator.step`."""
        if self._delay is not None:
            actions = self._delay.push(actions)
        _, reward, terminated, _, info = self.env.step(actions)
        self._steps += 1
        facts = {name: value for name, value in info.items() if isinstance(value, Tensor) and value.dim() == 1}
        facts.pop("elapsed_steps", None)  # the episode logic counts for itself
        return StepResult(reward.float(), terminated, facts)

    def observe(self) -> dict[str, Tensor]:
        """See `Simulator.observe`."""
        frame: dict[str, Tensor] = {}
        wanted = self.config.obs
        pictures = bool(_RENDERED.intersection(wanted))
        if pictures:
            self._shoot()  # the renderer works while the robot's own state is read
        if AGENT_POS in wanted:
            frame[AGENT_POS] = self.env.agent_pos()
        if STATE in wanted:
            frame[STATE] = self._state()
        if pictures:
            frame |= self._view.frame(wanted, self._pictures(self._view.needs_color(wanted)), self._steps)
        return frame

    def _state(self) -> Tensor:
        """Return the privileged state (n, S). Its target pose is where commands still under way will move the target.

        An expert plans from the target: blind to what is under way it would give every late command twice.
        """
        state = self.env.privileged_state()
        if self._delay is not None:
            start, _ = self.spec.state_layout["tcp_target_pose"]
            state[:, start : start + 3] += TCP_STEP * self._delay.pending()[:, :3]
        return state

    def _shoot(self) -> None:
        """Start rendering the present scene; `_pictures` waits for it."""
        self.env.scene.update_render(update_sensors=True, update_human_render_cameras=False)
        self._camera.capture()

    def _pictures(self, color: bool) -> dict[str, Tensor]:
        names = [CLOUD_POSITION, COLOR] if color else [CLOUD_POSITION]
        return dict(zip(names, self._camera.camera.get_picture(names), strict=True))

    def render_video_frames(self) -> Tensor:
        """See `Simulator.render_video_frames`."""
        return self.env.render_rgb_array("wide")

    def close(self) -> None:
        """See `Simulator.close`."""
        if not self._closed:
            self._closed = True
            self.env.close()


def _make(
    gym_id: str, spec: EnvSpec, config: SimulatorConfig, camera: CameraModel | None, size: tuple[int, int]
) -> UR3eTabletopEnv:
    height, width = size
    shader = cloud_shader()
    set_cloud_formats()
    render_on_gpu = torch.cuda.is_available() and sapien_gpu.cuda_can_render()
    options: dict[str, Any] = {
        "num_envs": config.num_rows,
        "obs_mode": "none",  # frames are rendered on demand, by `observe`
        "reward_mode": config.reward_mode,
        "control_mode": spec.action.control_mode,
        "sim_backend": "physx_cpu" if config.device == "cpu" else "physx_cuda",
        "render_backend": "sapien_cuda" if render_on_gpu else "sapien_cpu",
        "sensor_configs": {"shader_config": shader, "width": width, "height": height},
        # ManiSkill builds the video camera in any case: without video it shares the shader that is compiled already.
        "human_render_camera_configs": {"shader_pack": VIDEO_SHADER} if config.video else {"shader_config": shader},
        "render_mode": "rgb_array",
        "camera_model": camera,
    }
    try:
        env = gymnasium.make(gym_id, **options)
    except RuntimeError as error:
        if not any(words in str(error) for words in _NO_VULKAN):
            raise
        raise vulkan.no_device() from error
    return env.unwrapped  # type: ignore[return-value]


def register_env(gym_id: str, max_episode_steps: int) -> Callable[[type[BaseEnv]], type[BaseEnv]]:
    """Return a decorator that registers a task's class with ManiSkill and with Gymnasium, as ManiSkill's own does.

    ManiSkill's would register an id anew that `import manicm_ms` has made known, with a warning, and its entry points
    are functions, which `gymnasium.spec(id).to_json()` refuses.

    Args:
        gym_id: for example "UR3eSlideBlock-v1".
        max_episode_steps: control steps of an episode.
    """

    def decorate(cls: type[BaseEnv]) -> type[BaseEnv]:
        registration.register(gym_id, cls, max_episode_steps)
        gym_ids.register_maniskill(gym_id, f"{cls.__module__}:{cls.__qualname__}", max_episode_steps)
        return cls

    return decorate


def gym_id(env_id: str) -> str:
    """Return the id that a task is registered under with ManiSkill, for example "UR3eSlideBlock-v1".

    Raises UnknownNameError for the id, ConfigError where the task is not one of ManiSkill.
    """
    build = ENVS.get(env_id).build
    if isinstance(build, partial) and build.func is ManiSkillSimulator:
        return str(build.keywords["gym_id"])
    raise ConfigError(f"{env_id} does not run on ManiSkill: name a task of the UR3e's cell")


def workspace_of(env_id: str) -> Box:
    """Return the crop box of a task's clouds, robot-base frame, metres; raises as `gym_id`."""
    return registration.REGISTERED_ENVS[gym_id(env_id)].cls.workspace
