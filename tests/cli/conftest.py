"""Makes the toy environments and demonstrations of other folders importable here."""

import sys
from pathlib import Path

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS / "envs"), str(TESTS / "training"), str(TESTS / "demos")]
