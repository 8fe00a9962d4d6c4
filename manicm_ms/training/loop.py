"""The one training loop: batches, optimizer steps, log, and a state that survives any kill. Objectives plug in."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import torch
from lightning_fabric import Fabric
from rich.console import Console
from torch import Tensor, nn

from manicm_ms.errors import CheckpointError, TrainingDivergedError
from manicm_ms.machine.devices import torch_threads
from manicm_ms.paths import require_free_space
from manicm_ms.policies.migration import present_tensors
from manicm_ms.training.interrupt import stop_requests
from manicm_ms.training.log import LossBar, RunLog, loss_bar
from manicm_ms.training.malloc import keep_freed_memory
from manicm_ms.training.optim import FitConfig, build_optimizer, build_scheduler
from manicm_ms.training.run_folder import RunFolder, pack_optimizer, unpack_optimizer
from manicm_ms.training.stream import IndexStream, step_generator


class Batches(Protocol):
    """What is learned from: a number of samples that can be taken by index."""

    def __len__(self) -> int:
        """Return the number of samples."""

    def batch(self, indices: Tensor) -> dict[str, Tensor]:
        """Return the samples with these (B,) int64 indices, on the device of training."""


class Objective(nn.Module, ABC):
    """What is minimised: holds the networks, draws the noise, returns the loss.

    Parameters that ask for a gradient are trained; averages (EMA, target network) and frozen networks do not ask.
    All noise comes from the generator that `forward` is given, so that (seed, step) decides it.
    """

    constant: ClassVar[tuple[str, ...]] = ()
    """Prefixes of `state_dict` names that training never changes; they are not saved with the training state."""

    def train(self, mode: bool = True) -> Objective:
        """Switch what is trained to training (dropout, statistics of batches) or evaluation; the rest to evaluation.

        A frozen teacher, an average and a target network give what they give when they act.
        """
        super().train(mode)
        for module in self.modules():
            parameters = list(module.parameters())
            if parameters and not any(p.requires_grad for p in parameters):
                module.eval()
        return self

    @abstractmethod
    def forward(self, batch: Mapping[str, Tensor], generator: torch.Generator) -> Tensor:
        """Return the loss of a batch, a scalar."""

    @abstractmethod
    def after_step(self) -> None:
        """Update the averages; called after every optimizer step."""


@dataclass(frozen=True)
class FitResult:
    """What a finished training says of itself.

    Attributes:
        steps: optimizer steps done in all.
        loss: mean over the last logged steps.
        seconds: wall time of the steps, over all processes that took part.
        resumed_from: steps that an earlier process had done.
    """

    steps: int
    loss: float
    seconds: float
    resumed_from: int


class Snapshots(NamedTuple):
    """Where a training stops for a moment to be looked at.

    Attributes:
        steps: numbers of optimizer steps after which `take` is called.
        take: called with that number; on one process, the first.
    """

    steps: frozenset[int] = frozenset()
    take: Callable[[int], None] = lambda step: None


class _Training:
    """All that changes from step to step, and how to write it down."""

    def __init__(self, objective: Objective, config: FitConfig, steps: int, fabric: Fabric) -> None:
        self.objective, self.fabric, self.config = objective, fabric, config
        trained = [p for p in objective.parameters() if p.requires_grad]
        self.optimizer = build_optimizer(trained, config, fused=fabric.strategy.precision.precision != "16-mixed")
        self.scheduler = build_scheduler(self.optimizer, config, steps)
        self.module, self.wrapped_optimizer = fabric.setup(objective, self.optimizer)
        self.step = 0
        self.seconds = 0.0
        self.loss = math.nan  # mean of the last logged interval
        self.loss_sum = torch.zeros((), device=fabric.device)  # since the last log line
        self.loss_count = 0

    def advance(self, batch: Mapping[str, Tensor], generator: torch.Generator) -> None:
        """Take one optimizer step."""
        loss = self.module(batch, generator)
        self.fabric.backward(loss)
        if self.config.clip_norm is not None:
            self.fabric.clip_gradients(
                self.module, self.wrapped_optimizer, max_norm=self.config.clip_norm, error_if_nonfinite=False
            )
        self.wrapped_optimizer.step()
        self.wrapped_optimizer.zero_grad()
        self.scheduler.step()
        self.objective.after_step()
        self.loss_sum += loss.detach()
        self.loss_count += 1
        self.step += 1

    def check_finite(self) -> None:
        """Raise TrainingDivergedError where a loss since the last check was NaN or infinite."""
        if not torch.isfinite(self.loss_sum):
            raise TrainingDivergedError(
                f"the loss became NaN or infinite within the last {self.loss_count} steps before step {self.step}: "
                "lower the learning rate, or train with --precision 32-true; use another --out for it"
            )

    def log_line(self) -> dict[str, float]:
        """Return the numbers of the steps since the last log line and begin to count anew."""
        self.check_finite()
        self.loss = float(self.loss_sum) / self.loss_count
        self.loss_sum.zero_()
        self.loss_count = 0
        return {"loss": self.loss, "learning_rate": float(self.scheduler.get_last_lr()[0]), "seconds": self.seconds}

    def save(self, run: RunFolder) -> None:
        """Write the training state; never one with a loss that is not finite."""
        self.check_finite()
        if not self.fabric.is_global_zero:
            return
        optimizer, groups = pack_optimizer(self.optimizer)
        tensors = {f"objective.{k}": v for k, v in self._changing().items()}
        tensors |= {f"optimizer.{k}": v for k, v in optimizer.items()}
        tensors["loss_sum"] = self.loss_sum
        run.save_state(
            tensors,
            {
                "step": self.step,
                "seconds": self.seconds,
                "loss": None if math.isnan(self.loss) else self.loss,
                "loss_count": self.loss_count,
                "param_groups": groups,
                "scheduler": self.scheduler.state_dict(),
                "precision": self.fabric.strategy.precision.state_dict(),  # the gradient scaler of float16
            },
        )

    def restore(self, run: RunFolder) -> None:
        """Continue from the state that `save` wrote, if there is one."""
        saved = run.load_state()
        if saved is None:
            return
        tensors, meta = saved
        changing = _under("objective.", tensors)
        if not changing.keys() <= self.objective.state_dict().keys():  # begun by the former release?
            changing = present_tensors(changing)
        missing, unexpected = self.objective.load_state_dict(changing, strict=False)
        unsaved = [k for k in missing if not k.startswith(self.objective.constant)]
        if unsaved or unexpected:
            raise CheckpointError(
                f"the training state in {run.folder} is of another version of the package (first difference: "
                f"{(unsaved + unexpected)[0]}): delete that folder to train from the beginning"
            )
        unpack_optimizer(self.optimizer, _under("optimizer.", tensors), meta["param_groups"])
        self.scheduler.load_state_dict(meta["scheduler"])
        self.fabric.strategy.precision.load_state_dict(meta["precision"])
        self.loss_sum.copy_(tensors["loss_sum"])
        self.step, self.seconds, self.loss_count = meta["step"], meta["seconds"], meta["loss_count"]
        self.loss = math.nan if meta["loss"] is None else meta["loss"]

    def require_space(self, run: RunFolder) -> None:
        """Raise NoSpaceError unless two training states (old and new) and a checkpoint fit on the disk."""
        held = sum(v.nbytes for v in self._changing().values())
        moments = 2 * sum(p.nbytes for p in self.objective.parameters() if p.requires_grad)
        require_free_space(run.folder, 2 * (held + moments) + held)

    def _changing(self) -> dict[str, Tensor]:
        constant = self.objective.constant
        return {k: v for k, v in self.objective.state_dict().items() if not k.startswith(constant)}


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def fit(
    objective: Objective,
    data: Batches,
    config: FitConfig,
    run: RunFolder,
    fabric: Fabric,
    *,
    seed: int,
    console: Console | None = None,
    title: str = "training",
    snapshots: Snapshots = Snapshots(),  # noqa: B008 (it cannot change)
) -> FitResult:
    """Train `objective` on `data`, or go on where the run's saved state stands, until all steps are done.

    The weights after the last step depend on the arguments alone: on a CPU they are bit-equal whether or not
    the process was killed on the way. Ctrl-C and SIGTERM finish the step, save, and raise KeyboardInterrupt.

    Args:
        objective: trained in place; constructed the same way when a run goes on.
        data: samples on `fabric.device`.
        config: optimizer, steps, and how often to log and save.
        run: where state and log go.
        fabric: device, precision and processes, launched.
        seed: decides order and noise.
        console: shows a progress bar; None shows nothing.
        title: of the progress bar.
        snapshots: what is done at which steps beside training; it must not change the objective.

    Raises:
        CheckpointError: the saved state is damaged, or of another version of the package.
        TrainingDivergedError: the loss became NaN or infinite; the last saved state is a finite one.
        NoSpaceError: the disk is too small, or full.
    """
    if fabric.device.type == "cpu":
        keep_freed_memory()
    with torch_threads(config.threads):
        return _fit(objective, data, config, run, fabric, seed, console, title, snapshots)


def _fit(
    objective: Objective,
    data: Batches,
    config: FitConfig,
    run: RunFolder,
    fabric: Fabric,
    seed: int,
    console: Console | None,
    title: str,
    snapshots: Snapshots,
) -> FitResult:
    steps = config.total_steps(len(data))
    training = _Training(objective, config, steps, fabric)
    training.restore(run)
    resumed_from = training.step
    training.require_space(run)
    objective.train()
    if fabric.is_global_zero:
        with RunLog(run.log_path, training.step) as log, loss_bar(console, title, steps) as bar:
            _run_steps(training, data, steps, run, seed, log, bar, snapshots)
    else:
        _run_steps(training, data, steps, run, seed, None, None, Snapshots())
    return FitResult(training.step, training.loss, training.seconds, resumed_from)


def _run_steps(
    training: _Training,
    data: Batches,
    steps: int,
    run: RunFolder,
    seed: int,
    log: RunLog | None,
    bar: LossBar | None,
    snapshots: Snapshots,
) -> None:
    fabric, config = training.fabric, training.config
    stream = IndexStream(len(data), config.batch_size, seed)
    with stop_requests() as stop:
        while training.step < steps:
            begin = time.perf_counter()
            indices = stream.batch(training.step, fabric.global_rank, fabric.world_size)
            generator = step_generator(seed, training.step, fabric.global_rank, fabric.device)
            training.advance(data.batch(indices), generator)
            training.seconds += time.perf_counter() - begin
            last = training.step == steps
            logged = last or training.step % config.log_every == 0
            numbers: dict[str, Any] = training.log_line() if logged else {}
            if logged and log is not None:
                log.write(training.step, **numbers)
            if bar is not None:
                bar.update(training.step, numbers.get("loss"))
            if training.step in snapshots.steps:
                training.check_finite()
                snapshots.take(training.step)  # before the state: a run that goes on from here has this one behind it
            if last or stop.asked or training.step % config.save_every == 0:
                training.save(run)
            if stop.asked and not last:
                raise KeyboardInterrupt
