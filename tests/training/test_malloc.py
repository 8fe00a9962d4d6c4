"""The allocator setting measured by what it is for: fewer page faults."""

import json
import platform
import subprocess
import sys

import pytest

_FAULTS = """
import json, resource, sys
import torch
from manicm_ms.training.malloc import keep_freed_memory

done = keep_freed_memory() if sys.argv[1] == "tuned" else None
for _ in range(20):  # until the heap has grown to its peak
    torch.empty(8 << 20).fill_(1.0)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(40):
    torch.empty(8 << 20).fill_(1.0)  # 32 MB each
print(json.dumps([done, resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before]))
"""


def _faults(mode: str) -> tuple[bool | None, int]:
    run = subprocess.run([sys.executable, "-c", _FAULTS, mode], capture_output=True, text=True, check=True)
    return tuple(json.loads(run.stdout))


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="mallopt is glibc's")
def test_freed_memory_is_kept():
    (_, plain), (done, tuned) = _faults("plain"), _faults("tuned")
    assert done is True
    assert tuned < plain / 2  # the heap may still grow a few times, where every tensor was mapped afresh before
