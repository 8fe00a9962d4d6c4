"""The parent's side of `child.py`: sends a job and its episodes to the process that writes them."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np

from manicm_ms.demos.convert import child
from manicm_ms.errors import ManicmError, NoSpaceError
from manicm_ms.paths import is_disk_full

_IMPORT_ERRORS = ("ImportError", "ModuleNotFoundError")


class Writer:
    """The process that writes a data set, while the block lasts; a block without an error ends with the process.

    Args:
        format: a name in `child.WRITERS`.
        python: interpreter that has the format's library.
        root: folder to write, not there yet.
        job: JSON values for the format's writer.

    Raises NoSpaceError where the process finds the disk full, ManicmError where it fails otherwise.
    """

    def __init__(self, format: str, python: str, root: Path, job: Mapping[str, Any]) -> None:
        self._format = format
        self._said: IO[bytes] = tempfile.TemporaryFile()  # noqa: SIM115  (__exit__ closes it; a pipe could fill up)
        # Absolute: a library may join the path to another one, or work in a folder of its own.
        # -I: nothing of our environment, nor this folder, whose lerobot.py would stand before the library.
        self._process = subprocess.Popen(
            [python, "-I", child.__file__, format, str(root.absolute())],
            stdin=subprocess.PIPE,
            stdout=self._said,
            stderr=self._said,
            env={**os.environ, "HF_HUB_OFFLINE": "1"},
        )
        self.send({"job": np.array(json.dumps(job))})

    def send(self, arrays: Mapping[str, Any]) -> None:
        """Hand over an episode."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(child.pack(dict(arrays)))
            self._process.stdin.flush()
        except BrokenPipeError as error:
            raise self._failure() from error

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self._process.kill()
        try:
            self._process.communicate()  # closes its input and waits for it
            if kind is None and self._process.returncode:
                raise self._failure()
        finally:
            self._said.close()

    def _failure(self) -> ManicmError:
        self._process.wait()
        self._said.seek(0)
        said = self._said.read().decode(errors="replace").strip()
        if is_disk_full(Exception(said)):
            return NoSpaceError(f"{self._format} found no space left: free some and give the same command")
        reason = said.splitlines()[-1].strip() if said else f"exit status {self._process.returncode}"
        kind = reason.partition(":")[0]
        remedy = "check that library's installation" if kind in _IMPORT_ERRORS else "try another --out, or report this"
        return ManicmError(f"{self._format} could not write the data set ({reason}): {remedy}")
