"""What the MuJoCo suites' tables say of a task, as data: cameras, clouds and episode lengths. Imports no simulator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from packaging.requirements import Requirement

from manicm_ms.errors import BackendError, ConfigError
from manicm_ms.sensing.cropped import Sampler
from manicm_ms.sensing.point_cloud import Box, sample_cloud
from manicm_ms.spec import DP3_FRAME, WORLD_FRAME, ActionSpec, EnvSpec, ObsSpec

MANICM_MS, DP3 = "manicm_ms", "dp3"
"""Observation presets: the clean cloud in the world frame, and the one of the public DP3 wrapper."""

Matrix3 = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


def sample_or_pad_with_zeros(points: NDArray[np.float32], num_points: int) -> NDArray[np.float32]:
    """Return `num_points` of the points (M, C) by farthest-point sampling; where M is smaller, all and then zeros.

    As the public DP3 code pads (`point_cloud_sampling`); its first sampled point is point 0, ours the tree's.
    """
    if len(points) > num_points:
        return sample_cloud(points, num_points)
    padded = np.zeros((num_points, points.shape[1]), np.float32)
    padded[: len(points)] = points
    return padded


@dataclass(frozen=True)
class FixedPose:
    """Where a camera stands. MuJoCo's camera axes: x right, y up, looking along -z.

    Attributes:
        position: metres, world frame; None leaves it as the model has it.
        quat_wxyz: orientation; None leaves it as the model has it.
    """

    position: tuple[float, float, float] | None = None
    quat_wxyz: tuple[float, float, float, float] | None = None


class CloudFrame(Protocol):
    """Where a cloud's coordinates are measured."""

    @property
    def name(self) -> str:
        """See `ObsSpec.frame`."""
        ...

    def from_camera(self, R_world_camera: NDArray[np.float64], position: NDArray[np.float64],
                    first_camera: NDArray[np.float64]) -> NDArray[np.float64]:  # fmt: skip
        """Return T_cloud_camera (4, 4), MuJoCo's camera axes.

        Args:
            R_world_camera: (3, 3), the camera's orientation.
            position: (3,), its place, metres.
            first_camera: (3, 3), orientation of the model's first camera.
        """
        ...


