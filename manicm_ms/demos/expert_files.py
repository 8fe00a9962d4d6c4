"""Weights of published experts: fetched once from their public source, checked, and kept as plain arrays.

A task's module registers what its expert needs as an `ExpertFile`; `manicm-ms experts fetch` gets it. Nothing is taken
from a source, a folder or the cache unless its numbers have the SHA-256 that the task's module names.
"""

from __future__ import annotations

import hashlib
import http.client
import os
import urllib.request
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manicm_ms.errors import ExpertFileError
from manicm_ms.paths import write_bytes, write_text
from manicm_ms.registry import TASKS, Registry

FOLDER_VARIABLE = "MANICM_MS_EXPERTS"
_TIMEOUT_S = 30
_MOST_BYTES = 50_000_000
_LICENCE = "LICENSE"

Arrays = dict[str, NDArray[np.generic]]


@dataclass(frozen=True)
class ExpertFile:
    """The weights of one expert.

    Attributes:
        name: "suite/task"; the arrays are kept as suite/task.npz.
        url: the public file, of a pinned version.
        sha256: of that file.
        read: its bytes -> the arrays; executes nothing of it.
        arrays_sha256: `digest` of the arrays.
        licence: name of the licence.
        licence_url: its text, of the same version.
        licence_sha256: of that text.
        credit: who made it, one line.
    """

    name: str
    url: str
    sha256: str
    read: Callable[[bytes], Arrays]
    arrays_sha256: str
    licence: str
    licence_url: str
    licence_sha256: str
    credit: str

    @property
    def path(self) -> Path:
        """Where the arrays are kept."""
        return experts_folder() / f"{self.name}.npz"


EXPERT_FILES: Registry[ExpertFile] = Registry("expert file", package=TASKS, group=TASKS)


def experts_folder() -> Path:
    """Return the folder of fetched experts: MANICM_MS_EXPERTS, else manicm_ms/experts in the user's cache."""
    named = os.environ.get(FOLDER_VARIABLE)
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "manicm_ms" / "experts"


def digest(arrays: Mapping[str, NDArray[np.generic]]) -> str:
    """Return a SHA-256 of names, types, shapes and numbers, whatever file they are kept in."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        total.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        total.update(array.tobytes())
    return total.hexdigest()


def load_arrays(name: str) -> Arrays:
    """Return the arrays of the expert file called `name`, checked.

    Raises ExpertFileError where they are missing, altered, or hold pickles; UnknownNameError for the name.
    """
    file = EXPERT_FILES.get(name)
    if not file.path.is_file():
        raise ExpertFileError(
            f"the expert of {name} is not at {file.path}: 'manicm-ms experts fetch' gets it, or "
            "'manicm-ms experts fetch --from FOLDER' takes it from a folder"
        )
    return _checked(file, file.path)


def fetch(names: Sequence[str], source: Path | None = None, report: Callable[[str], None] = print) -> list[Path]:
    """Get experts and keep them, with their licence; those that are there and whole already are left.

    Args:
        names: of the experts.
        source: a folder that holds TASK.npz and LICENSE, to be read instead of the public source.
        report: called with a line for each expert.

    Returns:
        where the arrays are.

    Raises ExpertFileError where one cannot be had or is not what it should be; what was got before stays.
    """
    files = [EXPERT_FILES.get(name) for name in names]
    for file in files:
        if _is_whole(file):
            report(f"{file.path} is there already")
            continue
        if source is not None:
            arrays, licence = _checked(file, source / f"{file.path.stem}.npz"), _licence_in(file, source)
        else:
            arrays, licence = _downloaded(file)
        _keep(file, arrays, licence)
        report(f"{file.path}: {sum(a.size for a in arrays.values())} numbers, {file.licence}")
    return [file.path for file in files]


def _is_whole(file: ExpertFile) -> bool:
    try:
        return bool(_checked(file, file.path)) and (file.path.parent / _LICENCE).is_file()
    except ExpertFileError:
        return False


def _checked(file: ExpertFile, path: Path) -> Arrays:
    """Return the arrays of a .npz file; raise ExpertFileError unless they are those of `file`."""
    if not path.is_file():
        raise ExpertFileError(f"{path} is not there: name a folder that holds {path.name}")
    try:
        with np.load(BytesIO(path.read_bytes()), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except Exception as error:  # zipfile, zlib and NumPy raise many kinds on damaged files
        # NumPy says "allow_pickle=False" of pickles, be they the file itself or arrays of objects in it.
        pickled = "it holds pickles, which are never read" if "pickle" in str(error) else "it is damaged"
        raise ExpertFileError(
            f"{path} is no archive of plain arrays ({pickled}): delete it and run 'manicm-ms experts fetch'"
        ) from error
    if (found := digest(arrays)) != file.arrays_sha256:
        raise ExpertFileError(
            f"{path} is not the expert of {file.name}: the SHA-256 of its arrays is {found[:16]}... where "
            f"{file.arrays_sha256[:16]}... is expected; delete it and run 'manicm-ms experts fetch'"
        )
    return arrays


def _downloaded(file: ExpertFile) -> tuple[Arrays, bytes]:
    content = _download(file, file.url, file.sha256)
    arrays = file.read(content)
    if digest(arrays) != file.arrays_sha256:
        raise ExpertFileError(f"{file.url} was read into other arrays than those of {file.name}: report this defect")
    return arrays, _download(file, file.licence_url, file.licence_sha256)


def _download(file: ExpertFile, url: str, sha256: str) -> bytes:
    try:
        with urllib.request.urlopen(url, timeout=_TIMEOUT_S) as response:
            content = response.read(_MOST_BYTES)
    except (OSError, http.client.HTTPException, ValueError) as error:  # URLError is an OSError
        reason = str(getattr(error, "reason", None) or error).strip()
        raise ExpertFileError(
            f"{url} cannot be fetched ({reason}): try again later, or give a folder that holds "
            f"{file.path.name} with 'manicm-ms experts fetch --from FOLDER'"
        ) from error
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise ExpertFileError(f"{url} has the SHA-256 {found[:16]}... where {sha256[:16]}... is expected: not taken")
    return content


def _licence_in(file: ExpertFile, folder: Path) -> bytes:
    path = folder / _LICENCE
    if not path.is_file():
        raise ExpertFileError(f"{folder} lacks {_LICENCE}: the weights go with their licence ({file.licence})")
    content = path.read_bytes()
    if hashlib.sha256(content).hexdigest() != file.licence_sha256:
        raise ExpertFileError(f"{path} is not the licence of {file.name} ({file.licence}): put that one there")
    return content


def _keep(file: ExpertFile, arrays: Arrays, licence: bytes) -> None:
    packed = BytesIO()
    np.savez(packed, **arrays)  # type: ignore[arg-type]
    folder = file.path.parent
    write_bytes(folder / _LICENCE, licence)
    write_text(
        folder / f"{file.path.stem}.SOURCE.txt",
        f"{file.credit}\n{file.url}\nSHA-256 of the source: {file.sha256}\nLicence: {file.licence}, see {_LICENCE}\n"
        "Changed: the mean network's weights and its scalings were copied into plain arrays, the rest left out.\n",
    )
    write_bytes(file.path, packed.getvalue())  # last: where it is, the others are
