"""Result files: JSON for programs, CSV for spreadsheets, Markdown for readers."""

from __future__ import annotations

import csv
import io
from typing import TYPE_CHECKING, TypeAlias

from vehanchor.errors import OutputError
from vehanchor.records.escaping import in_cell
from vehanchor.records.text import count
from vehanchor.scale.defaults import SHORT_SHA
from vehanchor.storage.atomic import whole_file
from vehanchor_evaluation.reliability import MIN_ESTIMATES

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from pydantic import BaseModel

    from vehanchor_evaluation.ablation import AblationReport
    from vehanchor_evaluation.gsd import ScaleBenchmark, ScaleReport, ScaleTrial
    from vehanchor_evaluation.known_scale import FileIssue
    from vehanchor_evaluation.reliability import GroupRow, ReliabilityReport

    Rows: TypeAlias = Sequence[Mapping[str, object]]
    """Rows of a table, all with the same keys."""

_LEGEND = """An error above 20 % is wrong; (<) is the 95 % upper bound of the wrong share.
error: median of usable images; of all estimates. interval: share of 95 %
intervals that hold the true scale, of usable images; of other estimates.
"""
# More reference lengths are reported as a range.
_MAX_LISTED_LENGTHS = 5


def percent(value: float | None, digits: int = 1, *, signed: bool = False) -> str:
    """Format a share as a percentage; a dash for None."""
    if value is None:
        return "-"
    sign = "+" if signed else ""
    return f"{value:{sign}.{digits}%}".replace("%", " %")


def markdown_table(
    headings: Sequence[str], rows: Iterable[Sequence[str]], *, aligned: bool = False
) -> str:
    """Format a table in Markdown; ``aligned`` pads the cells for terminals."""
    table = [list(headings), *map(list, rows)]
    widths = [0] * len(headings)
    rules = ["---"] * len(headings)
    if aligned:
        columns = zip(*table, strict=True)
        widths = [max(map(len, column)) for column in columns]
        rules = ["-" * max(3, width + 2) for width in widths]
    lines = []
    for cells in table:
        padded = [cell.ljust(width) for cell, width in zip(cells, widths, strict=True)]
        lines.append(f"| {' | '.join(padded)} |")
    # Markdown takes the first line as the heading only if a rule follows.
    rule = "|".join(rules)
    lines.insert(1, f"|{rule}|")
    return "\n".join(lines) + "\n"


def write_results(
    folder: Path, stem: str, record: BaseModel, rows: Rows, markdown: str
) -> list[Path]:
    """Write a result as ``<stem>.json``, its table as ``<stem>.csv``, and ``<stem>.md``.

    Args:
        folder: created if it does not exist.
        stem: stem of the file names.
        record: the whole result.
        rows: its table, all with the same keys.
        markdown: text for readers.

    Returns:
        The written files.

    Raises:
        OutputError: a file cannot be written.
    """
    json_text = record.model_dump_json(indent=2)
    return [
        _write(folder / f"{stem}.json", json_text + "\n"),
        write_table(folder / f"{stem}.csv", rows),
        _write(folder / f"{stem}.md", markdown),
    ]


def write_table(path: Path, rows: Rows, columns: Sequence[str] = ()) -> Path:
    """Write rows with the same keys as CSV; None becomes an empty cell.

    Args:
        path: path of the file; its folder is created if it does not exist.
        rows: the table.
        columns: keys of the rows, needed only if the table can be empty.

    Raises:
        OutputError: the file cannot be written.
    """
    fields = columns
    if rows:
        fields = list(rows[0])
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, fieldnames=fields, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        # A spreadsheet would run a text that begins like a formula.
        cells = {name: in_cell(value) for name, value in row.items()}
        writer.writerow(cells)
    return _write(path, text.getvalue())


def _write(path: Path, text: str) -> Path:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        problem = error.strerror or error
        raise OutputError(f"cannot write {str(path)!r}: {problem}") from error
    with whole_file(path) as partial:
        partial.write_text(text, encoding="utf-8", errors="backslashreplace")
    return path


def write_issues(path: Path, issues: Iterable[FileIssue]) -> Path:
    """Write the issues of files as CSV.

    Raises:
        OutputError: the file cannot be written.
    """
    rows = [
        {
            "file": str(issue.file),
            "reason": issue.reason,
            "skipped": str(issue.skipped).lower(),
            "message": issue.message,
        }
        for issue in issues
    ]
    return write_table(path, rows, ("file", "reason", "skipped", "message"))