@dataclass(frozen=True)
class WorldFrame:
    """Coordinates are MuJoCo's world's."""

    name: str = WORLD_FRAME

    def from_camera(
        self, R_world_camera: NDArray[np.float64], position: NDArray[np.float64], first_camera: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See `CloudFrame.from_camera`."""
        return _homogeneous(R_world_camera, position)


@dataclass(frozen=True)
class Dp3Frame:
    """Coordinates of the public DP3 wrapper: centred on the camera, turned as if the model's first camera had looked.

    Its `PointCloudGenerator` indexes the model's cameras by 0 instead of by the camera that rendered, and takes the
    position of that camera's body, which is the world's origin. The wrapper then turns the cloud by a matrix that was
    found by eye, so that z points nearly upwards, and shifts it.

    Attributes:
        rotation: the wrapper's `pc_transform`.
        offset: the wrapper's `pc_offset`, metres.
        name: see `ObsSpec.frame`.
    """

    rotation: Matrix3
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    name: str = DP3_FRAME

    def from_camera(
        self, R_world_camera: NDArray[np.float64], position: NDArray[np.float64], first_camera: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """See `CloudFrame.from_camera`."""
        return _homogeneous(np.array(self.rotation) @ first_camera, np.array(self.offset))


def _homogeneous(rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation, translation
    return T


@dataclass(frozen=True)
class View:
    """How a task is looked at and its cloud is made.

    Attributes:
        camera: the model's camera that looks.
        workspace: what is kept of the cloud, in `frame`: what lies in one of these boxes, which do not overlap.
        pose: where the camera is put.
        frame: the cloud's frame.
        size: (H, W) that the cloud is rendered at, pixels; None: that of the images.
        pixel_centre: where a pixel's centre lies in it: 0.5, or 0 as the public DP3 code has it.
        clip: near and far plane, in units of the model's extent; None leaves them as the model has them.
        solid: draw translucent things solid; else their depth is that of what shines through them.
        sampler: makes the cloud of P points from those in the workspace.
    """

    camera: str
    workspace: tuple[Box, ...]
    pose: FixedPose = FixedPose()
    frame: CloudFrame = WorldFrame()
    size: tuple[int, int] | None = None
    pixel_centre: float = 0.5
    clip: tuple[float, float] | None = None
    solid: bool = True
    sampler: Sampler = sample_cloud

    @property
    def extent(self) -> Box:
        """The box around all of the workspace."""
        lows, highs = zip(*self.workspace, strict=True)
        return Box(tuple(map(min, zip(*lows, strict=True))), tuple(map(max, zip(*highs, strict=True))))


@dataclass(frozen=True)
class MujocoTask:
    """A row of a suite's table.

    Attributes:
        env_id: for example "metaworld/button-press".
        suite_id: the suite's own name, for example "button-press-v3".
        group: difficulty group of the benchmark's tables; also a tag.
        views: observation preset -> view.
        video: the camera of `render_video_frames`, and its pose.
        agent_pos_names: name and unit of each entry of `agent_pos`.
        state_layout: name -> (start, stop) of the parts of `state`.
        action: what an action means.
        max_episode_steps: control steps of an episode.
        action_repeat: environment steps that each action is held for.
        success_rule: see `EnvSpec`.
        demo_success_steps: environment steps with success that a demonstration must hold to be kept.
        tcp_indices: see `EnvSpec`.
        benchmark: whether it is one of the 31 tasks of ManiCM's main table.
        former_names: names that other versions and wrappers give it.
    """

    env_id: str
    suite_id: str
    group: str
    views: Mapping[str, View]
    video: tuple[str, FixedPose]
    agent_pos_names: tuple[str, ...]
    state_layout: Mapping[str, tuple[int, int]]
    action: ActionSpec
    max_episode_steps: int
    action_repeat: int
    success_rule: str
    demo_success_steps: int
    tcp_indices: tuple[int, int, int] | None = None
    benchmark: bool = False
    former_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if set(self.views) != {MANICM_MS, DP3}:
            raise ConfigError(f"{self.env_id}: views are needed for {MANICM_MS} and {DP3}, got {sorted(self.views)}")

    @property
    def spec(self) -> EnvSpec:
        """The environment's spec, with the default observation preset."""
        return EnvSpec(
            env_id=self.env_id,
            obs=ObsSpec(512, 3, len(self.agent_pos_names), self.views[MANICM_MS].frame.name),
            action=self.action,
            max_episode_steps=self.max_episode_steps,
            agent_pos_names=self.agent_pos_names,
            tcp_indices=self.tcp_indices,
            state_layout=dict(self.state_layout),
            success_rule=self.success_rule,
        )

    @property
    def tags(self) -> tuple[str, ...]:
        """Suite, group and, where it belongs there, the benchmark."""
        suite = self.env_id.partition("/")[0]
        return tuple(dict.fromkeys((suite, self.group, *(("benchmark31",) if self.benchmark else ()))))


def layout(**lengths: int) -> dict[str, tuple[int, int]]:
    """Return name -> (start, stop) of parts that follow each other, from their lengths."""
    stops = np.cumsum(list(lengths.values())).tolist()
    return {name: (stop - n, stop) for (name, n), stop in zip(lengths.items(), stops, strict=True)}


class Outcome(NamedTuple):
    """What one control step of a suite's environment brought.

    Attributes:
        success: the task is solved now.
        failed: it cannot be solved any more.
        reward: the suite's own dense reward, summed over the environment steps.
        success_steps: environment steps with success in this control step.
        facts: further named values.
    """

    success: bool
    failed: bool
    reward: float
    success_steps: int
    facts: dict[str, float]


def require_suite(distribution: str) -> None:
    """Raise BackendError where a suite's package is missing, or mujoco is of a version that it refuses."""
    try:
        needs = metadata.requires(distribution) or []
        mujoco_version = metadata.version("mujoco")
    except metadata.PackageNotFoundError as error:
        remedy = "run 'make setup', or pip install 'manicm_ms[mujoco]'"
        raise BackendError(f"{error.name} is not installed: {remedy}") from error
    for need in map(Requirement, needs):
        if need.name == "mujoco" and not need.marker and mujoco_version not in need.specifier:
            suite = f"{distribution} {metadata.version(distribution)}"
            raise BackendError(
                f"{suite} needs mujoco{need.specifier}, installed is {mujoco_version}: "
                f"pip install 'mujoco{need.specifier}'"
            )
