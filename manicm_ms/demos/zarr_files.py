"""What lies in the folder of a zarr store: its arrays, opened without a pickle, and the chunk files that are missing.

zarr leaves out the file of a chunk that holds only the fill value, unless told to write it, and reads a lost file as
the fill value too: from outside the two look the same. A store of ours that carries `ALL_WRITTEN` has every file, so
one that is missing was lost; of other stores the missing files are counted and named.
"""

from __future__ import annotations

import itertools
import json
import os
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import zarr

from manicm_ms.errors import StoreError
from manicm_ms.wording import counted

EPISODE_ENDS = "meta/episode_ends"
HEADERS = {2: ".zarray", 3: "zarr.json"}
"""zarr format -> the file that describes an array."""
ALL_WRITTEN = {"chunks": "all written"}
"""Attribute of a store whose every chunk has a file."""
_MOST_NAMED = 3


def require_folder(path: Path, remedy: str) -> None:
    """Raise StoreError unless a folder stands at `path`; the line says what stands there and what to do.

    Args:
        path: where a store should be.
        remedy: what to try where there is nothing, or a folder that is no store.
    """
    if path.is_dir():
        return
    if not path.exists():
        raise StoreError(f"no store at {path}: {remedy}")
    if zipfile.is_zipfile(path):
        folder = path.with_suffix("")
        raise StoreError(f"{path} is a zip file: unzip it ('python -m zipfile -e {path} {folder}') and name the folder")
    raise StoreError(f"{path} is a file where a store, which is a folder, is wanted: name another path")


def array_names(path: Path) -> tuple[str, ...]:
    """Return the arrays of the store at `path`, of either zarr format, as in "data/action", sorted."""
    found: list[str] = []
    for folder, below, files in os.walk(path):
        if HEADERS[2] in files or (HEADERS[3] in files and _header(Path(folder)).get("node_type") == "array"):
            found.append(Path(folder).relative_to(path).as_posix())
            below.clear()  # chunks alone lie deeper
    return tuple(sorted(found))


def looks_like_dp3(path: Path) -> bool:
    """Return whether the arrays at `path` are named as DP3 and diffusion_policy name theirs, and not as ours are."""
    names = array_names(path)
    return EPISODE_ENDS in names and "meta/success" not in names and any(name.startswith("data/") for name in names)


def open_array(path: Path, name: str) -> zarr.Array:
    """Open an array of the store at `path` for reading.

    Raises StoreError where it cannot be opened, for example because its codec is not installed, or would be unpickled.
    """
    refuse_pickles(path, name)
    try:
        return zarr.open_array(str(path / name), mode="r")
    except Exception as error:  # zarr, numcodecs and json raise many kinds on what they do not know or what is damaged
        raise StoreError(
            f"{path} cannot be read: {name} is damaged, or coded by what is not installed ({one_line(error)})"
        ) from error


def refuse_pickles(path: Path, name: str) -> None:
    """Raise StoreError where reading the array would unpickle: numcodecs would, without asking."""
    header = _header(path / name)
    coding = [header.get(key) for key in ("filters", "compressor", "codecs")]
    if pickled := sorted(codec for codec in _codecs(coding) if "pickle" in codec.lower()):
        raise StoreError(
            f"{path}: {name} is coded by {pickled[0]!r}, and nothing is unpickled here: write plain numbers"
        )


def describe(name: str, path: Path) -> str:
    """Return shape and type of an array as its header says them, as in "data/stage (60,) int64"; opens nothing."""
    header = _header(path / name)
    shape, kind = header.get("shape"), header.get("dtype", header.get("data_type"))
    return f"{name} {tuple(shape) if isinstance(shape, list) else '?'} {kind if isinstance(kind, str) else '?'}"


def missing_chunks(path: Path, name: str, array: zarr.Array, rows: int) -> list[str]:
    """Return the chunk files (of a sharded array: shard files) that are not there, as in "data/img/0.0.0.0".

    Args:
        path: the store.
        name: of the array in it.
        array: the array, opened.
        rows: rows that count: what lies behind them may have been allocated ahead and never written.
    """
    chunk = array.shards or array.chunks
    shape = (min(rows, array.shape[0]), *array.shape[1:])
    counts = [range(-(-size // max(step, 1))) for size, step in zip(shape, chunk, strict=True)]
    there = _files(path / name)
    keys = (array.metadata.encode_chunk_key(place) for place in itertools.product(*counts))
    return [f"{name}/{key}" for key in keys if key not in there]


def say_missing(names: Sequence[str]) -> str:
    """Return, for example, "3 chunk files are missing: data/img/0.0.0.0, data/img/1.0.0.0, data/img/2.0.0.0"."""
    shown = ", ".join(names[:_MOST_NAMED])
    rest = f" and {len(names) - _MOST_NAMED} more" if len(names) > _MOST_NAMED else ""
    return f"{counted(len(names), 'chunk file')} {'is' if len(names) == 1 else 'are'} missing: {shown}{rest}"


def remark_missing(names: Sequence[str]) -> list[str]:
    """Return what to say of missing files in a store that may have left them out, in no or one line."""
    if not names:
        return []
    return [f"{say_missing(names)}; zarr fills in zeros, which is right only where all the data was zero"]


def one_line(error: BaseException) -> str:
    """Return what an error of another library says, shortened to a part of a line."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:200]


def _header(folder: Path) -> dict[str, Any]:
    """Return the header of an array or group, empty where there is none that can be read."""
    for name in (HEADERS[3], HEADERS[2]):
        try:
            header = json.loads((folder / name).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            continue
        if isinstance(header, dict):
            return header
    return {}


def _codecs(coding: Any) -> set[str]:
    """Return every codec that the entries of a header name, of either format, within shards too."""
    if isinstance(coding, dict):
        own = {str(coding[key]) for key in ("id", "name") if isinstance(coding.get(key), str)}
        return own.union(*(_codecs(value) for value in coding.values()))
    if isinstance(coding, list):
        return set().union(*(_codecs(value) for value in coding))
    return set()


def _files(folder: Path) -> set[str]:
    """Return the files below `folder`, by their paths from it."""
    found: set[str] = set()
    for place, _, files in os.walk(folder):
        inner = os.path.relpath(place, folder)
        found.update(files if inner == "." else (f"{inner}/{file}" for file in files))
    return found
