"""Seeds that a user gives."""

from __future__ import annotations

from manicm_ms.errors import ConfigError


def require_seed(seed: int) -> None:
    """Raise ConfigError where `seed` is negative: numpy and the simulators take none."""
    if seed < 0:
        raise ConfigError(f"seed must not be negative, got {seed}")
