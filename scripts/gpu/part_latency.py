"""Part 1 of the GPU kit: one decision of DP3 and Simple DP3, teacher and student, and the memory's bandwidth.

Random weights at the shapes of Adroit door. Each row of the table runs from an observation in the CPU's memory to the
action in the CPU's memory, device synchronised, after a warm-up, and is compared with the CPU's float32 action from the
same observation and noise.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from kit import Budget, Results, part_arguments, results_of
from torch import Tensor, nn

from manicm_ms.bench.latency import CHUNK, TEACHERS, door_spec
from manicm_ms.evaluation.machine import machine
from manicm_ms.machine.devices import resolve_device
from manicm_ms.policies.action_policy import ActionPolicy
from manicm_ms.policies.backbones.unet1d import UNet1D
from manicm_ms.policies.encoders.encoder import Features
from manicm_ms.policies.methods import make_policy, student_of
from manicm_ms.policies.policy import Policy, example_observations

PART = "latency"
WARM_UP, FEWEST, MOST, ROW_S = 3, 5, 200, 1.0  # calls before the clock; timed calls at least, at most; seconds a row
BATCHES, NFES = (1, 32), (1, 10, 4)  # in order of value
SMOKE_BATCHES, SMOKE_CALLS = (1, 2), 1
COPY_BYTES, COPIES = 1 << 30, 10
TINY = {"backbone": {"down_dims": (16, 32)}}


@dataclass(frozen=True)
class Row:
    """A line of the table.

    Attributes:
        model: name in `TEACHERS`.
        nfe: network evaluations of a decision; 10 is the teacher, fewer the student.
        dtype: of weights and products: "float32" or "bfloat16".
        batch: rows decided at once.
        mode: "eager", or "graph" for a recorded CUDA graph.
    """

    model: str
    nfe: int
    dtype: str
    batch: int
    mode: str


def rows(mode: str, smoke: bool) -> Iterator[Row]:
    """Yield the lines of one mode, the most telling first."""
    for batch in SMOKE_BATCHES if smoke else BATCHES:
        for nfe in NFES:
            for model in TEACHERS:
                for dtype in ("float32", "bfloat16"):
                    yield Row(model, nfe, dtype, batch, mode)


# ---- policies -----------------------------------------------------------------------------------------------------


def in_bfloat16(policy: ActionPolicy) -> ActionPolicy:
    """Return a copy whose encoder and U-Net hold and multiply bfloat16; noise, sampler and normalizer stay float32."""
    half = copy.deepcopy(policy)
    unet = half.head.backbone
    assert isinstance(unet, UNet1D)

    def cast(value: Any) -> Any:
        if isinstance(value, Features):
            return Features(value.cond.to(torch.bfloat16))
        if isinstance(value, dict):
            return {key: cast(v) for key, v in value.items()}
        return value.to(torch.bfloat16) if isinstance(value, Tensor) and value.is_floating_point() else value

    for part in (half.encoder, unet):
        part.to(torch.bfloat16).register_forward_pre_hook(lambda _m, inputs: tuple(cast(x) for x in inputs))
    # The embedding of the time is computed in float32 from an integer.
    for embedding in unet.time_embeddings:
        embedding[0].register_forward_hook(lambda _m, _i, output: output.to(torch.bfloat16))  # type: ignore[index]
    return half


Policies = dict[tuple[str, str, int], Policy]


def policies(device: torch.device, smoke: bool) -> Policies:
    """Return (model, dtype, nfe) -> policy on `device`; under the dtype "reference", float32 on the CPU."""
    made: Policies = {}
    for model, registered in TEACHERS.items():
        teacher = make_policy(registered, door_spec(), CHUNK, TINY if smoke else None, seed=0).eval()
        for dtype, copied in (
            ("reference", teacher),
            ("float32", copy.deepcopy(teacher).to(device)),
            ("bfloat16", in_bfloat16(teacher).to(device)),
        ):
            student = student_of(copied).eval()
            for nfe in NFES:
                made[model, dtype, nfe] = copied if nfe == copied.nfe else student.with_nfe(nfe).eval()
    return made


# ---- one decision -------------------------------------------------------------------------------------------------


def starting_point(policy: Policy, batch: int) -> tuple[dict[str, Tensor], Tensor]:
    """Return an observation of `batch` equal rows and noise (draws, batch, Tp, Da), equal in all rows, on the CPU."""
    one = example_observations(policy)
    shape = (policy.noise_draws, 1, policy.chunk.horizon, policy.spec.action.dim)
    noise = torch.randn(shape, generator=torch.Generator().manual_seed(1))
    return {key: value.repeat(batch, *[1] * (value.dim() - 1)) for key, value in one.items()}, noise.repeat(
        1, batch, 1, 1
    )


class Eager:
    """A decision as a user's program takes it.

    Args:
        policy: on its device.
        obs: on the CPU, as `Policy.act` wants it.
    """

    def __init__(self, policy: Policy, obs: Mapping[str, Tensor]) -> None:
        self.policy, self.obs = policy, obs
        self.generator = torch.Generator(policy.device).manual_seed(0)

    def __call__(self) -> Tensor:
        """Return the action on the CPU, with noise of its own."""
        return self._act(generator=self.generator)

    def from_noise(self, noise: Tensor) -> Tensor:
        """Return the action for this noise."""
        return self._act(noise=noise)

    def _act(self, **chance: Any) -> Tensor:
        return self.policy.act({k: v.to(self.policy.device) for k, v in self.obs.items()}, **chance).cpu()


class Recorded(Eager):
    """The same decision from buffers that stay where they are, its kernels recorded once and replayed together.

    Policies leave out their checks for NaN while a graph is recorded: a check waits for the device.
    """

    def __init__(self, policy: Policy, obs: Mapping[str, Tensor]) -> None:
        super().__init__(policy, obs)
        self.inputs = {key: value.to(policy.device, copy=True) for key, value in obs.items()}
        batch = len(next(iter(obs.values())))
        shape = (policy.noise_draws, batch, policy.chunk.horizon, policy.spec.action.dim)
        self.noise = torch.randn(shape, device=policy.device)
        self.replay = record(lambda: policy.act(self.inputs, noise=self.noise), policy.device)

    def __call__(self) -> Tensor:
        """Return the action on the CPU, with noise of its own."""
        self.noise.normal_(generator=self.generator)
        return self._replay()

    def from_noise(self, noise: Tensor) -> Tensor:
        """Return the action for this noise."""
        self.noise.copy_(noise)
        return self._replay()

    def _replay(self) -> Tensor:
        for key, value in self.obs.items():
            self.inputs[key].copy_(value)
        return self.replay().cpu()


def record(work: Callable[[], Tensor], device: torch.device) -> Callable[[], Tensor]:
    """Return what does `work` again on the same buffers: a CUDA graph; `work` itself where there are none."""
    if device.type != "cuda":
        return work
    aside = torch.cuda.Stream()
    aside.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(aside):  # libraries choose their kernels before the recording
        for _ in range(WARM_UP):
            work()
    torch.cuda.current_stream().wait_stream(aside)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        outcome = work()

    def replay() -> Tensor:
        graph.replay()
        return outcome

    return replay


MODES: dict[str, type[Eager]] = {"eager": Eager, "graph": Recorded}


# ---- measuring ----------------------------------------------------------------------------------------------------


def synchronize(device: torch.device) -> None:
    """Wait for the device's work: the host's clock would stop before it."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def times_ms(work: Callable[[], Any], device: torch.device, most: int, seconds: float) -> list[float]:
    """Return the wall time of each of up to `most` calls within about `seconds`, after a warm-up."""
    for _ in range(min(WARM_UP, most)):
        work()
    found: list[float] = []
    end = time.perf_counter() + seconds
    while len(found) < most and (len(found) < FEWEST or time.perf_counter() < end):
        synchronize(device)
        begin = time.perf_counter_ns()
        work()
        synchronize(device)
        found.append((time.perf_counter_ns() - begin) / 1e6)
    return found


