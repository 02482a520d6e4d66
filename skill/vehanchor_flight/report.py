"""Report of a flight: one self-contained HTML page with track, components, photographs and dropped overlaps."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.imagery.names import under_one_folder
from vehanchor.records.digits import significant
from vehanchor.storage.atomic import whole_file
from vehanchor_flight.track import draw_tracks

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from vehanchor_flight.records import FlightEstimate, FlightPhotograph, FlightRuler

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 68rem; padding: 0 1rem; color: #1b1b1b }
h1 { font-size: 1.5rem } h2 { font-size: 1.15rem; margin-top: 2rem }
svg { width: 100%; background: #fafafa; border: 1px solid #ddd; margin: .5rem 0 }
svg text { font: 12px system-ui, sans-serif; fill: #333 } svg .title { font-size: 14px; font-weight: 600 }
svg .name { font-size: 10.5px; paint-order: stroke; stroke: #fafafa; stroke-width: 3px }
svg .link { stroke: #bbb; stroke-width: 1 }
svg .dropped { stroke: #d55e00; stroke-width: 1.5; stroke-dasharray: 5 4 } svg .bar { stroke: #222; stroke-width: 4 }
table { border-collapse: collapse; width: 100% } th, td { text-align: left; padding: .25rem .6rem .25rem 0;
border-bottom: 1px solid #e3e3e3; vertical-align: top } td.number { text-align: right; white-space: nowrap }
td { overflow-wrap: anywhere } .bad { color: #b34700 }
"""


def write_report(path: Path, record: FlightEstimate) -> None:
    """Write the page.

    Raises:
        OutputError: the file cannot be written.
    """
    with whole_file(path) as partial:
        partial.write_text(report_page(record), encoding="utf-8", errors="backslashreplace")


def report_page(record: FlightEstimate) -> str:
    """Make the page, without scripts and external resources."""
    dropped = [link for link in record.links if link.dropped]
    folder, names = under_one_folder([each.photograph for each in record.photographs])
    sections = [
        f"<h1>Flight of {len(record.photographs)} photographs</h1>",
        f"<p>{escape(_summary(record))}</p>",
        *([f"<p>In {escape(folder)}.</p>"] if folder else []),
        draw_tracks(record) or "<p>No track: no photograph has a position.</p>",
    ]
    if record.warnings:
        sections.append("<h2>Warnings</h2>" + _list(f"{each.code}: {each.message}" for each in record.warnings))
    if dropped:
        named = (f"{each.first} and {each.second}: {each.dropped}" for each in dropped)
        sections.append(f"<h2>Dropped overlaps</h2>{_list(named)}")
    short = {each.photograph: name for each, name in zip(record.photographs, names, strict=True)}
    sections.append(_components(record, short))
    sections.append(_photographs(record.photographs, short))
    sections.append(f"<p>Detector {escape(record.model)}, {escape(record.model_sha256[:12])}.</p>")
    body = "\n".join(sections)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Flight</title>'
        f"<style>{_STYLE}</style></head>\n<body>\n{body}\n</body></html>\n"
    )


def _summary(record: FlightEstimate) -> str:
    said = (
        "One scale for all photographs, as stated by the caller"
        if record.same_scale
        else (f"{len(record.components)} components" if len(record.components) > 1 else "All photographs are linked")
    )
    if record.same_scale and record.gsd_m_per_px is not None:
        said += f": {_scale(record.gsd_m_per_px, record.gsd_ci95_low_m_per_px, record.gsd_ci95_high_m_per_px)}"
    return f"{said}. {record.n_vehicles} vehicles, confidence {record.confidence:.2f}, {record.status}."


def _components(record: FlightEstimate, short: Mapping[str, str]) -> str:
    rows = []
    for component in record.components:
        pooled = component.pooled
        rulers = ", ".join(f"{each.kind} ({each.p_right:.2f})" for each in pooled.rulers if each.sets_scale)
        scale = _scale(pooled.gsd_m_per_px, pooled.gsd_ci95_low_m_per_px, pooled.gsd_ci95_high_m_per_px)
        rows.append(
            (
                str(component.number),
                str(component.n_photographs),
                short[component.reference],
                scale,
                rulers,
                _status(pooled.status, component.advice),
            )
        )
    heads = ("component", "photographs", "reference", "scale of the reference", "rulers", "status")
    return f"<h2>Components</h2>{_table(heads, rows)}"


def _photographs(photographs: Sequence[FlightPhotograph], short: Mapping[str, str]) -> str:
    rows = [
        (
            short[each.photograph],
            _scale(each.gsd_m_per_px, each.gsd_ci95_low_m_per_px, each.gsd_ci95_high_m_per_px),
            "-" if each.confidence is None else f"{each.confidence:.2f}",
            "-" if each.component is None else str(each.component),
            "; ".join(_ruler(ruler, each) for ruler in each.supported_by) or "-",
            _status(each.status, each.advice) if each.error is None else f"{each.error_code}: {each.error}",
        )
        for each in photographs
    ]
    heads = ("photograph", "scale", "confidence", "component", "supported by", "status")
    return f"<h2>Photographs</h2>{_table(heads, rows)}"


def _status(status: str, advice: str | None) -> str:
    return status if advice is None else f"{status}: {advice}"


def _ruler(ruler: FlightRuler, of: FlightPhotograph) -> str:
    if ruler.photograph == of.photograph:
        return f"its own {ruler.ruler}"
    through = f" through {', '.join(Path(each).name for each in ruler.through)}" if ruler.through else ""
    return f"{ruler.ruler} of {Path(ruler.photograph).name}{through}"


def _scale(gsd: float | None, low: float | None, high: float | None) -> str:
    if gsd is None:
        return "none"
    return f"{significant(gsd, 4)} m/px" + (
        f" ({significant(low, 4)} to {significant(high, 4)})" if low and high else ""
    )


def _list(lines: Iterable[str]) -> str:
    return "<ul>" + "".join(f"<li>{escape(line)}</li>" for line in lines) + "</ul>"


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(each)}</th>" for each in heads)
    body = "".join("<tr>" + "".join(f"<td>{escape(each)}</td>" for each in row) + "</tr>" for row in rows)
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"
