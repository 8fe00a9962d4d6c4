"""Part 3 of the GPU kit: SAPIEN's pictures by the GPU's own driver, conformance checks, and speed.

Physics runs on the CPU, a process a row. The NVIDIA driver makes the pictures where a first one succeeds within its
time, which it does not on every machine; a second call then brings a software driver. Each line says which it was.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from kit import Budget, Results, last_error, last_line, part_arguments, results_of, run_limited

PART = "simulation"
PROBE_S, SOFTWARE_PROBE_S = 20.0, 60.0  # for the first picture: some GPU drivers hang there, software is only slow
RATE_S, CHECK_S = 45.0, 60.0
SMOKE_PATIENCE = 4  # times these: the smoke scale runs on whatever machine is at hand, busy as it may be
TASKS = ("ur3e/slide-block", "ur3e/stack-cube", "ur3e/transfer-piece")
WORKERS, STEPS, REPETITIONS, SIZE = (1, 4, 16), 100, 5, 84
SMOKE_TASKS, SMOKE_WORKERS, SMOKE_STEPS = TASKS[:1], (1,), 3
NVIDIA = "NVIDIA"
DRIVER = "nvidia_icd*.json"
DRIVER_FOLDERS = (
    "/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d",
    "/usr/local/nvidia/share/vulkan/icd.d", "/usr/local/nvidia/vulkan/icd.d",
)  # fmt: skip


# ---- drivers ------------------------------------------------------------------------------------------------------


def unpack_debs(load: Path, work: Path) -> None:
    """Unpack the carried loaders outside the tree; nothing of the machine's own is replaced."""
    for package in sorted((load / "debs").glob("*.deb")):
        command = ["dpkg", "-x", str(package), str(work / "root")]
        subprocess.run(command, check=True, capture_output=True, timeout=60)


def loaders(work: Path) -> dict[str, str]:
    """Return the variables that make programs find the unpacked loaders, after what the shell names."""
    folders = sorted({str(path.parent) for path in (work / "root").rglob("*.so*")})
    named = [os.environ["LD_LIBRARY_PATH"]] if os.environ.get("LD_LIBRARY_PATH") else []
    return {"LD_LIBRARY_PATH": os.pathsep.join([*named, *folders])} if folders else {}


def nvidia_driver() -> Path | None:
    """Return the manifest of NVIDIA's Vulkan driver, None where there is none."""
    found = [path for folder in DRIVER_FOLDERS for path in sorted(Path(folder).glob(DRIVER))]
    return found[0] if found else None


def candidates(load: Path, work: Path) -> dict[str, dict[str, str]]:
    """Return name -> environment variables of the drivers to try.

    A software driver is carried only where the machine's own have failed, and is then the one to try.
    """
    software = load / "software.tar.xz"
    if software.is_file():
        with tarfile.open(software) as archive:
            archive.extractall(work / "software", filter="data")
        return {"software, carried": {**loaders(work), "MANICM_MS_VULKAN": str(work / "software")}}
    unpack_debs(load, work)
    tried: dict[str, dict[str, str]] = {}
    if driver := nvidia_driver():
        tried[NVIDIA] = {**loaders(work), "MANICM_MS_VULKAN": "system", "VK_DRIVER_FILES": str(driver)}
    return tried | {"as the machine has it": loaders(work)}


def choose_driver(args: argparse.Namespace, results: Results) -> dict[str, str] | None:
    """Return the variables of the first driver that makes a right picture in time, and say which it is."""
    for name, variables in candidates(args.load, args.work).items():
        log = args.work / "probe.log"
        log.unlink(missing_ok=True)
        limit_s = PROBE_S if name == NVIDIA else SOFTWARE_PROBE_S
        status = run_limited(
            [sys.executable, "-m", "manicm_ms.machine.vulkan"], limit_s, log, environment(variables), args.work
        )
        said = last_line(log)
        if status == 0:
            results.write(PART, name="driver", driver=name, device=said, gpu="NVIDIA" in said.upper())
            return {**variables, "KIT_DEVICE": said}
        why = f"no picture within {limit_s:.0f} s" if status is None else said
        results.write(PART, name="driver", driver=name, failed=why)
    return None


