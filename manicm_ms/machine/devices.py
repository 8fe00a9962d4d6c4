"""Where torch computes: devices by name, and its threads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from manicm_ms.errors import ConfigError


def resolve_device(asked: str) -> torch.device:
    """Return the device that `asked` ("auto", "cpu", "cuda", "cuda:1") names; auto prefers CUDA.

    Raises ConfigError where the machine has no such device.
    """
    if asked == "auto":
        return torch.device("cuda", 0) if torch.cuda.is_available() else torch.device("cpu")
    try:
        device = torch.device(asked)
    except RuntimeError:
        raise ConfigError(f"unknown device {asked!r}: use auto, cpu, cuda or cuda:N") from None
    if device.type not in ("cpu", "cuda"):
        raise ConfigError(f"device {asked!r} is not supported: use auto, cpu, cuda or cuda:N")
    if device.type == "cuda":
        device = torch.device("cuda", device.index or 0)
        if not torch.cuda.is_available() or device.index >= torch.cuda.device_count():
            raise ConfigError(f"device {asked!r}: {torch.cuda.device_count()} CUDA devices found; use --device cpu")
    return device


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Set torch's intra-op threads to `count` within the block and restore the former number after it."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
