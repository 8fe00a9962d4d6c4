"""Part 4 of the GPU kit: four families of methods at one size, one batch and one number of steps, on one task.

Simple DP3 and its student, MeanFlow, drifting and voxel grids. First the speed of each is measured, then all are
planned for as many steps as fit, the same for each, learning rate included. On a GPU small networks leave most of it
idle: whether trainings at once, in a process each, are faster than one after another is measured, and the faster way
taken.
"""

from __future__ import annotations

import argparse
import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, wait
from pathlib import Path
from typing import Any

from kit import Budget, Results, last_error, part_arguments, results_of
from part_training import (
    CAUTION,
    OVERHEAD_S,
    SMOKE_STEPS,
    Trained,
    Training,
    archive_name,
    of_demonstrations,
    of_teacher,
    pack,
    size_of,
    steps_per_second,
    train_steps,
    unpacked_store,
)

from manicm_ms.machine.devices import resolve_device
from manicm_ms.policies.methods import METHODS
from manicm_ms.training.optim import FitConfig
from manicm_ms.training.presets import preset_for

PART = "families"
TASK = "adroit/hammer"
TEACHER, STUDENT, VOXELS = "simple_dp3", "manicm", "voxel_dp"
FAMILIES = (TEACHER, STUDENT, "meanflow", "drift", VOXELS)
COME_BACK = (TEACHER, STUDENT, "meanflow", "drift")  # of the others only the numbers
SIMPLE_UNET = {"backbone": METHODS.get(TEACHER).backbone}
CHANGES = {VOXELS: SIMPLE_UNET}  # its published U-Net is DP3's large one
TIMED_STEPS = (20, 100)
FEWEST_STEPS = 100
TRIAL = 0.25  # share of what is left that trying trainings at once may take
Submit = Callable[..., "Future[Any]"]
"""(method, function, its arguments) -> its future."""


# ---- what is done for a method: functions that another process can be told to run -----------------------------------


def training_of(method: str, teacher: Path | None, args: argparse.Namespace) -> Training:
    """Return how a method is trained; raise RuntimeError where a student has no teacher."""
    store = unpacked_store(TASK, args.load, args.work)
    if method != STUDENT:
        return of_demonstrations(method, store, args, CHANGES.get(method))
    if teacher is None:
        raise RuntimeError("there is no teacher to distil")
    return of_teacher(teacher, store, args)


def speed_of(
    method: str, teacher: Path | None, out: Path, args: argparse.Namespace, timed: tuple[int, int]
) -> tuple[Path, float]:
    """Return the checkpoint of a short training in the folder `out`, and its steps/s."""
    training = training_of(method, teacher, args)
    return out / "long", steps_per_second(training.train, training.preset, out, timed)


def train_family(
    method: str, teacher: Path | None, out: Path, args: argparse.Namespace, steps: int, limit_s: float, windows: int
) -> tuple[Path, Trained]:
    """Train a method for so many steps, or until its time is over; return its checkpoint and what came of it."""
    made = train_steps(training_of(method, teacher, args), out, steps, limit_s, windows)
    return made.checkpoint, made


def awake() -> None:
    """Do nothing: a process that can has imported what it needs."""


# ---- one after another, or at once ----------------------------------------------------------------------------------


