"""The main job: collect 10 demonstrations of Slide Block, train a teacher, distil it, evaluate the pair.

Each step is one command of the package, printed before it runs. Every step goes on where it was stopped, so that the
whole can be interrupted and started again.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import time
from pathlib import Path

ENV_ID = "ur3e/slide-block"
FOLDER = Path("runs/demo")
EPISODES, FRESH_EPISODES, FRESH_SEED = "10", "50", "100000"


def steps() -> list[list[str]]:
    """Return the commands, in order."""
    data, teacher, student, report = (str(FOLDER / name) for name in ("demos.zarr", "teacher", "student", "report"))
    fresh = ["--episodes", FRESH_EPISODES, "--seed", FRESH_SEED]
    return [
        ["collect", ENV_ID, "--episodes", EPISODES, "--seed", "0", "--out", data],
        ["train", "simple_dp3", "--data", data, "--out", teacher, "--preset", "quick"],
        ["distill", "--teacher", teacher, "--data", data, "--out", student, "--preset", "quick"],
        ["evaluate", teacher, student, "--env", ENV_ID, *fresh, "--out", report],
    ]


def main() -> int:
    """Run the steps; return the exit status of the first that fails, or 0."""
    start = time.monotonic()
    for step in steps():
        print(f"\n$ manicm-ms {shlex.join(step)}", flush=True)
        code = subprocess.run([sys.executable, "-m", "manicm_ms.cli", *step]).returncode
        if code:
            return code
    print(f"\n{(time.monotonic() - start) / 60:.1f} minutes. Open {FOLDER / 'report' / 'report.html'} in a browser.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
