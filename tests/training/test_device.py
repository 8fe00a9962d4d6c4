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


class Sees(torch.nn.Module):
    """Remembers what its forward pass was given."""

    def __init__(self):
        super().__init__()
        self.linear = torch.nn.Linear(2, 2)

    def forward(self, batch, generator):
        self.seen = batch
        self.product = self.linear(batch["agent_pos"])
        return self.product.float().sum()


@pytest.mark.parametrize("precision", ["bf16-mixed", "32-true"])
def test_a_batch_reaches_the_network_unrounded(precision):
    """Rounded to bfloat16 a pose of 0.99951 is 1, and one of 0.3004 m is 0.3008 m."""
    batch = {"agent_pos": torch.tensor([[0.99951, 0.3004]]), "index": torch.tensor([3])}
    fabric = make_fabric(CPU, precision)
    module = fabric.setup_module(Sees())
    loss = module(batch, None)
    seen = module.module.seen
    assert torch.equal(seen["agent_pos"], batch["agent_pos"])
    assert seen["agent_pos"].dtype == torch.float32
    assert torch.equal(seen["index"], batch["index"])
    assert module.module.product.dtype == (torch.bfloat16 if precision == "bf16-mixed" else torch.float32)
    assert loss.dtype == torch.float32
