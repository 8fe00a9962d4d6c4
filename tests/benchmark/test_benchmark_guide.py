"""The Python of docs/guides/benchmark.md runs as it stands and prints what it says."""

import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

if find_spec("metaworld") is None:
    pytest.skip("the MuJoCo suites are an extra, which is not installed", allow_module_level=True)

GUIDE = Path(__file__).resolve().parents[2] / "docs/guides/benchmark.md"
BLOCKS = re.findall(r"^```python\n(.*?)^```", GUIDE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def test_the_grid_runs_as_a_script(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(BLOCKS[0])
    done = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().splitlines()[-1] == "manicm 2"


def test_the_restored_state_is_the_saved_one(capsys):
    exec(BLOCKS[1], {"__name__": "__main__"})  # starts no process and writes nothing, so this one will do
    assert capsys.readouterr().out.strip() == "True"


def test_every_block_is_tried():
    assert len(BLOCKS) == 2
