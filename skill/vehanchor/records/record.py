"""Base class of all records, and the version of their schema."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from vehanchor.errors import MissingExtraError
from vehanchor.scale.defaults import INTERVAL_PREMISE

SCHEMA_VERSION: Literal[4] = 4
"""Version of all fields; it rises when a field is renamed, removed or redefined."""

SchemaVersion = Annotated[
    Literal[4], Field(description="Version of this schema; others are refused.")
]

CI95_LOW = f"Lower end of its 95 % interval {INTERVAL_PREMISE}."
CI95_HIGH = f"Upper end of its 95 % interval {INTERVAL_PREMISE}."
"""Descriptions of the ends of a scale's interval."""

_SHOWN_FLOAT_DIGITS = 4
# Types of pandas that have a missing value.
_FRAME_TYPES = {float: "float64", int: "Int64", bool: "boolean", str: "string"}


@dataclass(frozen=True)
class Short:
    """Mark of a field, within ``Annotated``: short answers for language models have it, too.

    They have a marked field of ``EstimateDetails`` beside the others. Of a nested record they have
    the marked fields, or all if none is marked.

    Attributes:
        when_null: whether they have it even if it is null, which then is a fact by itself.
        only_if_ok: whether they leave it out unless the status of the record is ``ok``.
        round_down: whether they round it down, so that it does not pass a limit by rounding.
    """

    when_null: bool = False
    only_if_ok: bool = False
    round_down: bool = False


class Record(BaseModel):
    """Frozen record: numbers are finite or null; names of quantities have units."""

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
        data = {}
        for name, kind in columns.items():
            data[name] = pd.array([row[name]], dtype=_FRAME_TYPES[kind])
        return pd.DataFrame(data)

    def _repr_html_(self) -> str:
        """Make an HTML table for notebooks: single values and warnings, without nulls."""
        values = self.model_dump(mode="json")
        shown: list[tuple[str, str]] = []
        for name, value in values.items():
            if value is None or isinstance(value, dict | list):
                continue
            if isinstance(value, float):
                shown.append((name, f"{value:.{_SHOWN_FLOAT_DIGITS}g}"))
            else:
                shown.append((name, str(value)))
        for notice in values.get("warnings") or ():
            shown.append((notice["code"], notice["message"]))
        rows = ""
        for name, text in shown:
            heading = f"<th style='text-align:left'>{escape(name)}</th>"
            rows += f"<tr>{heading}<td>{escape(text)}</td></tr>"
        return f"<table>{rows}</table>"
