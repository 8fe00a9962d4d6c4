"""Rows of a ManiSkill task as a `Simulator`: one row on a CPU, many on a GPU; native point clouds from the camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from torch import Tensor

from manicm_ms import sapien_gpu, vulkan

vulkan.prepare()  # before SAPIEN is first imported

import mani_skill.envs  # noqa: E402, F401  (registers ManiSkill's own ids)

from manicm_ms.envs.cameras import CLOUD_POSITION, COLOR, MICROMETRE, cloud_shader, set_cloud_formats  # noqa: E402
from manicm_ms.envs.simulator import Simulator, SimulatorConfig, StepResult  # noqa: E402
from manicm_ms.envs.ur3e_tabletop import UR3eTabletopEnv  # noqa: E402
from manicm_ms.errors import RenderDeviceError  # noqa: E402
from manicm_ms.point_cloud import crop_transformed, inside, sample_cloud, sample_cloud_batch, transform  # noqa: E402
from manicm_ms.types import AGENT_POS, DEPTH, IMAGE, POINT_CLOUD, STATE, EnvSpec  # noqa: E402

VIDEO_SHADER = "default"
_RENDERED = {POINT_CLOUD, IMAGE, DEPTH}
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
    """

    def __init__(self, spec: EnvSpec, config: SimulatorConfig, gym_id: str) -> None:
        self.spec, self.config, self.num_rows = spec, config, config.num_rows
        self.env = _make(gym_id, spec, config)
        self.device = self.env.device
        self._camera = self.env._sensors["d435i"]
        self._T_base_camera: Tensor | None = None  # (n, 4, 4); base and camera stand still during an episode
        self._closed = False

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """See `Simulator.reset`."""
        every = np.zeros(self.num_rows, dtype=np.int64)  # rows that are not reset never draw from their seed
        every[rows.cpu().numpy()] = np.asarray(seeds, dtype=np.int64)
        self.env.reset(seed=every.tolist(), options=self._reset_options(rows))
        self._camera = self.env._sensors["d435i"]
        self._T_base_camera = None

    def _reset_options(self, rows: Tensor) -> dict[str, Any]:
        """Return how ManiSkill is to reset `rows`: one row alone gets a fresh scene, rows of a batch cannot.

        PhysX keeps something of earlier contacts: in a used scene the same seed parts by millimetres from its
        first run as soon as something is touched (docs/decisions/0010). A new scene costs 0.03 s.
        """
        if self.num_rows > 1:
            return {"env_idx": rows.to(self.device)}
        set_cloud_formats()
        return {"reconfigure": True}

    def step(self, actions: Tensor) -> StepResult:
        """See `Simulator.step`."""
        _, reward, terminated, _, info = self.env.step(actions)
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
            frame[STATE] = self.env.privileged_state()
        if pictures:
            frame |= self._render(wanted)
        return frame

    def _shoot(self) -> None:
        """Start rendering the present scene; `_pictures` waits for it."""
        self.env.scene.update_render(update_sensors=True, update_human_render_cameras=False)
        self._camera.capture()

    def _render(self, wanted: tuple[str, ...]) -> dict[str, Tensor]:
        pictures = self._pictures(color=IMAGE in wanted or self.config.colors)
        position = pictures[CLOUD_POSITION]  # (n, H, W, 4) int32
        frame: dict[str, Tensor] = {}
        if POINT_CLOUD in wanted:
            frame[POINT_CLOUD] = self._cloud(position, pictures[COLOR] if self.config.colors else None)
        if DEPTH in wanted:
            frame[DEPTH] = -position[..., 2] * MICROMETRE
        if IMAGE in wanted:
            frame[IMAGE] = pictures[COLOR][..., :3]
        return frame

    def _pictures(self, color: bool) -> dict[str, Tensor]:
        names = [CLOUD_POSITION, COLOR] if color else [CLOUD_POSITION]
        return dict(zip(names, self._camera.camera.get_picture(names), strict=True))

    def _cloud(self, position: Tensor, color: Tensor | None) -> Tensor:
        """Return clouds (n, P, C) of camera-space positions (n, H, W, 4) int32 and rgba (n, H, W, 4) uint8."""
        if self._T_base_camera is None:
            T_world_camera = self._camera.camera.get_model_matrix()
            T_base_world = self.env.agent.robot.pose.inv().to_transformation_matrix()
            self._T_base_camera = (T_base_world @ T_world_camera).float()
        if self.device.type == "cpu":
            return torch.stack([self._row_cloud(k, position, color) for k in range(len(position))])
        n = len(position)
        xyz = transform(position[..., :3].reshape(n, -1, 3) * MICROMETRE, self._T_base_camera)
        hit = position[..., 3].reshape(n, -1) != 0  # the background carries segmentation id 0
        points = xyz if color is None else torch.cat([xyz, color[..., :3].reshape(n, -1, 3) / 255.0], dim=-1)
        return sample_cloud_batch(points, hit & inside(xyz, self.env.workspace), self.config.num_points)

    def _row_cloud(self, row: int, position: Tensor, color: Tensor | None) -> Tensor:
        assert self._T_base_camera is not None
        pixels = position[row].reshape(-1, 4).numpy()
        hit = np.flatnonzero(pixels[:, 3])
        xyz = pixels[hit, :3] * np.float32(MICROMETRE)
        index, points = crop_transformed(xyz, self._T_base_camera[row].numpy(), self.env.workspace)
        if color is not None:
            rgb = color[row].reshape(-1, color.shape[-1])[:, :3].numpy()[hit[index]]
            points = np.concatenate([points, rgb / np.float32(255)], axis=1)
        return torch.from_numpy(sample_cloud(points, self.config.num_points))

    def render_video_frames(self) -> Tensor:
        """See `Simulator.render_video_frames`."""
        return self.env.render_rgb_array("wide")

    def close(self) -> None:
        """See `Simulator.close`."""
        if not self._closed:
            self._closed = True
            self.env.close()


def _make(gym_id: str, spec: EnvSpec, config: SimulatorConfig) -> UR3eTabletopEnv:
    height, width = config.image_size
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
    }
    try:
        env = gymnasium.make(gym_id, **options)
    except RuntimeError as error:
        if not any(words in str(error) for words in _NO_VULKAN):
            raise
        raise RenderDeviceError(
            "SAPIEN found no Vulkan device to render with: run 'make setup' to install one, then 'manicm-ms doctor'"
        ) from error
    return env.unwrapped  # type: ignore[return-value]