def write_trials(path: Path, benchmark: ScaleBenchmark) -> Path:
    """Write one line per image as CSV: truth, estimate, error, confidence, and those from labels.

    Raises:
        OutputError: the file cannot be written.
    """
    labelled = {trial.image.path: trial for trial in benchmark.baseline}
    rows = []
    for trial in benchmark.trials:
        labelled_trial = labelled.get(trial.image.path)
        rows.append(_trial_row(trial, labelled_trial))
    return write_table(path, rows)


def _trial_row(trial: ScaleTrial, labelled: ScaleTrial | None) -> dict[str, object]:
    estimate = trial.analysis.estimate
    details = estimate.details
    return {
        "file": str(trial.image.path),
        "set": trial.image.set,
        "true_gsd_m_per_px": trial.image.gsd_m_per_px,
        "gsd_m_per_px": estimate.gsd_m_per_px,
        "signed_error": _signed_error(trial),
        "confidence": round(estimate.confidence, 4),
        "gsd_ci95_low_m_per_px": estimate.gsd_ci95_low_m_per_px,
        "gsd_ci95_high_m_per_px": estimate.gsd_ci95_high_m_per_px,
        "n_vehicles": estimate.n_vehicles,
        "n_detections": details.n_detections,
        "mode_length_px": estimate.mode_length_px,
        "resolution_guard": str(bool(details.resolution_guard)).lower(),
        "reference_length_m": details.reference_length_m,
        **_label_cells(labelled),
    }


def _label_cells(labelled: ScaleTrial | None) -> dict[str, object]:
    """List the cells of the estimate from labels, empty without labels."""
    if labelled is None:
        return {
            "labelled_vehicles": None,
            "labels_gsd_m_per_px": None,
            "labels_signed_error": None,
        }
    estimate = labelled.analysis.estimate
    return {
        "labelled_vehicles": estimate.details.n_detections,
        "labels_gsd_m_per_px": estimate.gsd_m_per_px,
        "labels_signed_error": _signed_error(labelled),
    }


def _signed_error(trial: ScaleTrial) -> float | None:
    """Return the signed error; None without an estimate, so that its cell stays empty."""
    if not trial.estimated:
        return None
    return trial.signed_error


# --- Texts


def scale_markdown(report: ScaleReport) -> str:
    """Format Table I with its basis."""
    rows = [
        (
            row.name,
            str(row.images),
            percent(row.median, 2),
            percent(row.mean, 2),
            percent(row.within_10),
            percent(row.within_20),
            percent(row.bias, 2, signed=True),
            f"{percent(row.coverage)} of {row.of_images}",
            percent(row.interval_coverage),
            f"{percent(row.usable_share)}, {row.usable_wrong} wrong",
        )
        for row in report.rows
    ]
    headings = (
        "boxes",
        "images",
        "median",
        "mean",
        "< 10 %",
        "< 20 %",
        "bias",
        "estimate on",
        "95 % interval holds",
        "may be used",
    )
    table = markdown_table(headings, rows)
    basis = "Errors cover images with an estimate; an error above 20 % is wrong."
    facts = "".join(f"- {fact}\n" for fact in _scale_facts(report))
    return f"{_title(report)}. {basis}\n\n{table}\n{facts}"


def _title(report: ScaleReport | AblationReport) -> str:
    sha = report.detector_sha256[:SHORT_SHA]
    return f"Detector `{report.detector}` ({sha}) on `{report.data}`"


