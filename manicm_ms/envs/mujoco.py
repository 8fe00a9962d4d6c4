"""One row of a MuJoCo suite's task as a `Simulator`: rendering, clouds, rewards and stored states for all of them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from manicm_ms.envs.mujoco_render import LeanRenderer, Picture, mujoco
from manicm_ms.envs.mujoco_task import FixedPose, MujocoTask, Outcome, View
from manicm_ms.envs.simulator import Simulator, SimulatorConfig, StepResult
from manicm_ms.errors import BackendError, ConfigError
from manicm_ms.sensing.cropped import CroppedPoints, clouds_of, observe_cropped
from manicm_ms.sensing.point_cloud import crop_transformed
from manicm_ms.spec import AGENT_POS, DEPTH, IMAGE, POINT_CLOUD, STATE, VOXEL_GRID, EnvSpec

VIDEO_SIZE = (360, 480)
_MOST_METRES = 5.0
"""Side of the largest crop box over which a voxel grid means something."""
EpisodeState = dict[str, NDArray[Any]]
"""What `save_state` returns: name -> array; plain numbers, fit for npz and zarr."""

_FULL_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_MODEL_ARRAYS = ("body_pos", "body_quat", "site_pos")  # what the suites' resets write into the model


def update_derived(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Bring positions, cameras and sensors up to date with the joints (mj_forward), and change nothing that moves on.

    mj_forward leaves its accelerations as the solver's next starting point (qacc_warmstart), from which the next step
    would part from the suite's own by 1e-9; that is put back.
    """
    warmstart = data.qacc_warmstart.copy()
    mujoco.mj_forward(model, data)
    data.qacc_warmstart[:] = warmstart


class SuiteEnv(Protocol):
    """A suite's environment, reduced to what the simulator needs.

    After `reset` and `step`, `data` is up to date (`update_derived`): what is rendered is where it is.

    Attributes:
        model, data: MuJoCo's.
        reward_scale: the dense reward's largest value a control step, or None where it has none.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    reward_scale: float | None

    def reset(self, seed: int) -> None:
        """Start the episode that belongs to `seed`."""
        ...

    def step(self, action: NDArray[np.float64]) -> Outcome:
        """Play an action in [-1, 1] for one control step."""
        ...

    def agent_pos(self) -> NDArray[np.float64]:
        """Return proprioception (D,)."""
        ...

    def state(self) -> NDArray[np.float64]:
        """Return the privileged state (S,), as laid out by the task's `state_layout`."""
        ...

    def save(self) -> EpisodeState:
        """Return what belongs to the episode and is neither in MuJoCo's state nor decided by the seed."""
        ...

    def restore(self, saved: EpisodeState) -> None:
        """Take back what `save` returned."""
        ...

    def close(self) -> None:
        """Free what it holds."""
        ...


