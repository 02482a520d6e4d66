"""Common course of ``vehanchor measure`` and ``vehanchor distance``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vehanchor.cli.outputs import check_outputs, write_outputs
from vehanchor.cli.terminal import (
    STATUS_TEXTS,
    exit_strictly,
    failures_as_json,
    print_facts,
    print_json,
    print_warnings,
    vehicles_text,
    work_progress,
)
from vehanchor.records.text import scale_text

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from vehanchor.cli.terminal import Facts
    from vehanchor.models.runtime import Progress
    from vehanchor.records import AreaMeasurement, DistanceMeasurement


def show_measurement(
    image: str,
    measure: Callable[[Progress], Any],
    facts: Callable[[Any], Facts],
    files: Mapping[str, Path | None],
    *,
    as_json: bool,
    strict: bool,
) -> None:
    """Measure, print the record, and write the files; an error ends the command.

    Args:
        image: the photograph.
        measure: makes the analysis from a callback for the progress of the search.
        facts: lists the facts of a record for people, without its scale.
        files: files by the names of their options; None for options that are not given.
        as_json: print one JSON object and nothing else.
        strict: exit with another status if the record is not ok.
    """
    outputs = {}
    for option, path in files.items():
        if path is not None:
            outputs[option] = path
    name = Path(image).name
    with failures_as_json([image], as_json):
        check_outputs([image], outputs.items())
        with work_progress("tiles", lines=as_json) as tell:
            analysis = measure(partial(tell, name=name))
    record = analysis.measurement
    if as_json:
        fields = record.model_dump(mode="json")
        print_json({"source": image, **fields})
    else:
        status = ("status", record.status)
        print_facts(image, [*facts(record), *_scale_facts(record), status])
        print_warnings(record.warnings)
    write_outputs(analysis, outputs)
    exit_strictly(strict, [record.status])


def _scale_facts(record: AreaMeasurement | DistanceMeasurement) -> Facts:
    """List the facts of the scale behind a measurement."""
    estimate = record.estimate
    if estimate is not None:
        status = estimate.status
        facts = [
            ("scale", scale_text(estimate)),
            ("vehicles", vehicles_text(estimate)),
        ]
    else:
        status = record.status
        facts = [("scale", f"{record.gsd_m_per_px:.4g} m/px, {record.scale_source}")]
    if record.scale_confidence is not None:
        text = f"{record.scale_confidence:.2f}   {STATUS_TEXTS[status]}"
        facts.append(("scale confidence", text))
    return facts
