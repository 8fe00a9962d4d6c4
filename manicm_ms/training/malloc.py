"""Tunes glibc's allocator for training on a CPU, where returning memory costs a quarter of the time."""

from __future__ import annotations

import ctypes
import platform

# Parameter numbers of mallopt(3), from glibc's malloc.h.
_M_TRIM_THRESHOLD = -1
_M_TOP_PAD = -2
_M_MMAP_THRESHOLD = -3

_LARGEST_INT = (1 << 31) - 1
_OLD_MMAP_LIMIT_BYTES = 32 << 20  # glibc before 2.35 accepts no larger mmap threshold
_TOP_PAD_BYTES = 256 << 20


def keep_freed_memory() -> bool:
    """Make this process keep the memory it frees, for the next step to use without page faults.

    By default glibc maps every tensor of more than 128 kB afresh and unmaps it when it is freed, so each
    training step touches all of its activations for the first time again. The process grows to its peak and
    stays there. Environment variables (MALLOC_MMAP_THRESHOLD_ and so on) do the same from outside.

    Returns:
        Whether it was done; False on systems without glibc.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    mallopt = ctypes.CDLL(None).mallopt
    done = mallopt(_M_MMAP_THRESHOLD, _LARGEST_INT) or mallopt(_M_MMAP_THRESHOLD, _OLD_MMAP_LIMIT_BYTES)
    return bool(done and mallopt(_M_TRIM_THRESHOLD, _LARGEST_INT) and mallopt(_M_TOP_PAD, _TOP_PAD_BYTES))
