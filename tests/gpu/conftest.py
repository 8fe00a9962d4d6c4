"""Makes the kit's scripts and the store of the training tests importable."""

import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path += [str(ROOT / "scripts" / "gpu"), str(ROOT / "tests" / "training")]
