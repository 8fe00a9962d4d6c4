"""The Python of docs/guides/collect_demos.md runs as it stands, block after block, and makes what it says."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

from manicm_ms.demos.store import DemoStore

GUIDE = Path(__file__).parents[2] / "docs" / "guides" / "collect_demos.md"


def test_the_guides_code_runs(tmp_path):
    blocks = re.findall(r"^```python\n(.*?)^```", GUIDE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert len(blocks) == 4
    command = [sys.executable, "-c", "\n".join(blocks)]
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "2/2=100.00% demos saved" in done.stdout
    for name in ("demos.zarr", "by_hand.zarr"):
        with DemoStore.open(tmp_path / name) as store:
            assert store.seeds.tolist() == [0, 1]
    (replayed,) = (tmp_path / "converted" / "maniskill").glob("trajectory.state.*.json")
    assert [e["success"] for e in json.loads(replayed.read_text())["episodes"]] == [True, True]
