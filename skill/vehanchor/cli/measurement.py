"""Common course of ``vehanchor measure`` and ``vehanchor distance``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vehanchor.cli.outputs import check_outputs, write_outputs
from vehanchor.cli.terminal import (
    STATUS_TEXTS,
    contradiction_fact,
    exit_strictly,
    failures_as_json,
    print_facts,
    print_json,
    print_warnings,
    print_written,
    printable,
    vehicles_text,
    work_progress,
)
from vehanchor.records.text import file_scale_text, file_source_text, scale_text

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from vehanchor.analysis.measurement_analysis import AreaAnalysis
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
        measure: makes the analysis from a callback for the progress of the search; several areas
            of one image as an ``AreaCollection``.
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
    analyses = getattr(analysis, "analyses", (analysis,))
    records = [part.measurement for part in analyses]
    if as_json:
        dumped = [record.model_dump(mode="json") for record in records]
        fields = dumped[0] if len(records) == 1 else {"measurements": dumped}
        print_json({"photograph": image, **fields})
    elif len(records) == 1:
        record = records[0]
        status = ("status", record.status)
        print_facts(
            image, [*contradiction_fact(record), *facts(record), *_scale_facts(record), status]
        )
        print_warnings(record.warnings)
    else:
        _print_several(image, analyses, facts)
    written, _ = write_outputs(analysis, outputs)
    print_written(written)
    exit_strictly(strict, [record.status for record in records])


def _print_several(
    image: str, analyses: Sequence[AreaAnalysis], facts: Callable[[Any], Facts]
) -> None:
    """Print several areas of an image, then their common scale."""
    for _, text in contradiction_fact(analyses[0].measurement):
        print(printable(text))
    for number, analysis in enumerate(analyses, 1):
        record = analysis.measurement
        title = f"{number}: {analysis.name}" if analysis.name else f"{number}"
        print_facts(title, [*facts(record), ("status", record.status)])
    print_facts(image, _scale_facts(analyses[0].measurement))
    warnings = [warning for analysis in analyses for warning in analysis.measurement.warnings]
    # Warnings about the scale are the same for all.
    print_warnings(tuple(dict.fromkeys(warnings)))


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
        source: str = record.scale_source
        if source == "file":
            source = f"the file's own, {file_source_text(record)}"
        facts = [("scale", f"{record.gsd_m_per_px:.4g} m/px, {source}")]
    if record.scale_confidence is not None:
        text = f"{record.scale_confidence:.2f}   {STATUS_TEXTS[status]}"
        facts.append(("scale confidence", text))
    file_scale = file_scale_text(record)
    if file_scale:
        facts.append(("file's own scale", file_scale))
    return facts
