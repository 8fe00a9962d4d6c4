"""What `manicm-ms convert` does with its two directions."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from manicm_ms.demos.convert import EXPORTERS, IMPORTERS, convert, import_store
from manicm_ms.errors import ConfigError
from manicm_ms.wording import counted


def convert_or_import(
    store: Path, out: Path, to: str | None, source: str | None, writing: Mapping[str, Any], reading: Mapping[str, Any]
) -> None:
    """Convert `store` to the format `to`, or read it from the format `source`, and print what came of it.

    Args:
        store: what to convert.
        out: the folder to make.
        to: format to write, or None.
        source: format to read, or None.
        writing: options that only go with `to`, None where not given.
        reading: options that only go with `source`, None where not given.

    Raises ConfigError where not exactly one direction is named or an option belongs to the other one.
    """
    if (to is None) == (source is None):
        raise ConfigError(
            f"say one of --to {{{','.join(EXPORTERS.names())}}} and --from {{{','.join(IMPORTERS.names())}}}"
        )
    other, direction = (reading, "--from") if to is not None else (writing, "--to")
    if strange := [name for name, value in other.items() if value is not None]:
        raise ConfigError(f"--{strange[0].replace('_', '-')} goes with {direction}: drop it")
    if to is not None:
        done = convert(store, to, out, **writing)
    else:
        from manicm_ms.cli.options import this_command

        options = {name: value for name, value in reading.items() if value is not None}
        done = import_store(store, str(source), out, command=this_command(), **options)
    print(f"{done.path}: {counted(done.episodes, 'episode')}, {counted(done.frames, 'frame')}")
    for note in done.notes:
        print(f"  {note}")
