"""Device and precision names: what they mean here, and what is refused."""

import pytest
import torch

from manicm_ms.errors import ConfigError
from manicm_ms.training.device import make_fabric, resolve_precision

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("capabilities", "expected"),
    [({"avx512_bf16": True}, "bf16-mixed"), ({"amx_bf16": True}, "bf16-mixed"), ({"avx2": True}, "32-true")],
)
def test_auto_uses_bfloat16_only_where_the_cpu_multiplies_it(capabilities, expected, monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities)
    assert resolve_precision("auto", CPU) == expected


def test_named_precisions_stand():
    assert resolve_precision("32-true", CPU) == "32-true"
    assert resolve_precision("16-mixed", torch.device("cuda", 0)) == "16-mixed"


@pytest.mark.parametrize(("asked", "match"), [("fp8", "known: auto, 32-true"), ("16-mixed", "CUDA")])
def test_bad_precisions_are_refused(asked, match):
    with pytest.raises(ConfigError, match=match):
        resolve_precision(asked, CPU)


def test_mixed_precision_multiplies_in_16_bits_and_keeps_weights_in_32():
    fabric = make_fabric(CPU, "bf16-mixed")
    linear = torch.nn.Linear(4, 4)
    with fabric.autocast():
        assert linear(torch.zeros(1, 4)).dtype == torch.bfloat16
    assert fabric.setup_module(linear).weight.dtype == torch.float32
