"""The environment benchmark says in one line why it cannot run on a GPU where there is none."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

SCRIPT = Path(__file__).parents[1] / "scripts" / "bench_env.py"


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_a_missing_gpu_is_named_in_one_line():
    command = [sys.executable, SCRIPT, "--backend", "gpu", "--num-envs", "1", "16"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("bench_env.py: ")]
    assert "backend 'gpu' cannot run here: torch finds no CUDA device; use backend 'cpu'" in line
    assert "Traceback" not in done.stderr
    assert done.stdout == ""
