"""In which precision to train, and with how many processes: `auto` becomes what the machine does well."""

from __future__ import annotations

import logging
from typing import Any

import torch
from lightning_fabric import Fabric
from lightning_fabric.plugins.precision import MixedPrecision, Precision

from manicm_ms.errors import ConfigError

PRECISIONS = ("auto", "32-true", "bf16-mixed", "16-mixed")
"""32-true: all in float32. bf16-mixed, 16-mixed: products in 16 bits, weights and averages in float32."""


def resolve_precision(asked: str, device: torch.device) -> str:
    """Return the precision that `asked` (one of `PRECISIONS`) means on `device`.

    auto is bf16-mixed where the hardware multiplies bfloat16 (on a CPU: AVX512_BF16 or AMX, where it halves
    the time of a step) and 32-true elsewhere: emulated bfloat16 is slower than float32.
    """
    if asked not in PRECISIONS:
        raise ConfigError(f"unknown precision {asked!r}: known: {', '.join(PRECISIONS)}")
    if asked == "16-mixed" and device.type == "cpu":
        raise ConfigError("precision 16-mixed needs a CUDA device: use bf16-mixed or 32-true on a CPU")
    if asked != "auto":
        return asked
    if device.type == "cuda":
        native = torch.cuda.is_bf16_supported(including_emulation=False)
    else:
        capabilities = torch.cpu.get_capabilities()
        native = capabilities.get("avx512_bf16", False) or capabilities.get("amx_bf16", False)
    return "bf16-mixed" if native else "32-true"


class ProductsIn16Bits(MixedPrecision):
    """Mixed precision that leaves what goes into the networks as it is.

    Fabric's own also rounds every batch to 16 bits before the forward pass: to 3 digits in bfloat16, which is 1 to 2 mm
    of a point half a metre away. A policy that learnt from such clouds, poses and actions acts on others.
    """

    def convert_input(self, data: Any) -> Any:
        """Return the batch untouched: autocast rounds the factors of each product, nothing else."""
        return data


def _precision_plugin(precision: str, device: torch.device) -> Precision:
    if precision == "32-true":
        return Precision()
    return ProductsIn16Bits(precision, device.type)  # type: ignore[arg-type]


def make_fabric(device: torch.device, precision: str, num_devices: int = 1) -> Fabric:
    """Return a launched Fabric; with more than one device this starts one process for each (DDP).

    Call it before anything is written: the other processes run the same command from its beginning.
    """
    # Fabric announces the precision on standard error; the checkpoint records it.
    logging.getLogger("lightning_fabric").setLevel(logging.WARNING)
    devices = [device.index] if device.type == "cuda" and num_devices == 1 else num_devices
    strategy = "auto" if num_devices == 1 else "ddp"
    plugin = _precision_plugin(precision, device)
    fabric = Fabric(accelerator=device.type, devices=devices, strategy=strategy, plugins=plugin)
    fabric.launch()
    return fabric
