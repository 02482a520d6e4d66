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
from vehanchor.errors import PromptError
from vehanchor.export.geojson import SUFFIXES, check_geojson_path, write_features
from vehanchor.imagery.sources.files import canonical_path, find_images
from vehanchor.measure.targets import TARGET_COLUMNS, TargetRow, measure_targets, read_targets
from vehanchor.records.text import count

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from vehanchor.engine import Engine

_SHOWN_ERRORS = 10


def measure_table(
    inputs: Sequence[str],
    table: Path,
    output: Path,
    engine: Engine,
    tell: Callable[[int, int], None],
) -> None:
    """Measure the targets of a table, write their results, and print a summary on stderr.

    Each image is searched once for all its targets.

    Args:
        inputs: directories, patterns and files; the targets lie in these images.
        table: CSV of targets; see ``read_targets``.
        output: a table, or the outlines and lines with their sizes as GeoJSON.
        engine: models and options of the measurements.
        tell: called with the numbers of measured and of all images.

    Raises:
        PromptError: the table is invalid, or a target lies in another image.
        OutputError: the file cannot be written.
        ImageNotFoundError: as ``find_images``.
    """
    as_geojson = output.suffix.lower() in SUFFIXES
    if as_geojson:
        check_geojson_path(output)
    else:
        check_table_path(output)
    targets_by_image = read_targets(table)
    _check_images(targets_by_image, find_images(inputs))

    detector = checked_detector(engine.detector, engine.options)
    segmenter = engine.segmenter
    n_images = len(targets_by_image)
    rows: list[TargetRow] = []
    for n_measured, (image, targets) in enumerate(targets_by_image.items()):
        tell(n_measured, n_images)
        rows += measure_targets(
            image, targets, detector=detector, segmenter=segmenter, options=engine.options
        )
    tell(n_images, n_images)

    if as_geojson:
        _write_geojson(output, rows)
    else:
        flat_rows = [row.flat() for row in rows]
        write_table(output, flat_rows, TARGET_COLUMNS)
    _print_summary(output, rows)
    if all(row.error is not None for row in rows):
        print("no target could be measured", file=sys.stderr)
        raise typer.Exit(FAILED)


def _check_images(targets_by_image: Iterable[str], images: Iterable[str]) -> None:
    """Check that all targets lie in the images of the command."""
    measured = {canonical_path(image) for image in images}
    unknown = sorted(set(targets_by_image) - measured)
    if unknown:
        raise PromptError(
            f"a target is in {unknown[0]!r}, which is not one of the images: files are named "
            "relative to the table"
        )


def _write_geojson(output: Path, rows: Iterable[TargetRow]) -> None:
    features = []
    for row in rows:
        feature = row.feature()
        if feature is not None:
            features.append((feature, row.ground))
    write_features(output, features)


def _print_summary(output: Path, rows: Sequence[TargetRow]) -> None:
    """Print the first errors, and the numbers of targets by status."""
    statuses: Counter[str] = Counter()
    n_errors = 0
    for row in rows:
        status = "error" if row.record is None else row.record.status
        statuses[status] += 1
        if row.error is None:
            continue
        n_errors += 1
        if n_errors <= _SHOWN_ERRORS:
            name = f"{row.target.file} {row.target.name}".strip()
            report(row.error, name)
    file = printable(str(output))
    targets = count(len(rows), "target")
    print(f"wrote {file}: {targets} ({counts_text(statuses)})", file=sys.stderr)