def environment(variables: Mapping[str, str]) -> dict[str, str]:
    """Return this process's environment with `variables`; a driver that a shell named does not count."""
    kept = {k: v for k, v in os.environ.items() if k not in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES")}
    return {**kept, **variables}


# ---- speed and checks ---------------------------------------------------------------------------------------------


def rate(env_id: str, workers: int, steps: int, repetitions: int) -> dict[str, Any]:
    """Return the control steps of all rows per second, small random actions, at `workers` processes."""
    import torch

    from manicm_ms import make_vec
    from manicm_ms.bench.env import in_turn, vec_player

    torch.set_num_threads(1)
    env = make_vec(env_id, workers, "cpu", image_size=(SIZE, SIZE))
    try:
        timed = in_turn({"": vec_player(env, 0)}, {"": steps}, workers, repetitions)[""]
    finally:
        env.close()
    rates = sorted(timed.rates)
    return {"steps_per_s": round(rates[len(rates) // 2], 1), "best": round(rates[-1], 1)}


def measure_rates(args: argparse.Namespace, results: Results, budget: Budget, variables: Mapping[str, str]) -> bool:
    """Write a line for each number of workers, each measured in a process of its own, and return whether all were."""
    complete = True
    for workers in SMOKE_WORKERS if args.smoke else WORKERS:
        log, found = args.work / f"rate_{workers}.log", args.work / f"rate_{workers}.json"
        log.unlink(missing_ok=True)
        found.unlink(missing_ok=True)
        command = [sys.executable, __file__, "--rate", str(workers), "--to", str(found), *_common(args)]
        status = run_limited(command, _limit_s(RATE_S, args, budget), log, environment(variables), args.work)
        line: dict[str, Any] = {"name": "rate", "task": TASKS[0], "workers": workers, "device": variables["KIT_DEVICE"]}
        if status == 0:
            line |= json.loads(found.read_text(encoding="utf-8"))
        else:
            line["failed"] = _why(status, log)
            complete = False
        results.write(PART, **line)
    return complete


def check_conformance(args: argparse.Namespace, results: Results, budget: Budget, variables: Mapping[str, str]) -> bool:
    """Run `manicm-ms check` on each task while there is time, a line each, and return whether all passed."""
    complete = True
    for task in SMOKE_TASKS if args.smoke else TASKS:
        log = args.work / f"check_{Path(task).name}.log"
        log.unlink(missing_ok=True)
        if budget.left_s < CHECK_S / 4:
            results.write(PART, name="check", task=task, left_out="the time was used up")
            continue
        command = [sys.executable, "-m", "manicm_ms.cli", "check", task, "--backend", "cpu"]
        status = run_limited(command, _limit_s(CHECK_S, args, budget), log, environment(variables), args.work)
        lines = log.read_text(encoding="utf-8", errors="replace").splitlines()
        broken = [line.strip() for line in lines if line.strip().startswith("FAIL")]
        passed = sum(line.strip().startswith("ok") for line in lines)
        line = {"name": "check", "task": task, "device": variables["KIT_DEVICE"], "passed": passed, "broken": broken}
        if status != 0 and not broken:
            line["failed"] = _why(status, log)
        results.write(PART, **line)
        complete &= status == 0
    return complete


def _limit_s(seconds: float, args: argparse.Namespace, budget: Budget) -> float:
    return min(seconds * (SMOKE_PATIENCE if args.smoke else 1), budget.left_s)


def _why(status: int | None, log: Path) -> str:
    return "its time ran out" if status is None else f"status {status}: {last_line(log)}"


def _common(args: argparse.Namespace) -> list[str]:
    places = [word for name in ("out", "work", "load") for word in (f"--{name}", str(getattr(args, name)))]
    return [*places, "--budget", str(args.budget), *(["--smoke"] if args.smoke else [])]


def main() -> int:
    """Measure everything, or with --rate one number of workers, and return the exit status."""
    parser = part_arguments(argparse.ArgumentParser(description=__doc__.splitlines()[0]))
    parser.add_argument("--rate", type=int, help="measure this number of workers alone")
    parser.add_argument("--to", type=Path, help="file for what --rate measures")
    parser.add_argument("--skip-check", action="store_true", help="leave out 'manicm-ms check'")
    args = parser.parse_args()
    if args.rate:
        steps, repetitions = (SMOKE_STEPS, 1) if args.smoke else (STEPS, REPETITIONS)
        args.to.write_text(json.dumps(rate(TASKS[0], args.rate, steps, repetitions)), encoding="utf-8")
        return 0
    results, budget = results_of(args.out), Budget(args.budget)
    try:
        variables = choose_driver(args, results)
    except (OSError, subprocess.SubprocessError, tarfile.TarError) as error:
        results.write(PART, name="driver", failed=last_error(error))
        return 1
    if variables is None:
        return 1
    complete = measure_rates(args, results, budget, variables)
    if not args.skip_check:
        complete &= check_conformance(args, results, budget, variables)
    return 0 if complete else 1


if __name__ == "__main__":
    raise SystemExit(main())
