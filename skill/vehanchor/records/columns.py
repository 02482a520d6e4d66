"""Columns of a table with a row for each photograph."""

from __future__ import annotations

from vehanchor.records.flat import flat_columns
from vehanchor.records.gsd_estimate import GsdEstimate

NOT_IN_TABLES = ("frame",)
"""Fields of an estimate that a table leaves out: a frame belongs to one image."""

_ONLY_WITH_DETAILS = ("rulers", "tilt", "scale", "details")
_ADDED_COLUMNS = {"contradiction": str, "error_code": str, "error": str}

COLUMNS: dict[str, type] = {
    "photograph": str,
    **flat_columns(GsdEstimate, without=(*NOT_IN_TABLES, *_ONLY_WITH_DETAILS)),
    "tilt_deg": float,
    **_ADDED_COLUMNS,
}
"""Columns of a table and the types of their values, in order; see ``vehanchor.records.flat``."""

ALL_COLUMNS: dict[str, type] = {
    "photograph": str,
    **flat_columns(GsdEstimate, without=NOT_IN_TABLES),
    **_ADDED_COLUMNS,
}
"""Columns of a table with details."""
