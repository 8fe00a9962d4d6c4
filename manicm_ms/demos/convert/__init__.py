"""Demonstrations for other people's tools, and theirs for ours: one file a format, `base` below them all."""

from manicm_ms.demos.convert.base import EXPORTERS, IMPORTERS, Converted, convert, import_store

__all__ = ["EXPORTERS", "IMPORTERS", "Converted", "convert", "import_store"]
