"""What makes an episode real: ranges of camera errors and physical values, drawn from the episode's seed.

A value is a function of the ranges, the seed and the objects' names alone, so that the simulator, the collector and
the evaluator compute the same values without talking to each other. The draws come from streams of their own: the
scene that a task draws from the same seed stays as it is, and two presets share every draw that both use.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manicm_ms.errors import ConfigError
from manicm_ms.registry import Registry
from manicm_ms.sensing.camera import CameraModel
from manicm_ms.sensing.stereo_depth import StereoDepth
from manicm_ms.spec import EnvSpec

RealismSample = dict[str, float]
"""Name -> value. `<object>.<what>` for what belongs to one object; factors multiply the task's own value."""

TABLE = "table"
"""The object that every UR3e task has beside those of its privileged state."""

_STREAM = 0x2EA1  # sets these draws apart from whatever else is drawn from an episode's seed
_MOST_DELAY = 20  # control steps, a second


@dataclass(frozen=True)
class Realism:
    """Ranges of what is drawn once an episode. Zero everywhere, the default, is the simulator's ideal world.

    A range r means uniform in -r..r, for a factor in 1-r..1+r, each component on its own.

    Attributes:
        depth: how the depth camera errs; None gives ideal depth.
        depth_scale: relative error of every depth reading.
        extrinsic_shift: m, per axis: the cloud is mapped with a camera position that is wrong by this.
        extrinsic_turn: rad, per axis: and with an orientation that is wrong by this.
        camera_shift: m, per axis: the camera stands elsewhere, and the cloud knows.
        camera_turn: rad, per axis: the camera looks elsewhere, and the cloud knows.
        crop_floor: m above the base's plane: clouds start here where the task's crop box starts lower, so that a table
            that the errors above lift by some millimetres does not fill them.
        focal: relative error of the calibrated focal length; the cloud uses the calibrated one.
        centre: native pixels, per axis: error of the calibrated principal point.
        table_height: m that the table's top stands above (below) the plane of the robot's base.
        friction: relative, of each object's and the table's friction value.
        mass: relative, of each object's mass.
        size: relative, of each object's edges, all three alike.
        color: added to each channel of each object's colour, in [0, 1].
        gains: relative, of stiffness and damping of arm and fingers, four factors.
        lighting: 1 lights pictures and colours by a lamp of random direction, strength and colour, 0 by one at the
            camera.
        action_delay: most control steps by which every action is late; 0, 1, ... are equally likely.
        gripper_delay: most control steps by which the gripper is later still.

    Raises:
        ConfigError: a range that is negative, a factor that could reach 0, a delay beyond a second.
    """

    depth: StereoDepth | None = None
    depth_scale: float = 0.0
    extrinsic_shift: float = 0.0
    extrinsic_turn: float = 0.0
    camera_shift: float = 0.0
    camera_turn: float = 0.0
    crop_floor: float = 0.0
    focal: float = 0.0
    centre: float = 0.0
    table_height: float = 0.0
    friction: float = 0.0
    mass: float = 0.0
    size: float = 0.0
    color: float = 0.0
    gains: float = 0.0
    lighting: int = 0
    action_delay: int = 0
    gripper_delay: int = 0

    def __post_init__(self) -> None:
        ranges = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "depth"}
        for name, value in ranges.items():
            if not (np.isfinite(value) and value >= 0):
                raise ConfigError(f"realism range {name} must not be negative, got {value}")
        for name in ("depth_scale", "focal", "friction", "mass", "size", "gains", "color"):
            if ranges[name] >= 1:
                raise ConfigError(f"realism range {name} is relative: it must be below 1, got {ranges[name]}")
        if self.lighting not in (0, 1):
            raise ConfigError(f"realism range lighting is 0 or 1, got {self.lighting}")
        for name in ("action_delay", "gripper_delay"):
            if ranges[name] != int(ranges[name]) or ranges[name] > _MOST_DELAY:
                raise ConfigError(f"realism range {name} is 0 to {_MOST_DELAY} control steps, got {ranges[name]}")

    @property
    def is_clean(self) -> bool:
        """Whether nothing differs from the simulator's ideal world."""
        return self == Realism()

    @property
    def builds(self) -> bool:
        """Whether something is drawn that is fixed when a scene is built: a batch must then restart all its rows."""
        return any(getattr(self, f.name) for f in fields(self) if f.name not in _AFTER_BUILDING)

    def to_dict(self) -> dict[str, Any]:
        """Return plain JSON values, to be recorded and compared."""
        return json.loads(json.dumps(asdict(self)))

    def sample(self, seed: int, objects: Iterable[str] = (), fixed: Iterable[str] = ()) -> RealismSample:
        """Draw the values of the episode with this seed.

        Args:
            seed: the episode's.
            objects: names of the task's objects; the values of one do not depend on the others.
            fixed: those among them that never move and keep their size and mass.

        Returns:
            Name -> value, the same names for every seed; a value whose range is 0 has no name.
        """
        values = self._draw_of_cell(np.random.default_rng([seed, _STREAM]))
        for name in (TABLE, *objects):
            rng = np.random.default_rng([seed, _STREAM, zlib.crc32(name.encode())])
            drawn = self._draw_of_object(rng, fixed=name == TABLE or name in fixed)
            values |= {f"{name}.{key}": value for key, value in drawn.items()}
        return values

    def _draw_of_cell(self, rng: np.random.Generator) -> RealismSample:
        """Draw once for each value in a fixed order, whatever its range: presets share the draws. New ones go last."""
        values: RealismSample = {}
        for name, reach, neutral in self._continuous():
            u = rng.uniform(-1.0, 1.0)
            if reach:
                values[name] = float(neutral + reach * u)
        for name in ("action_delay", "gripper_delay"):
            u, most = rng.random(), getattr(self, name)
            if most:
                values[name] = float(int(u * (most + 1)))
        for name, (low, high) in LIGHT.items():
            u = rng.random()
            if self.lighting:
                values[f"light_{name}"] = float(low + (high - low) * u)
        return values

    def _continuous(self) -> list[tuple[str, float, float]]:
        """Return (name, range, neutral value) of what is uniform about its neutral value."""
        poses = (
            ("extrinsic", self.extrinsic_shift, self.extrinsic_turn),
            ("camera", self.camera_shift, self.camera_turn),
        )
        return [
            ("depth_scale_factor", self.depth_scale, 1.0),
            *((f"{name}_{axis}", shift, 0.0) for name, shift, _ in poses for axis in "xyz"),
            *((f"{name}_r{axis}", turn, 0.0) for name, _, turn in poses for axis in "xyz"),
            ("focal_factor", self.focal, 1.0),
            ("centre_u", self.centre, 0.0),
            ("centre_v", self.centre, 0.0),
            ("table_height", self.table_height, 0.0),
            *((f"{name}_factor", self.gains, 1.0) for name in GAINS),
        ]

    def _draw_of_object(self, rng: np.random.Generator, fixed: bool) -> RealismSample:
        moving = 0.0 if fixed else 1.0
        ranges = [
            ("friction_factor", self.friction, 1.0),
            ("mass_factor", self.mass * moving, 1.0),
            ("size_factor", self.size * moving, 1.0),
            *((channel, self.color, 0.0) for channel in ("red", "green", "blue")),
        ]
        drawn = zip(ranges, rng.uniform(-1.0, 1.0, size=len(ranges)), strict=True)
        return {name: float(neutral + reach * u) for (name, reach, neutral), u in drawn if reach}


