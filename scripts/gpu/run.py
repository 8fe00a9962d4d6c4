"""Run the GPU kit on a machine with a GPU: what was carried along is unpacked, then part after part is measured.

    python3 scripts/gpu/run.py learning --load .gpu_kit/learning --out OUT        # parts 1 and 2, 8 minutes at most
    python3 scripts/gpu/run.py simulation --load .gpu_kit/simulation --out OUT    # part 3, 4 minutes at most
    python3 scripts/gpu/run.py families --load .gpu_kit/families --out OUT        # part 4, 5 minutes at most

Every result is a line of OUT/results.jsonl as soon as it is known. A part that fails or outlasts its time is a line
too, and the next one goes on. `--smoke` shows on any machine that everything runs. See docs/gpu_kit.md.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from kit import Results, last_error, last_line, make_site, results_of, run_limited

HERE = Path(__file__).resolve().parent


class Part(NamedTuple):
    """A process of the kit.

    Attributes:
        name: of its lines.
        command: script and arguments.
        seconds: after which it is ended.
    """

    name: str
    command: tuple[str, ...]
    seconds: float


LOADS: dict[str, tuple[Part, ...]] = {
    "learning": (  # highest value first
        Part("latency eager", ("part_latency.py", "--mode", "eager"), 75.0),
        Part("latency graph", ("part_latency.py", "--mode", "graph"), 65.0),
        Part("training", ("part_training.py",), 310.0),
    ),
    "simulation": (Part("simulation", ("part_simulation.py",), 210.0),),
    "families": (Part("families", ("part_families.py",), 270.0),),
}
UNPACKING_S = 30.0  # allowed for what comes before the first part
LIMIT_S = {"learning": 480.0, "simulation": 240.0, "families": 300.0}
MARGIN_S = 5.0  # a part knows of less time than it has, so that it ends by itself


def run_part(part: Part, args: argparse.Namespace, site: Path, results: Results) -> bool:
    """Run one part and return whether it succeeded; a failure is written down."""
    script, *options = part.command
    budget = max(part.seconds - MARGIN_S, 1.0)
    command = [
        sys.executable, str(HERE / script), "--out", str(args.out), "--work", str(args.work), "--load", str(args.load),
        "--budget", str(budget), *(["--smoke"] if args.smoke else []), *options,
    ]  # fmt: skip
    path = os.pathsep.join([str(site), *filter(None, [os.environ.get("PYTHONPATH")])])
    env = {**os.environ, "PYTHONPATH": path, "PYTHONUNBUFFERED": "1"}
    log, begin = args.out / "log.txt", time.monotonic()
    status = run_limited(command, part.seconds, log, env, args.work)
    line = {"name": part.name, "status": status, "seconds": round(time.monotonic() - begin, 1)}
    if status is None:
        line["failed"] = f"ended after {part.seconds:.0f} s"
    elif status:
        line["failed"] = last_line(log)
    results.write("run", **line)
    return status == 0


def main() -> int:
    """Unpack, run, and return 0 where every part succeeded."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", choices=tuple(LOADS), help="which load")
    parser.add_argument("--load", type=Path, required=True, help="folder of what was carried along")
    parser.add_argument("--out", type=Path, required=True, help="folder whose files come back")
    parser.add_argument("--work", type=Path, help="folder outside the tree for what does not come back")
    parser.add_argument("--only", nargs="+", default=[], help="names of parts; by default all of the load")
    parser.add_argument("--smoke", action="store_true", help="tiny networks and few steps")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    args.out = args.out.resolve()
    args.load = args.load.resolve()
    args.work = (args.work or Path(tempfile.mkdtemp(prefix="gpu_kit_"))).resolve()
    args.work.mkdir(parents=True, exist_ok=True)
    results, begin = results_of(args.out), time.monotonic()
    try:
        site = make_site(args.work / "site", args.load / "wheels")
    except (OSError, ValueError, shutil.Error) as error:
        results.write("run", name="unpacking", failed=last_error(error))
        return 1
    results.write("run", name="unpacking", seconds=round(time.monotonic() - begin, 1), python=platform.python_version())
    parts = [part for part in LOADS[args.parts] if not args.only or part.name in args.only]
    succeeded = [run_part(part, args, site, results) for part in parts]
    print(f"{sum(succeeded)} of {len(parts)} parts succeeded", flush=True)
    return 0 if all(succeeded) else 1


if __name__ == "__main__":
    sys.exit(main())
