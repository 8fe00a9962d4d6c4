"""Device names: what they mean here, and what is refused."""

import pytest
import torch

from manicm_ms.errors import ConfigError
from manicm_ms.machine.devices import resolve_device


def test_devices():
    assert resolve_device("cpu") == torch.device("cpu")
    assert resolve_device("auto").type == ("cuda" if torch.cuda.is_available() else "cpu")
    for asked in ("gpu0", "meta", f"cuda:{torch.cuda.device_count()}"):
        with pytest.raises(ConfigError, match="device"):
            resolve_device(asked)
