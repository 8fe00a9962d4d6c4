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


@pytest.mark.parametrize(("block", "last"), [(0, "manicm 2"), (1, "True")])
def test_a_block_runs_as_a_script(block, last, tmp_path):
    script = tmp_path / "script.py"
    script.write_text(BLOCKS[block])
    done = subprocess.run(
        [sys.executable, str(script)], cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().splitlines()[-1] == last


def test_every_block_is_tried():
    assert len(BLOCKS) == 2