_AFTER_BUILDING = {
    "depth", "depth_scale", "extrinsic_shift", "extrinsic_turn", "crop_floor", "lighting", "action_delay",
    "gripper_delay",
}  # fmt: skip
GAINS = ("arm_stiffness", "arm_damping", "finger_stiffness", "finger_damping")
"""Drive gains that have a factor each."""

LIGHT: Mapping[str, tuple[float, float]] = {
    "azimuth": (-np.pi, np.pi),  # rad about the base frame's z: windows and lamps stand anywhere
    "elevation": (0.5, 1.4),  # rad above the table: from a low window to a lamp overhead
    "ambient": (0.2, 0.6),  # of full brightness: what walls and ceiling give back
    "strength": (0.4, 1.0),  # of full brightness, on a surface that faces the lamp
    "temperature": (2700.0, 6500.0),  # K: from an incandescent lamp to daylight
}
"""Range of each value of the random lamp."""


class RealismRows:
    """The values of N rows, by name; what was not drawn is neutral: a factor 1, anything else 0.

    Args:
        samples: one a row.
    """

    def __init__(self, samples: Sequence[Mapping[str, float]]) -> None:
        self._samples = [dict(sample) for sample in samples]

    def __len__(self) -> int:
        return len(self._samples)

    def __contains__(self, name: str) -> bool:
        return any(name in sample for sample in self._samples)

    def __getitem__(self, name: str) -> NDArray[np.float64]:
        """Return the values called `name`, (N,)."""
        neutral = 1.0 if name.endswith("_factor") else 0.0
        return np.array([sample.get(name, neutral) for sample in self._samples])

    def vectors(self, *names: str) -> NDArray[np.float64]:
        """Return the values called `names` side by side, (N, len(names))."""
        return np.stack([self[name] for name in names], axis=1)

    def replaced(self, rows: Sequence[int], samples: Sequence[Mapping[str, float]]) -> RealismRows:
        """Return the same with new samples in `rows`."""
        fresh = dict(zip(rows, samples, strict=True))
        return RealismRows([fresh.get(k, sample) for k, sample in enumerate(self._samples)])


def true_cameras(camera: CameraModel, rows: RealismRows) -> list[CameraModel]:
    """Return what the camera of each row really is, where `camera` is what its file says.

    The pose moves and the cloud knows it; the intrinsics are off and the cloud does not.
    """
    poses = displaced(camera.pose, rows.vectors(*_axes("camera")), rows.vectors(*_axes("camera_r")))
    focal, u, v = rows["focal_factor"], rows["centre_u"], rows["centre_v"]
    return [
        replace(
            camera,
            fx=camera.fx * focal[k],
            fy=camera.fy * focal[k],
            cx=camera.cx + u[k],
            cy=camera.cy + v[k],
            T_base_camera=tuple(map(tuple, poses[k].tolist())),
        )
        for k in range(len(rows))
    ]