class MujocoSimulator(Simulator):
    """One row of a MuJoCo task.

    An episode goes on to its time limit whether or not the task is solved: in these suites success is a passing
    moment ("any"), or must last until the end ("last").

    Args:
        spec: the environment's spec, already specialised.
        config: how to build it.
        task: its row of the suite's table.
        env: the suite's environment.

    Raises:
        BackendError: more than one row, or another device than the CPU.
        ConfigError: a reward mode that the suite does not have, realism, a camera file, or a voxel grid without a box.
    """

    def __init__(self, spec: EnvSpec, config: SimulatorConfig, task: MujocoTask, env: SuiteEnv) -> None:
        if config.num_rows != 1 or config.device != "cpu":
            raise BackendError(f"{spec.env_id} runs in MuJoCo, one row a process on the CPU: use backend='cpu'")
        if config.reward_mode == "normalized_dense" and env.reward_scale is None:
            raise ConfigError(f"{spec.env_id}: its dense reward has no bounds; use 'dense', 'sparse' or 'none'")
        config.require_ideal(spec.env_id)
        self.spec, self.config, self.num_rows = spec, config, 1
        self.device = torch.device("cpu")
        self.env, self._view = env, task.views[config.obs_preset]
        if VOXEL_GRID in config.obs:
            _require_extent(self._view, f"{spec.env_id} with obs_preset {config.obs_preset!r}")
        self._camera = _place_camera(env.model, self._view.camera, self._view.pose)
        if self._view.clip is not None:
            env.model.vis.map.znear, env.model.vis.map.zfar = self._view.clip
        self._video_camera = task.video
        size = self._view.size or config.image_size
        largest = [max(sides) for sides in zip(size, config.image_size, VIDEO_SIZE, strict=True)]
        self._renderer = LeanRenderer(env.model, (largest[0], largest[1]), self._view.solid)
        self._rays = _pixel_rays(size, env.model.cam_fovy[self._camera], self._view.pixel_centre)
        self._cloud_size = size
        self._seed = -1
        self._success_steps = 0
        self._closed = False

    def reset(self, rows: Tensor, seeds: Sequence[int]) -> None:
        """See `Simulator.reset`."""
        if len(rows):
            self._start(int(seeds[0]))

    def _start(self, seed: int) -> None:
        self._seed, self._success_steps = seed, 0
        self.env.reset(seed)

    def step(self, actions: Tensor) -> StepResult:
        """See `Simulator.step`.

        Beside the task's own facts, info holds "success_steps", environment steps with success since the reset.
        """
        outcome = self.env.step(actions[0].numpy().astype(np.float64))
        self._success_steps += outcome.success_steps
        facts = {
            "success": torch.tensor([outcome.success]),
            "fail": torch.tensor([outcome.failed]),
            "success_steps": torch.tensor([self._success_steps]),
            **{name: torch.tensor([value]) for name, value in outcome.facts.items()},
        }
        return StepResult(torch.tensor([self._reward(outcome)]), torch.tensor([outcome.failed]), facts)

    def _reward(self, outcome: Outcome) -> float:
        mode = self.config.reward_mode
        if mode == "sparse":
            return float(outcome.success)
        if mode == "none":
            return 0.0
        return outcome.reward / (self.env.reward_scale or 1.0) if mode == "normalized_dense" else outcome.reward

    def observe(self) -> dict[str, Tensor]:
        """See `Simulator.observe`."""
        wanted = self.config.obs
        frame: dict[str, NDArray[Any]] = {}
        if AGENT_POS in wanted:
            frame[AGENT_POS] = self.env.agent_pos().astype(np.float32)
        if STATE in wanted:
            frame[STATE] = self.env.state().astype(np.float32)
        pictures: dict[tuple[int, int], Picture] = {}
        cropped: dict[str, Tensor] = {}
        if POINT_CLOUD in wanted or VOXEL_GRID in wanted:
            pictures[self._cloud_size] = picture = self._shoot(self._cloud_size)
            cropped = self._observe_cropped(self._points(picture))
        if IMAGE in wanted or DEPTH in wanted:
            size = self.config.image_size
            picture = pictures.get(size) or self._shoot(size)
            frame |= {IMAGE: picture.image, DEPTH: np.where(picture.hit, picture.depth, np.float32(0))}
        return {key: cropped[key] if key in cropped else torch.from_numpy(frame[key])[None] for key in wanted}

    def _shoot(self, size: tuple[int, int]) -> Picture:
        return self._renderer.render(self.env.data, self._camera, size)

    def _observe_cropped(self, points: NDArray[np.float32]) -> dict[str, Tensor]:
        """Return what is wanted of the points (K, C) in the workspace; the view says how its cloud is sampled."""
        cropped, obs = CroppedPoints.of_rows([points]), self.spec.obs
        frame = observe_cropped(set(self.config.obs) - {POINT_CLOUD}, cropped, self._view.extent, obs)
        if POINT_CLOUD in self.config.obs:
            frame[POINT_CLOUD] = clouds_of(cropped, obs.num_points, self._view.sampler)
        return frame

    def _points(self, picture: Picture) -> NDArray[np.float32]:
        """Return the points (K, C) of a picture that lie in the workspace."""
        model, data, camera = self.env.model, self.env.data, self._camera
        T_cloud_camera = self._view.frame.from_camera(
            data.cam_xmat[camera].reshape(3, 3), data.cam_xpos[camera], model.cam_mat0[0].reshape(3, 3)
        ).astype(np.float32)
        hit = np.flatnonzero(picture.hit)
        xyz = self._rays[hit] * picture.depth.reshape(-1, 1)[hit]
        parts = [crop_transformed(xyz, T_cloud_camera, box) for box in self._view.workspace]
        points = np.concatenate([inside for _, inside in parts])
        if self.config.colors:
            pixels = hit[np.concatenate([index for index, _ in parts])]
            points = np.concatenate([points, picture.image.reshape(-1, 3)[pixels] / np.float32(255)], axis=1)
        return points

    def render_video_frames(self) -> Tensor:
        """See `Simulator.render_video_frames`."""
        model, data = self.env.model, self.env.data
        name, pose = self._video_camera
        camera = model.camera(name).id
        before = FixedPose(tuple(model.cam_pos[camera]), tuple(model.cam_quat[camera]))
        _place_camera(model, name, pose)
        mujoco.mj_camlight(model, data)
        image = self._renderer.render(data, camera, VIDEO_SIZE).image
        _place_camera(model, name, before)
        mujoco.mj_camlight(model, data)
        return torch.from_numpy(image)[None]

    def save_state(self) -> EpisodeState:
        """Return the whole state of the present frame: `restore_state` brings it back, here or in another process.

        It holds MuJoCo's integration state (mjSTATE_INTEGRATION), what the reset wrote into the model, the episode's
        seed and what the suite keeps itself.
        """
        model, data = self.env.model, self.env.data
        integration = np.empty(mujoco.mj_stateSize(model, _FULL_STATE))
        mujoco.mj_getState(model, data, integration, _FULL_STATE)
        return {
            "seed": np.array(self._seed),
            "success_steps": np.array(self._success_steps),
            "integration": integration,
            **{name: getattr(model, name).copy() for name in _MODEL_ARRAYS},
            **{f"suite_{name}": value for name, value in self.env.save().items()},
        }

    def restore_state(self, saved: EpisodeState) -> None:
        """Bring back a frame that `save_state` returned: it is observed as it was, and goes on as it did.

        Raises ConfigError where the state belongs to another task.
        """
        model, data = self.env.model, self.env.data
        size = mujoco.mj_stateSize(model, _FULL_STATE)
        if saved["integration"].shape != (size,) or saved["body_pos"].shape != model.body_pos.shape:
            raise ConfigError(
                f"this stored state is of another task: {saved['integration'].shape[0]} numbers and "
                f"{len(saved['body_pos'])} bodies, {self.spec.env_id} has {size} and {len(model.body_pos)}"
            )
        self._start(int(saved["seed"]))  # sets what the suite's environment remembers of its reset
        self._success_steps = int(saved["success_steps"])
        for name in _MODEL_ARRAYS:
            getattr(model, name)[:] = saved[name]
        mujoco.mj_setState(model, data, saved["integration"], _FULL_STATE)
        update_derived(model, data)
        prefix = "suite_"
        self.env.restore({k.removeprefix(prefix): value for k, value in saved.items() if k.startswith(prefix)})

    def close(self) -> None:
        """See `Simulator.close`."""
        if not self._closed:
            self._closed = True
            self._renderer.close()
            self.env.close()


