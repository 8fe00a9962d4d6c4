"""Batched way-point following: straight, smooth tool lines from privileged state, and the experts made of them.

Every row runs through its own way-points at its own pace with the same torch code, so one expert drives one row on a
CPU or thousands on a GPU. No planner and no loop over rows.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from manicm_ms.demos.experts import require_style
from manicm_ms.spec import EnvSpec

# Commands are rounded to this grid: torch's vectorised and scalar paths differ in the last bit of sin, exp and the
# like, so without it the same episode could differ between batch sizes.
_ACTION_GRID = 2.0**-16


@dataclass(frozen=True)
class Motion:
    """How the tool moves between way-points.

    Attributes:
        metres_per_unit: translation per control step of an action entry of 1.
        radians_per_unit: rotation per control step of an action entry of 1.
        max_opening: gripper opening of an action entry of +1 (-1 is closed), m.
        acceleration: m/s^2.
        turn_speed: rad/s about the tool axis.
        target_tolerance: commanded target within this distance of the way-point, m ...
        tcp_tolerance: ... and the measured TCP within this one: the way-point is reached, m.
        control_hz: control steps per second.
    """

    metres_per_unit: float
    radians_per_unit: float
    max_opening: float
    acceleration: float = 0.6
    turn_speed: float = 1.2
    target_tolerance: float = 1e-3
    tcp_tolerance: float = 5e-3
    control_hz: float = 20.0


@dataclass(frozen=True)
class Waypoints:
    """The way-points of a batch of episodes.

    Attributes:
        position: (N, W, 3) TCP positions, m, robot-base frame.
        yaw: (N, W) turn about base z away from the TCP's orientation at the start of the episode, rad.
        opening: (N, W) gripper opening while moving to the way-point, m.
        speed: (W,) largest speed on the line to the way-point, m/s.
        dwell: (W,) control steps to wait once it is reached.
    """

    position: Tensor
    yaw: Tensor
    opening: Tensor
    speed: Tensor
    dwell: Tensor


class WaypointFollower:
    """Turns the present state into the next action, row by row independent.

    The speed along a line follows a trapezoid, limited so that the tool can always stop at the way-point without
    overshoot. Planning uses the controller's target, which runs ahead of the arm; arrival uses both.

    Args:
        spec: names the parts of the privileged state (tcp_pose, tcp_target_pose).
        num_envs: N.
        motion: limits and scales.
    """

    def __init__(self, spec: EnvSpec, num_envs: int, motion: Motion, device: torch.device | str = "cpu") -> None:
        self._layout, self._motion = spec.state_layout, motion
        self._waypoints: Waypoints | None = None
        self._index = torch.zeros(num_envs, dtype=torch.int64, device=device)
        self._waited = torch.zeros_like(self._index)
        self._velocity = torch.zeros(num_envs, 3, dtype=torch.float64, device=device)
        self._yaw = torch.zeros(num_envs, dtype=torch.float64, device=device)

    def reset(self, waypoints: Waypoints, mask: Tensor) -> None:
        """Give the rows in `mask` (N,) bool new way-points (those of the other rows are ignored)."""
        if self._waypoints is None:
            self._waypoints = waypoints
        else:
            old, chosen = self._waypoints, mask[:, None]
            self._waypoints = Waypoints(
                position=torch.where(chosen[..., None], waypoints.position, old.position),
                yaw=torch.where(chosen, waypoints.yaw, old.yaw),
                opening=torch.where(chosen, waypoints.opening, old.opening),
                speed=waypoints.speed,
                dwell=waypoints.dwell,
            )
        for counter in (self._index, self._waited, self._yaw):
            counter[mask] = 0
        self._velocity[mask] = 0

    def act(self, state: Tensor) -> Tensor:
        """Return the next action (N, 7) float32 for the privileged state (N, S)."""
        assert self._waypoints is not None, "reset before the first action"
        tcp, target = self._part(state, "tcp_pose"), self._part(state, "tcp_target_pose")
        self._advance(tcp, target)
        row = torch.arange(len(state), device=state.device)
        way, k = self._waypoints, self._index
        step = self._step(way.position[row, k] - target, way.speed[k])  # (N, 3) m
        turn = self._turn(way.yaw[row, k])  # (N,) rad
        opening = 2 * way.opening[row, k] / self._motion.max_opening - 1
        still = torch.zeros_like(turn)
        turns = torch.stack([still, still, turn / self._motion.radians_per_unit], dim=1)
        action = torch.cat([step / self._motion.metres_per_unit, turns, opening[:, None]], dim=1)
        return (torch.round(action / _ACTION_GRID) * _ACTION_GRID).clamp(-1, 1).float()

    def _part(self, state: Tensor, name: str) -> Tensor:
        start, _ = self._layout[name]
        return state[:, start : start + 3].double()

    def _advance(self, tcp: Tensor, target: Tensor) -> None:
        """Move on to the next way-point in the rows that have reached theirs and waited long enough."""
        way, row = self._waypoints, torch.arange(len(tcp), device=tcp.device)
        assert way is not None
        goal, yaw = way.position[row, self._index], way.yaw[row, self._index]
        near = (goal - target).norm(dim=1) < self._motion.target_tolerance
        near &= (goal - tcp).norm(dim=1) < self._motion.tcp_tolerance
        near &= (yaw - self._yaw).abs() < 1e-3
        self._waited = torch.where(near, self._waited + 1, 0)
        done = self._waited > way.dwell[self._index]
        last = way.position.shape[1] - 1
        self._index = torch.where(done, (self._index + 1).clamp(max=last), self._index)
        self._waited = torch.where(done, 0, self._waited)

    def _step(self, offset: Tensor, speed: Tensor) -> Tensor:
        """Return how far the target moves in this control step, (N, 3) m, towards `offset` (N, 3)."""
        dt, most = 1 / self._motion.control_hz, self._motion.acceleration
        distance = offset.norm(dim=1)
        wanted = torch.minimum(speed, stopping_speed(distance, most, dt))
        velocity = offset / distance.clamp(min=1e-9)[:, None] * wanted[:, None]
        change = velocity - self._velocity
        size = change.norm(dim=1)
        self._velocity = self._velocity + change * (most * dt / size.clamp(min=1e-9)).clamp(max=1)[:, None]
        return self._velocity * dt

    def _turn(self, yaw: Tensor) -> Tensor:
        most = self._motion.turn_speed / self._motion.control_hz
        turn = (yaw - self._yaw).clamp(-most, most)
        self._yaw = self._yaw + turn
        return turn


def stopping_speed(distance: Tensor, deceleration: float, dt: float) -> Tensor:
    """Return the largest speed (N,) m/s of this control step from which the tool stops at `distance` (N,) m.

    In control steps of `dt` s the continuous v = sqrt(2 a d) overshoots: the first step is played before any braking.
    With v = a dt (n + r), 0 <= r < 1, this step and the n braking ones after it cover
    d = a dt^2 (n + 1) (n / 2 + r); solved for v that is v = a dt (d / (a dt^2) / (n + 1) + n / 2).
    """
    units = distance / (deceleration * dt * dt)
    braking = torch.floor((torch.sqrt(1 + 8 * units) - 1) / 2)
    return (units / (braking + 1) + braking / 2) * (deceleration * dt)


def smallest_turn(angle: Tensor, period: float) -> Tensor:
    """Return the turn (N,) rad in [-period / 2, period / 2) that differs from `angle` (N,) by whole periods."""
    return torch.remainder(angle + period / 2, period) - period / 2


def over(point: Tensor, height: float) -> Tensor:
    """Return the positions (N, 3), m, at `height` m above (or below) `point` (N, 2 or more: x, y, ...)."""
    return torch.cat([point[:, :2], torch.full_like(point[:, :1], height)], dim=1)


Waypoint = tuple[Tensor, Tensor | float, Tensor | float, float, int]
"""A line of a plan: position (N, 3), yaw (N,), opening (N,), speed, dwell; units and frames as in `Waypoints`.