def bandwidth_gb_s(device: torch.device, size: int) -> float:
    """Return the memory's bandwidth, GB/s of bytes read plus bytes written, from copies of `size` bytes."""
    source = torch.rand(size // 4, device=device)
    target = torch.empty_like(source)
    return 2 * size / float(np.median(times_ms(lambda: target.copy_(source), device, COPIES, 5.0))) / 1e6


def weight_bytes(policy: Policy) -> int:
    """Return the fewest bytes of weights that a decision reads: the encoder once, the U-Net at each evaluation."""
    assert isinstance(policy, ActionPolicy)
    assert policy.head.backbone is not None

    def held(module: nn.Module) -> int:
        return sum(p.numel() * p.element_size() for p in module.parameters())

    return held(policy.encoder) + policy.nfe * held(policy.head.backbone)


def measure(row: Row, made: Policies, bandwidth: float, most: int) -> dict[str, Any]:
    """Return the numbers of one line."""
    policy, reference = made[row.model, row.dtype, row.nfe], made[row.model, "reference", row.nfe]
    obs, noise = starting_point(policy, row.batch)
    wanted = Eager(reference, {key: value[:1] for key, value in obs.items()}).from_noise(noise[:, :1])
    decision = MODES[row.mode](policy, obs)
    error = float((decision.from_noise(noise) - wanted).abs().max())
    found = times_ms(decision, policy.device, most, ROW_S)
    median = float(np.median(found))
    return {
        "median_ms": round(median, 4),
        "p95_ms": round(float(np.percentile(found, 95)), 4),
        "n": len(found),
        "decisions_per_s": round(row.batch * 1e3 / median, 1),
        "weights_mb": round(weight_bytes(policy) / 1e6, 2),
        "floor_ms": round(weight_bytes(policy) / bandwidth / 1e6, 4),
        "error": error,
    }


def main() -> None:
    """Measure one mode, a line at a time, until all are done or the time is used up."""
    parser = part_arguments(argparse.ArgumentParser(description=__doc__.splitlines()[0]))
    parser.add_argument("--mode", choices=tuple(MODES), required=True)
    parser.add_argument("--device", default="auto", help="cpu or cuda; auto takes CUDA where there is one")
    args = parser.parse_args()
    results, budget, device = results_of(args.out), Budget(args.budget), resolve_device(args.device)
    torch.set_num_threads(1 if args.smoke else torch.get_num_threads())
    bandwidth = bandwidth_gb_s(device, COPY_BYTES >> 8 if args.smoke else COPY_BYTES)
    results.write(
        PART, mode=args.mode, device=device.type, torch=torch.__version__, machine=machine(),
        bandwidth_gb_s=round(bandwidth, 1), tf32_convolutions=torch.backends.cudnn.allow_tf32,
    )  # fmt: skip
    with torch.inference_mode():
        measure_all(args.mode, policies(device, args.smoke), bandwidth, results, budget, args.smoke)


def measure_all(mode: str, made: Policies, bandwidth: float, results: Results, budget: Budget, smoke: bool) -> None:
    """Write a line for each row, or why it has none."""
    left_out = 0
    for row in rows(mode, smoke):
        if budget.left_s < 3 * ROW_S:
            left_out += 1
            continue
        try:
            measured = measure(row, made, bandwidth, SMOKE_CALLS if smoke else MOST)
            results.write(PART, **asdict(row), **measured)
        except RuntimeError as error:
            results.write(PART, **asdict(row), failed=str(error).splitlines()[0])
    if left_out:
        results.write(PART, mode=mode, left_out=f"{left_out} rows: the time was used up")


if __name__ == "__main__":
    main()