def _require_extent(view: View, name: str) -> None:
    """Raise ConfigError where the view crops to no box of a scene's size: a grid would hold all in a few cells."""
    longest = max(high - low for low, high in zip(*view.extent, strict=True))
    if longest > _MOST_METRES:
        raise ConfigError(
            f"{name} has no voxel_grid: its clouds are cropped to a box of {longest:.4g} m; use obs_preset 'manicm_ms'"
        )


def _place_camera(model: mujoco.MjModel, name: str, pose: FixedPose) -> int:
    """Put the model's camera `name` at `pose` and return its number; the next mj_forward takes it over."""
    camera = model.camera(name).id
    if pose.position is not None:
        model.cam_pos[camera] = pose.position
    if pose.quat_wxyz is not None:
        model.cam_quat[camera] = pose.quat_wxyz
    return camera


def _pixel_rays(size: tuple[int, int], fovy_deg: float, pixel_centre: float) -> NDArray[np.float32]:
    """Return the points at depth 1 that the pixels see, (H*W, 3) in MuJoCo's camera axes (x right, y up, z back)."""
    height, width = size
    focal = height / (2 * math.tan(math.radians(fovy_deg) / 2))  # px, square pixels
    x = (np.arange(width) + pixel_centre - width / 2) / focal
    y = -(np.arange(height) + pixel_centre - height / 2) / focal
    rays = np.stack([*np.meshgrid(x, y), np.full(size, -1.0)], axis=-1)
    return rays.reshape(-1, 3).astype(np.float32)
