"""How the command line puts what it has to say about its work: one line each."""

from __future__ import annotations

import errno
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from manicm_ms.errors import ManicmWarning
from manicm_ms.paths import is_disk_full, without_temporaries

PROGRAM = "manicm-ms"
_CHECK_THE_PATH = "check the paths on the command line"
_REMEDIES = {
    errno.EACCES: "name a place that you may read and write, or change its permissions",
    errno.EPERM: "name a place that you may read and write, or change its permissions",
    errno.EROFS: "name a place on a file system that can be written to",
    errno.ENOENT: "make the folder it lies in, or correct the path",
    errno.ENOTDIR: "a part of the path is a file: correct the path",
    errno.EISDIR: "this is a folder where a file is wanted: correct the path",
    errno.EEXIST: "name another place, or move away what stands there",
}


@contextmanager
def warnings_in_one_line() -> Iterator[None]:
    """Show warnings of this package as a line of its own; those of libraries stay as Python shows them."""
    usual = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if issubclass(category, ManicmWarning):
            print(f"{PROGRAM}: warning: {' '.join(str(message).split())}", file=sys.stderr)
        else:
            usual(message, category, *where, **more)

    with warnings.catch_warnings():
        warnings.simplefilter("always", ManicmWarning)
        warnings.showwarning = show
        yield


def explain(error: OSError) -> str:
    """Say which file is in trouble, why and what to try; raise `error` again where it is about no file and no disk."""
    if is_disk_full(error):
        return f"no space left on the disk ({error.filename or 'output'}): free some and give the same command"
    if error.filename is None:
        raise error
    return f"{error.filename}: {error.strerror or error}: {_REMEDIES.get(error.errno or 0, _CHECK_THE_PATH)}"


def report_error(message: str) -> None:
    """Print what went wrong, in one line, on standard error."""
    print(f"{PROGRAM}: {without_temporaries(' '.join(message.split()))}", file=sys.stderr)