def _scale_facts(report: ScaleReport) -> list[str]:
    """Describe the basis of Table I, one sentence each."""
    lengths_m = report.reference_length_m
    lengths = ", ".join(f"{length:.4g}" for length in lengths_m) or "-"
    if len(lengths_m) > _MAX_LISTED_LENGTHS:
        lengths = f"{lengths_m[0]:.4g} to {lengths_m[-1]:.4g}"
    reference_length = f"Reference length in use: {lengths} m"
    if report.label_reference_length_m is not None:
        mode = f"{report.label_reference_length_m:.4g} m"
        reference_length += f"; KDE mode of these labels: {mode}"
    not_found = count(report.no_vehicle_found, "image")
    pearson = _correlation(report.confidence_error_pearson)
    spearman = _correlation(report.confidence_error_spearman)
    return [
        reference_length,
        f"No estimate, as no vehicle was found: {not_found}; "
        f"images with labels but no labelled vehicle: {report.no_vehicle_labelled}",
        f"Skipped: {_counts(report.skipped)}; used in part: {_counts(report.noted)}",
        f"Confidence against error: Pearson {pearson}, Spearman {spearman}",
        f"Errors above 20 %: {report.high_errors}; the resolution guard flags "
        f"{report.high_errors_guarded} of them, "
        f"the status flags {report.high_errors_low_confidence}. Other errors: {report.low_errors}, "
        f"flagged {report.low_errors_guarded} and {report.low_errors_low_confidence}",
    ]


def ablation_markdown(report: AblationReport) -> str:
    """Format Table III with the paper's numbers."""
    rows = [
        (
            row.choice,
            row.setting,
            row.boxes,
            str(row.errors.images),
            percent(row.errors.median, 2),
            percent(row.errors.mean, 2),
            percent(row.errors.within_20),
            percent(row.paper_median, 2),
            percent(row.paper_within_20),
        )
        for row in report.rows
    ]
    headings = (
        "choice",
        "setting",
        "boxes",
        "images",
        "median",
        "mean",
        "< 20 %",
        "paper: median",
        "paper: < 20 %",
    )
    table = markdown_table(headings, rows)
    return f"{_title(report)}. Errors cover images with an estimate.\n\n{table}"


def reliability_markdown(report: ReliabilityReport) -> str:
    """Format the reliability in tables of at most 80 columns."""
    rows = [
        (
            f"{row.low:.2f} to {row.high:.2f}",
            str(row.images),
            _chance(row.stated),
            _chance(row.happened),
        )
        for row in report.chances
    ]
    headings = ("stated chance", "images", "mean", "outcome")
    chances = markdown_table(headings, rows, aligned=True)
    by_vehicles = group_table("vehicles", (*report.by_vehicles, report.whole))
    by_resolution = group_table("true m/px", report.by_resolution)
    return (
        f"Detector `{report.detector}` on `{report.data}`.\n\n"
        f"{_LEGEND}\n{chances}\n{by_vehicles}\n{by_resolution}\n{_threshold(report)}\n"
    )


def _chance(chance: float | None) -> str:
    if chance is None:
        return "-"
    return f"{chance:.3f}"


def group_table(heading: str, rows: Iterable[GroupRow]) -> str:
    """Format groups as a table in Markdown, aligned for terminals; see ``_LEGEND``."""
    headings = (heading, "images", "ok", "wrong (<)", "error", "interval")
    cells = []
    for row in rows:
        wrong = "-"
        if row.wrong_bound is not None:
            wrong = f"{row.wrong} ({percent(row.wrong_bound)})"
        interval_usable = percent(row.interval_usable, digits=0)
        interval_others = percent(row.interval_others, digits=0)
        cells.append(
            (
                row.name,
                str(row.images),
                percent(row.usable_share, digits=0),
                wrong,
                f"{percent(row.median_usable)}; {percent(row.median)}",
                f"{interval_usable}; {interval_others}",
            )
        )
    return markdown_table(headings, cells, aligned=True)


def _threshold(report: ReliabilityReport) -> str:
    """State which limit of the confidence gives 1 % wrong, or that there are too few images."""
    if report.threshold is None:
        return (
            f"No limit of the confidence leaves 1 % wrong and {MIN_ESTIMATES} estimates of "
            f"{report.whole.estimates}.\nWith 0 wrong, 300 estimates show a share below 1 %."
        )
    return (
        f"From a confidence of {report.threshold:.3f} on, at most 1 % are wrong: "
        f"{report.threshold_wrong} of "
        f"{report.threshold_images}\n(95 % upper bound {percent(report.threshold_bound)})."
    )


def _correlation(value: float | None) -> str:
    if value is None:
        return "not defined"
    return f"{value:+.3f}"


def _counts(counts: Mapping[str, int]) -> str:
    parts = [f"{number} {reason}" for reason, number in counts.items()]
    return ", ".join(parts) or "none"
