"""Report of measured areas: the record, and its tables in Markdown."""

from __future__ import annotations

from collections import Counter
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, Field

from vehanchor_evaluation.area_errors import AreaErrors
from vehanchor_evaluation.report import markdown_table, percent, write_issues, write_results
from vehanchor_evaluation.result_record import ResultRecord

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from vehanchor_evaluation.areas import AreaSet
    from vehanchor_evaluation.known_scale import FileIssue


class AreaReport(ResultRecord):
    """Results of a run and their basis."""

    vehanchor: str = Field(description="Version of the library.")
    data: str = Field(description="Folder of the objects.")
    data_sha256: str = Field(description="SHA-256 of its index.")
    available: dict[str, int] = Field(description="Objects by category.")
    run: dict[str, Any] = Field(description="Models and options.")
    rows: tuple[AreaErrors, ...]
    facts: tuple[str, ...] = Field(description="Further facts, one sentence each.")
    left_out: dict[str, int] = Field(
        description="Files and entries that could not be measured, by reason."
    )


def area_report(
    data: AreaSet,
    run: Mapping[str, Any],
    rows: Sequence[AreaErrors],
    facts: Sequence[str],
    issues: Sequence[FileIssue],
) -> AreaReport:
    """Create a report."""
    available = Counter(entry.category for entry in data.entries)
    left_out = Counter(issue.reason for issue in issues)
    return AreaReport(
        vehanchor=version("vehanchor"),
        data=str(data.source),
        data_sha256=data.sha256,
        available=dict(sorted(available.items())),
        run=dict(run),
        rows=tuple(rows),
        facts=tuple(facts),
        left_out=dict(left_out),
    )


def area_markdown(report: AreaReport) -> str:
    """Format the table, the medians by category, and their basis."""
    headings = (
        "area",
        "entries",
        "answered",
        "median",
        "mean",
        "< 10 %",
        "< 25 %",
        "< 50 %",
        "< 100 %",
        "catastrophic",
        "polarisation",
    )
    cells = [_cells(row) for row in report.rows]
    tables = markdown_table(headings, cells)
    categories = _categories(report.rows)
    if categories:
        category_headings = ("median error (entries)", *categories)
        medians = [_median_cells(row, categories) for row in report.rows]
        tables += "\n" + markdown_table(category_headings, medians)
    facts = "".join(f"- {fact}\n" for fact in report.facts)
    return f"{tables}\n{facts}"


def _cells(row: AreaErrors) -> tuple[str, ...]:
    polarisation = "-"
    if row.polarisation is not None:
        polarisation = f"{row.polarisation:.1f}x"
    return (
        row.name,
        str(row.entries),
        str(row.answered),
        percent(row.median),
        percent(row.mean),
        percent(row.below_10),
        percent(row.below_25),
        percent(row.below_50),
        percent(row.below_100),
        percent(row.catastrophic),
        polarisation,
    )


def _categories(rows: Sequence[AreaErrors]) -> list[str]:
    """List the categories of all rows, which can differ because rows can lack entries."""
    categories: set[str] = set()
    for row in rows:
        categories.update(row.categories)
    return sorted(categories)


def _median_cells(row: AreaErrors, categories: Sequence[str]) -> tuple[str, ...]:
    medians = [_median(row, category) for category in categories]
    return (row.name, *medians)


def _median(row: AreaErrors, category: str) -> str:
    errors = row.categories.get(category)
    if errors is None:
        return "-"
    return f"{percent(errors.median)} ({errors.entries})"


def write_area_report(
    folder: Path,
    stem: str,
    report: AreaReport,
    records: Sequence[BaseModel],
    issues: Sequence[FileIssue],
) -> list[Path]:
    """Write the report as JSON and Markdown, the entries as CSV, and the issues as CSV.

    Args:
        folder: created if it does not exist.
        stem: stem of the file names.
        report: the results.
        records: one record per entry.
        issues: files and entries that were left out.

    Returns:
        The written files.

    Raises:
        OutputError: a file cannot be written.
    """
    rows = [record.model_dump(mode="json") for record in records]
    markdown = area_markdown(report)
    files = write_results(folder, stem, record=report, rows=rows, markdown=markdown)
    left_out = write_issues(folder / f"{stem}_left_out.csv", issues)
    return [*files, left_out]
