"""Keeps numbers that are no numbers away from actions: bad points are left out, what cannot be mended is refused."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping

import torch
from torch import Tensor

from manicm_ms.errors import NotFiniteError
from manicm_ms.spec import AGENT_POS, POINT_CLOUD, EnvSpec

_MOST_NAMED = 3  # entries of agent_pos, and rows, that a message lists


def finite_obs(obs: Mapping[str, Tensor], spec: EnvSpec) -> Mapping[str, Tensor]:
    """Return the observations with finite numbers only.

    Depth cameras write NaN or infinity where they saw nothing, so such points are left out: the others keep their
    order and fill the cloud again from the beginning, which an encoder that pools by maximum does not see (decision
    0006). A state that holds such a number has no substitute.

    Args:
        obs: what a policy reads, each key as (B, To, ...).
        spec: the environment that they are of.

    Returns:
        `obs` itself where all is finite, which costs a sum for each key and one wait for an accelerator; while a CUDA
        graph is recorded nothing is looked at.

    Raises:
        NotFiniteError: a cloud's frame has no finite point, or another key holds NaN or infinity; it names the rows.
    """
    values = {key: value for key, value in obs.items() if value.is_floating_point()}  # whole numbers are finite
    if not values or _recorded(next(iter(values.values()))) or _finite_sum(*values.values()):
        return obs
    found = dict(obs)
    for key, value in values.items():
        if key == POINT_CLOUD:
            found[key] = _without_bad_points(value)
        else:
            _require_finite(key, value, spec)
    return found


def require_finite_actions(actions: Tensor, name: str) -> None:
    """Raise NotFiniteError, naming the rows, where actions (B, ...) of the policy `name` hold NaN or infinity."""
    if _recorded(actions) or _finite_sum(actions):
        return
    if rows := _rows(~torch.isfinite(actions)):
        raise NotFiniteError(
            f"{name} came to an action of NaN or infinity in {_shown('row', rows)}: its weights, or values of the "
            "observation far outside those of its training, are to blame; look at agent_pos and its units",
            rows,
        )


def _recorded(tensor: Tensor) -> bool:
    return tensor.is_cuda and torch.cuda.is_current_stream_capturing()


def _finite_sum(values: Tensor, *others: Tensor) -> bool:
    """Return whether the sum is finite: False wherever one value is not, or where many large ones overflow it."""
    total = values.sum()
    for more in others:
        total = total + more.sum()
    return math.isfinite(total.item())


def _require_finite(key: str, value: Tensor, spec: EnvSpec) -> None:
    bad = ~torch.isfinite(value)  # (B, To, ...)
    if not bad.any():
        return
    where, remedy = "", "look at what makes it"
    if key == AGENT_POS:
        names = [spec.agent_pos_names[i] for i in bad.flatten(0, 1).any(0).nonzero().flatten().tolist()]
        where, remedy = f" ({_listed(names)})", "read the robot's state again, or stop"
    rows = _rows(bad)
    raise NotFiniteError(
        f"{key} holds {int(bad.sum())} values of NaN or infinity in {_shown('row', rows)}{where}: "
        f"no action can be chosen from it; {remedy}",
        rows,
    )


def _without_bad_points(cloud: Tensor) -> Tensor:
    good = torch.isfinite(cloud).all(-1)  # (B, To, P)
    count = good.sum(-1, keepdim=True)  # (B, To, 1)
    if rows := _rows(count == 0):
        raise NotFiniteError(
            f"point_cloud holds no finite point in a frame of {_shown('row', rows)}: "
            "the camera sees nothing of the workspace; check its depth and its pose",
            rows,
        )
    if not good.all():
        # The text never changes, so that Python shows it once and not at each decision.
        warnings.warn(
            "points of NaN or infinity are left out of point_cloud: depth without a value?",
            RuntimeWarning,
            stacklevel=4,
        )
    order = (~good).int().argsort(dim=-1, stable=True)  # good points first, in their order
    places = torch.arange(cloud.shape[2], device=cloud.device) % count
    return cloud.gather(2, order.gather(2, places)[..., None].expand_as(cloud))


def _rows(bad: Tensor) -> tuple[int, ...]:
    """Return the rows of bad (B, ...) bool that hold a True."""
    return tuple(bad.flatten(1).any(1).nonzero().flatten().tolist())


def _shown(word: str, numbers: tuple[int, ...]) -> str:
    return f"{word}{'s' if len(numbers) > 1 else ''} {_listed([str(n) for n in numbers])}"


def _listed(names: list[str]) -> str:
    more = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return ", ".join(names[:_MOST_NAMED]) + more
