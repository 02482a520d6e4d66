"""Formats of vector files, one line each; help, checks and messages derive from it."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import OutputError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vehanchor.export.layer import Layer


class VectorFormat(NamedTuple):
    """Format of boxes, outlines and lines.

    Attributes:
        writer: function ``(path, layers)`` as ``module:function``; imported on first use.
        has_lines: whether it can store lines.
        note: what a reader of the help should know, or an empty string.
    """

    writer: str
    has_lines: bool = True
    note: str = ""

    def write(self, path: Path, layers: Sequence[Layer]) -> None:
        """Write layers, on the ground if their images are georeferenced and the format can say so."""
        module, _, name = self.writer.partition(":")
        writer: Callable[[Path, Sequence[Layer]], None] = getattr(import_module(module), name)
        writer(path, layers)


VECTOR_FORMATS: dict[str, VectorFormat] = {
    ".geojson": VectorFormat("vehanchor.export.geojson:write_geojson"),
    ".gpkg": VectorFormat("vehanchor.export.geopackage:write_geopackage"),
    ".txt": VectorFormat("vehanchor.export.dota:write_dota", has_lines=False, note="DOTA, in pixels"),
}
"""Format of a vector file by its suffix."""


def vector_suffixes(*, lines: bool = False) -> tuple[str, ...]:
    """List the suffixes of all formats, or of those that can store lines."""
    return tuple(suffix for suffix, format_ in VECTOR_FORMATS.items() if format_.has_lines or not lines)


def vectors_help(*, lines: bool = False) -> str:
    """Make the help's list of formats: ``.geojson, .gpkg, .txt (DOTA, in pixels)``."""
    notes = ((suffix, VECTOR_FORMATS[suffix].note) for suffix in vector_suffixes(lines=lines))
    return ", ".join(f"{suffix} ({note})" if note else suffix for suffix, note in notes)


def check_vector_path(path: str | Path, *, lines: bool = False) -> Path:
    """Check, before the work, that boxes or outlines, or ``lines``, can be written to a path.

    Raises:
        OutputError: no such format has the suffix, or the folder does not exist.
    """
    target, suffixes = Path(path), vector_suffixes(lines=lines)
    if target.suffix.lower() not in suffixes:
        what = "lines" if lines else "boxes"
        raise OutputError(f"cannot write {what} as {str(path)!r}: use one of the suffixes {', '.join(suffixes)}")
    if not target.parent.is_dir() or target.is_dir():
        raise OutputError(f"cannot write {str(path)!r}: name a file in a folder that exists")
    return target
