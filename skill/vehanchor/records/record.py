"""Base class of all records, and the version of their schema."""

from __future__ import annotations

from html import escape
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from vehanchor.errors import MissingExtraError

SCHEMA_VERSION: Literal[4] = 4
"""Version of all fields; it rises when a field is renamed, removed or redefined."""

SchemaVersion = Annotated[
    Literal[4], Field(description="Version of this schema; others are refused.")
]

_SHOWN_FLOAT_DIGITS = 4
# types with a missing value
_FRAME_TYPES = {float: "float64", int: "Int64", bool: "boolean", str: "string"}


class Record(BaseModel):
    """Frozen record: numbers are finite or null; names have units."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def to_frame(self) -> Any:
        """Make a pandas table of one row.

        Returns:
            A ``DataFrame`` with the columns of the record's type; see ``vehanchor.records.flat``.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError:
            raise MissingExtraError("to_frame needs pandas: pip install pandas") from None
        from vehanchor.records.flat import flat_columns, flat_row

        row = flat_row(self)
        columns = flat_columns(type(self))
        return pd.DataFrame(
            {
                name: pd.array([row[name]], dtype=_FRAME_TYPES[kind])
                for name, kind in columns.items()
            }
        )

    def _repr_html_(self) -> str:
        """Make an HTML table of the single values for notebooks, without nulls."""
        values = self.model_dump(mode="json")
        shown = []
        for name, value in values.items():
            if value is not None and not isinstance(value, dict | list):
                text = (
                    f"{value:.{_SHOWN_FLOAT_DIGITS}g}" if isinstance(value, float) else str(value)
                )
                shown.append((name, text))
        shown += [(note["code"], note["message"]) for note in values.get("warnings") or ()]
        rows = (
            f"<tr><th style='text-align:left'>{escape(name)}</th><td>{escape(text)}</td></tr>"
            for name, text in shown
        )
        return f"<table>{''.join(rows)}</table>"