Yaw and opening may be plain numbers.
"""


def waypoint_table(rows: Sequence[Waypoint], like: Tensor) -> Waypoints:
    """Build `Waypoints` from one entry a way-point; `like` (N, ...) gives the device and N."""
    n = len(like)

    def column(value: Tensor | float) -> Tensor:
        return torch.as_tensor(value, dtype=torch.float64, device=like.device).expand(n)

    return Waypoints(
        position=torch.stack([position.double() for position, *_ in rows], dim=1),
        yaw=torch.stack([column(yaw) for _, yaw, *_ in rows], dim=1),
        opening=torch.stack([column(opening) for _, _, opening, _, _ in rows], dim=1),
        speed=torch.tensor([speed for *_, speed, _ in rows], dtype=torch.float64, device=like.device),
        dwell=torch.tensor([dwell for *_, dwell in rows], device=like.device),
    )


class WaypointExpert(ABC):
    """An `Expert` that plans all way-points at the start of an episode; a task's own gives them in `plan`.

    A class sets `name`, `motion` and, where it has more than one, `styles`.

    Args:
        spec: the environment's spec.
        num_envs: N.
        device: where states and actions live.
        style: one of `styles`, the first of them for None.

    Raises UnknownNameError for a style that is not there.
    """

    name: str
    styles: tuple[str, ...] = ("direct",)
    motion: Motion

    def __init__(self, spec: EnvSpec, num_envs: int, device: torch.device | str, style: str | None = None) -> None:
        self.style = require_style(style, self.styles)
        self._layout = spec.state_layout
        motion = replace(self.motion, control_hz=spec.action.control_hz)
        self._follower = WaypointFollower(spec, num_envs, motion, device)

    @abstractmethod
    def plan(self, scene: Mapping[str, Tensor], seeds: Sequence[int]) -> Sequence[Waypoint]:
        """Return the way-points of the N rows' episodes.

        Args:
            scene: parts of the first privileged state by their names in the spec's layout, (N, width) float64 each.
            seeds: N seeds.
        """

    def reset(self, state: Tensor, seeds: Sequence[int], mask: Tensor) -> None:
        """Plan the episodes of the rows in `mask` (N,) from their first state (N, S) and seeds (N)."""
        scene = {name: state[:, start:stop].double() for name, (start, stop) in self._layout.items()}
        self._follower.reset(waypoint_table(self.plan(scene, seeds), state), mask)

    def act(self, state: Tensor) -> Tensor:
        """Return the next action (N, 7) in [-1, 1] for the state (N, S)."""
        return self._follower.act(state)
