"""The guide on adding a method: its code blocks are a file that works outside the repository, training to timing."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

GUIDE = Path(__file__).parents[1] / "docs" / "guides" / "add_a_method.md"

SCRIPT = """
import sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from reach_demos import make_store
from manicm_ms.cli import main
from manicm_ms.evaluation.latency import measure_latency
from manicm_ms.policies import example_observations
from manicm_ms.policies.checkpoint import load_checkpoint

def run(*words):
    try:
        main(list(words))
    except SystemExit as end:
        return end.code or 0

make_store("demos.zarr", episodes=3)
assert run("list", "policies") == 0
tiny = "--preset smoke --steps 20 --batch-size 4 --points 8 --log-every 1 --device cpu --set head.width=16"
assert run("train", "bc_mse_3d", "--data", "demos.zarr", "--out", "bc", *tiny.split()) == 0
policy = load_checkpoint(Path("bc"))
assert policy.head.config.width == 16 and policy.noise_draws == 0 and policy.role is None
actions = policy.act(example_observations(policy, batch=3))
assert actions.shape == (3, 3, 3), actions.shape
print("timed", measure_latency({"bc": policy}, repetitions=2, warmup=0)["bc"].nfe)
assert run("train", "bc_mse_3d", "--data", "demos.zarr", "--out", "x", "--set", "head.widht=16") == 2
assert run("train", "bc_mse_3d", "--data", "demos.zarr", "--out", "x", "--set", "backbone=unet1d") == 2
assert run("distill", "--teacher", "bc", "--data", "demos.zarr", "--out", "x") == 2
assert not Path("x").exists()
"""


def blocks(language):
    return re.findall(rf"^```{language}\n(.*?)^```$", GUIDE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


@pytest.fixture(scope="module")
def method_folder(tmp_path_factory):
    """A folder outside the repository that holds the method as the guide gives it, and a file that takes its name."""
    folder = tmp_path_factory.mktemp("my_methods")
    text = "".join(blocks("python"))
    (folder / "regression.py").write_text(text, encoding="utf-8")
    (folder / "same_name.py").write_text(text, encoding="utf-8")  # comes second, and is left out
    return folder


def test_the_blocks_are_a_clean_file(method_folder):
    root = GUIDE.parents[2]
    done = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--config", root / "pyproject.toml", "--ignore", "ANN,RUF012,E302,E305",
         method_folder / "regression.py"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_method_outside_the_repository_is_trained_loaded_and_timed(method_folder, tmp_path):
    environment = os.environ | {"MANICM_MS_TASKS": str(method_folder), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(Path(__file__).parent / "training")],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert "bc_mse_3d" in done.stdout
    assert "timed 1" in done.stdout
    (line,) = [line for line in done.stderr.splitlines() if "same_name.py" in line]
    assert "head 'regression' is registered twice" in line
    assert "did you mean 'head.width'" in done.stderr
    assert "runs no backbone" in done.stderr
    assert "cannot be distilled" in done.stderr
    config = json.loads((tmp_path / "bc" / "config.json").read_text())
    assert config["config"]["head"] == {"name": "regression", "width": 16}
    assert config["config"]["backbone"] is None


TAKES = """from manicm_ms.policies.heads.head import HEADS, TrainableHead
@HEADS.register("rnn")
class Mine(TrainableHead): pass
"""
BREAKS = """from manicm_ms.policies.heads.gmm import GMMHead
from manicm_ms.policies.methods import METHODS
from manicm_ms.training.objectives.head_loss import HeadObjective
METHODS.add("half_done", METHODS.get_registered("dp3"))
raise RuntimeError("not ready")
"""
LOOKS = """
from pathlib import Path
from manicm_ms.envs.simulator import ENVS
from manicm_ms.policies.checkpoint import load_checkpoint
from manicm_ms.policies.heads.head import HEADS
from manicm_ms.policies.methods import METHODS
from manicm_ms.training.objectives.objective import OBJECTIVES
assert "ur3e/slide-block" in ENVS.names()
assert HEADS.get("rnn").__module__ == "manicm_ms.policies.heads.rnn"
assert {"gmm", "rnn", "diffusion", "consistency"} <= set(HEADS.names())
assert {"dp3", "bc_gmm_3d"} <= set(METHODS.names()) and "half_done" not in METHODS.names()
assert OBJECTIVES.names() == ("plain", "averaged")
print(load_checkpoint(Path(CHECKPOINT)).name)
"""


@pytest.mark.parametrize("first", ["ENVS", "METHODS", "HEADS"])
def test_a_file_that_takes_a_name_of_ours_or_breaks_costs_what_is_ours_nothing(first, tmp_path):
    """Whichever registry comes to the user's files first, and whatever of ours is imported by then."""
    (tmp_path / "takes.py").write_text(TAKES)
    (tmp_path / "breaks.py").write_text(BREAKS)
    student = GUIDE.parents[2] / "checkpoints" / "slide_block" / "student"
    lines = LOOKS.replace("CHECKPOINT", repr(str(student))).splitlines()
    lines.sort(key=lambda line: not (f" {first}" in line and line.startswith("from")))
    lines.insert(1, f"{first}.names()")
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)], cwd=tmp_path, capture_output=True, text=True, check=False,
        env=os.environ | {"MANICM_MS_TASKS": str(tmp_path), "OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.strip() == "manicm"
    assert done.stderr.count("takes.py, line 2: DuplicateNameError: head 'rnn' is registered twice") == 1
    assert done.stderr.count("breaks.py, line 5: RuntimeError: not ready") == 1