def here(method: str, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
    """Run a function in this process and return its finished future."""
    del method
    future: Future[Any] = Future()
    try:
        future.set_result(function(*arguments))
    except Exception as error:  # as an executor does
        future.set_exception(error)
    return future


class Processes:
    """A process for each method, which it keeps, so that one that breaks costs that method alone.

    Args:
        methods: their names.
    """

    def __init__(self, methods: Sequence[str]) -> None:
        context = multiprocessing.get_context("spawn")  # CUDA does not survive a fork
        self._executors: dict[str, Executor] = {m: ProcessPoolExecutor(1, mp_context=context) for m in methods}
        wait([self.submit(method, awake) for method in methods])

    def submit(self, method: str, function: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Run a function in the method's process; return its future."""
        return self._executors[method].submit(function, *arguments)

    def close(self) -> None:
        """End the processes."""
        for executor in self._executors.values():
            executor.shutdown(cancel_futures=True)


def results_in_turn(
    methods: Sequence[str], at_most: int, start: Callable[[str, Path | None], Future[Any]]
) -> Iterator[tuple[str, Future[Any]]]:
    """Yield each method with its finished future, as they finish.

    Args:
        methods: in the order in which they begin; a student waits for its teacher, if that is among them.
        at_most: so many run at once.
        start: (method, checkpoint of the teacher if there is one) -> future whose result begins with a checkpoint.
    """
    to_come, running = list(methods), dict[Future[Any], str]()
    teacher: Path | None = None
    while to_come or running:
        busy = {*to_come, *running.values()}
        ready = [method for method in to_come if not (method == STUDENT and TEACHER in busy)]
        for method in ready[: at_most - len(running)]:
            to_come.remove(method)
            running[start(method, teacher)] = method
        for future in wait(running, return_when=FIRST_COMPLETED).done:
            method = running.pop(future)
            if method == TEACHER and future.exception() is None:
                teacher = future.result()[0]
            yield method, future


# ---- the part -------------------------------------------------------------------------------------------------------


class Families:
    """Trains the methods.

    Args:
        args: of the command line.
        results: where lines go.
        budget: what the part has.
    """

    def __init__(self, args: argparse.Namespace, results: Results, budget: Budget) -> None:
        self.args, self.results, self.budget = args, results, budget
        self.size = size_of(unpacked_store(TASK, args.load, args.work), TEACHER)
        self.folder = args.work / PART
        self.timed = SMOKE_STEPS if args.smoke else TIMED_STEPS

    def run(self, processes: Processes | None) -> bool:
        """Measure, choose the way and train; return whether nothing failed."""
        speeds = self.speeds()
        if not speeds:
            return False
        all_per_s, submit, at_most = 1.0 / sum(1.0 / speed for speed in speeds.values()), here, 1
        if processes is not None and (together := self.together(tuple(speeds), all_per_s, processes)) is not None:
            faster = together > all_per_s
            told = {"one_after_another": round(all_per_s, 3), "at_once": round(together, 3)}
            self.results.write(PART, name="way", steps_of_all_per_s=told, used=list(told)[faster])
            if faster:
                all_per_s, submit, at_most = together, processes.submit, len(speeds)
        return self.train(speeds, all_per_s, submit, at_most) and len(speeds) == len(FAMILIES)

    def speeds(self) -> dict[str, float]:
        """Measure and write down the steps/s of each method alone; what failed is left out."""
        found = {}

        def start(method: str, teacher: Path | None) -> Future[Any]:
            return here(method, speed_of, method, teacher, self.folder / "speed" / method, self.args, self.timed)

        for method, future in results_in_turn(FAMILIES, 1, start):
            if error := future.exception():
                self.results.write(PART, name="speed", method=method, failed=last_error(error))
            else:
                found[method] = future.result()[1]
                self.results.write(PART, name="speed", method=method, steps_per_s=round(found[method], 2))
        return found

    def together(self, methods: Sequence[str], alone_per_s: float, processes: Processes) -> float | None:
        """Return how often in a second all methods take a step when trained at once; a line says why where None.

        Args:
            methods: their names.
            alone_per_s: how often they do one after another.
            processes: where they are trained.
        """

        def train(shorter: FitConfig, folder: Path) -> Path:
            assert shorter.steps is not None
            for _, future in self.trained(methods, folder, shorter.steps, {}, processes.submit, len(methods)):
                future.result()
            return folder

        expected_s = (2 * self.timed[0] + self.timed[1]) / alone_per_s
        if expected_s > TRIAL * self.budget.left_s:
            self.results.write(PART, name="way", left_out=f"trainings at once: {expected_s:.0f} s to try them")
            return None
        try:
            return steps_per_second(train, preset_for(TEACHER, "paper"), self.folder / "together", self.timed)
        except Exception as error:  # there is the other way
            self.results.write(PART, name="way", failed=last_error(error))
            return None

    def trained(
        self,
        methods: Sequence[str],
        folder: Path,
        steps: int,
        kept_s: Mapping[str, float],
        submit: Submit,
        at_most: int,
    ) -> Iterator[tuple[str, Future[Any]]]:
        """Train methods, a folder each, and yield them as they finish.

        A training may last for what is left, less what `kept_s` says is kept for others.
        """

        def start(method: str, teacher: Path | None) -> Future[Any]:
            limit_s, out = self.budget.left_s - OVERHEAD_S - kept_s.get(method, 0.0), folder / method
            return submit(method, train_family, method, teacher, out, self.args, steps, limit_s, self.size["windows"])

        return results_in_turn(methods, at_most, start)

    def train(self, speeds: Mapping[str, float], all_per_s: float, submit: Submit, at_most: int) -> bool:
        """Train as many steps of each as fit, write a line each, and return whether nothing failed."""
        methods, left_s = tuple(speeds), self.budget.left_s - OVERHEAD_S * (len(speeds) if at_most == 1 else 2)
        steps = SMOKE_STEPS[1] if self.args.smoke else int(CAUTION * left_s * all_per_s)
        if steps < FEWEST_STEPS and not self.args.smoke:
            self.results.write(PART, name="plan", failed=f"{left_s:.0f} s are too few: {steps} steps of each")
            return False
        kept_s, succeeded = dict[str, float](), True
        if at_most == 1:  # a late one may use up what was set aside, but not the time of those after it
            took = [OVERHEAD_S + steps / speeds[method] for method in methods]
            kept_s = {method: sum(took[k + 1 :]) for k, method in enumerate(methods)}
        for method, future in self.trained(methods, self.folder, steps, kept_s, submit, at_most):
            line = {"name": "trained", "method": method, "task": TASK, "at_once": at_most > 1}
            try:
                made = self.brought_home(method, *future.result())
                self.results.write(PART, **line, **made, steps_per_s=round(speeds[method], 2))
            except Exception as error:  # the others have their own chance
                succeeded = False
                self.results.write(PART, **line, failed=last_error(error))
        return succeeded

    def brought_home(self, method: str, checkpoint: Path, made: Trained) -> dict[str, Any]:
        """Return the numbers of a training; its checkpoint goes where files come back, if it is one of those."""
        numbers = {**self.size, **made.numbers}
        if method not in COME_BACK:
            return numbers
        archive = self.args.out / archive_name(TASK, method)
        return {**numbers, "archive": archive.name, "bytes": pack(checkpoint, archive, self.args.work)}


def main() -> int:
    """Train, and return the exit status."""
    parser = part_arguments(argparse.ArgumentParser(description=__doc__.splitlines()[0]))
    parser.add_argument("--device", default="auto", help="cpu or cuda; auto takes CUDA where there is one")
    parser.add_argument("--processes", action="store_true", help="try trainings at once where there is no GPU too")
    args = parser.parse_args()
    families = Families(args, results_of(args.out), Budget(args.budget))
    several = args.processes or resolve_device(args.device).type == "cuda"
    processes = Processes(FAMILIES) if several else None
    try:
        return 0 if families.run(processes) else 1
    finally:
        if processes is not None:
            processes.close()


if __name__ == "__main__":
    raise SystemExit(main())
