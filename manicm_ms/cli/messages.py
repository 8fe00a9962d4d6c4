"""How the command line puts what it has to say about its work: one line each."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from manicm_ms.errors import ManicmWarning

PROGRAM = "manicm-ms"


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
