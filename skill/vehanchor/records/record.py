"""Base class of all records, and the version of their schema."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from vehanchor.records.interop import as_frame, as_html

SCHEMA_VERSION: Literal[3] = 3
"""Version of all fields; it rises when a field is renamed, removed or redefined."""

SchemaVersion = Annotated[Literal[3], Field(description="Version of this schema; others are refused.")]


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
        return as_frame([self])

    def _repr_html_(self) -> str:
        """Make an HTML table of the single values for notebooks."""
        return as_html(self.model_dump(mode="json"))