def believed_poses(cameras: Sequence[CameraModel], rows: RealismRows) -> NDArray[np.float64]:
    """Return the poses T_base_camera (N, 4, 4) that clouds are mapped with: the true ones with the extrinsic error."""
    shift, turn = rows.vectors(*_axes("extrinsic")), rows.vectors(*_axes("extrinsic_r"))
    errors = zip(cameras, shift, turn, strict=True)
    return np.stack([displaced(camera.pose, s[None], t[None])[0] for camera, s, t in errors])


def displaced(T: NDArray[np.float64], shift: NDArray[np.float64], turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return T (4, 4) shifted by `shift` (N, 3) m and turned about its own origin by rotation vectors (N, 3) rad.

    Both in the frame that T maps to: R' = exp(turn) R, p' = p + shift. Returns (N, 4, 4).
    """
    moved = np.repeat(T[None], len(shift), axis=0)
    moved[:, :3, :3] = _rotations(turn) @ T[:3, :3]
    moved[:, :3, 3] += shift
    return moved


def _rotations(turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrices (N, 3, 3) of rotation vectors (N, 3) rad, by Rodrigues' formula."""
    angle = np.linalg.norm(turn, axis=1)[:, None, None]
    x, y, z = (turn / np.maximum(angle[:, :, 0], 1e-12)).T
    zero = np.zeros_like(x)
    K = np.stack([np.stack(row, axis=-1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))], axis=1)
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K)


def _axes(prefix: str) -> tuple[str, ...]:
    separator = "" if prefix.endswith("_r") else "_"
    return tuple(f"{prefix}{separator}{axis}" for axis in "xyz")


def objects_of(spec: EnvSpec) -> tuple[str, ...]:
    """Return the names of the objects whose poses the privileged state of `spec` holds, in its order."""
    poses = (name.removesuffix("_pose") for name in spec.state_layout if name.endswith("_pose"))
    return tuple(name for name in poses if name not in ("tcp", "tcp_target"))


REALISM: Registry[Realism] = Registry("realism preset")

REALISM.add("clean", Realism())

_D435I: dict[str, Any] = {
    "depth": StereoDepth(),  # noise, shadows, fat edges and holes: see there
    "depth_scale": 0.005,  # D400 units are specified to 2 % and measured at 0.5 to 1 % at short range
    "extrinsic_shift": 0.003,  # m: a hand-eye calibration ends at 2 to 5 mm
    "extrinsic_turn": 0.0052,  # rad, 0.3 deg: and at about half a degree in all
    "crop_floor": 0.012,  # m: in 20 episodes at most 5 pixels of the table rise above it (decision 0011)
}
REALISM.add("d435i", Realism(**_D435I))

REALISM.add(
    "d435i+dr",
    Realism(
        **_D435I,
        camera_shift=0.010,  # m: a tripod put back to its marks
        camera_turn=0.0175,  # rad, 1 deg: and turned by hand
        focal=0.003,  # units in the field differ from their data sheet by 0.3 % (381.9 to 384.2 px)
        centre=1.0,  # px: half of what separates units, the rest is calibrated away
        table_height=0.003,  # m: a table levelled against the robot's foot with a ruler
        friction=0.3,  # wood, plastic and printed parts: 0.3 to 0.6 on each other
        mass=0.2,  # printed parts by their infill
        size=0.05,  # 2 mm on a 40 mm cube: hand-made parts; the experts' fingers still reach around them
        color=0.1,  # paint under another white balance
        lighting=1,
        gains=0.15,  # step responses of a real arm are known to about this
        action_delay=1,  # 0 or 50 ms: camera exposure and transfer, network, robot's own interpolation
        gripper_delay=2,  # 0 to 100 ms more: a request over Modbus RTU at 115200 baud, and the motor's start
    ),
)


def parse_presets(text: str) -> tuple[str, ...]:
    """Return the presets that a comma-separated list names, each once, in its order.

    Raises UnknownNameError, ConfigError where there is none or one stands twice.
    """
    names = tuple(name.strip() for name in text.split(",") if name.strip())
    for name in names:
        REALISM.get(name)
    if not names or len(set(names)) < len(names):
        raise ConfigError(
            f"name each realism preset once, separated by commas ({', '.join(REALISM.names())}): {text!r}"
        )
    return names


def realism_name(realism: Realism) -> str:
    """Return the name of the preset with these ranges, "custom" where there is none."""
    return next((name for name in REALISM.names() if REALISM.get(name) == realism), "custom")


def resolve_realism(realism: str | Realism) -> Realism:
    """Return the preset of this name, or what is already a `Realism`; raise UnknownNameError with the nearest name."""
    return realism if isinstance(realism, Realism) else REALISM.get(realism)
