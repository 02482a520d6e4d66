"""``vehanchor batch --measure``: objects and lines of a table."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from vehanchor.analysis.pipeline import checked_detector
from vehanchor.batch.table import check_table_path, write_table
from vehanchor.cli.terminal import FAILED, counts_text, printable, report
from vehanchor.errors import OutputError, PromptError
from vehanchor.export.geojson import SUFFIX, check_geojson_path, write_features
from vehanchor.imagery.sources.files import canonical_path, find_images
from vehanchor.measure.targets import TARGET_COLUMNS, TargetRow, measure_targets, read_targets
from vehanchor.records.text import count

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vehanchor.engine import Engine

_SHOWN_ERRORS = 10


def measure_table(
    inputs: Sequence[str],
    table: Path,
    output: Path,
    engine: Engine,
    tell: Callable[[int, int], None],
    *,
    overwrite: bool,
) -> None:
    """Measure the targets of a table with one search per image; write their results, and a summary on stderr.

    Args:
        inputs: directories, patterns and files; the targets lie in these images.
        table: CSV of targets; see ``read_targets``.
        output: a table, or the outlines and lines with their sizes as GeoJSON.
        engine: its models and options.
        tell: receives the number of measured images and of all images.
        overwrite: replace an existing file.

    Raises:
        PromptError: the table is invalid, or a target lies in another image.
        OutputError: the file exists, or cannot be written.
        ImageNotFoundError: as ``find_images``.
    """
    as_shapes = output.suffix.lower() == SUFFIX
    (check_geojson_path if as_shapes else check_table_path)(output)
    if output.exists() and not overwrite:
        raise OutputError(f"{str(output)!r} exists: name another file, or pass --overwrite")
    wanted = read_targets(table)
    images = find_images(inputs)
    strangers = sorted(set(wanted) - {canonical_path(image) for image in images})
    if strangers:
        raise PromptError(
            f"a target is in {strangers[0]!r}, which is not one of the images: files are named "
            "relative to the table"
        )
    options = engine.options
    rows = []
    detector = checked_detector(engine.detector, options)
    segmenter = engine.segmenter
    for number, (image, targets) in enumerate(wanted.items()):
        tell(number, len(wanted))
        rows += measure_targets(
            image, targets, detector=detector, segmenter=segmenter, options=options
        )
    tell(len(wanted), len(wanted))
    if as_shapes:
        placed = [(feature, row.ground) for row in rows if (feature := row.feature()) is not None]
        write_features(output, placed)
    else:
        write_table(output, (row.flat() for row in rows), TARGET_COLUMNS)
    _summarise(output, rows)


def _summarise(output: Path, rows: Sequence[TargetRow]) -> None:
    """Print the first errors and the numbers by status; fail if nothing was measured."""
    errors = [(row.target, row.error) for row in rows if row.error is not None]
    for target, error in errors[:_SHOWN_ERRORS]:
        report(error, f"{target.file} {target.name}".strip())
    counts = Counter("error" if row.record is None else row.record.status for row in rows)
    print(
        f"{printable(str(output))}: {count(len(rows), 'target')} ({counts_text(counts)})",
        file=sys.stderr,
    )
    if len(errors) == len(rows):
        print("no target could be measured", file=sys.stderr)
        raise typer.Exit(FAILED)
