"""Rows of a batch table: the estimate or the error of one image."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict

from vehanchor.records import GsdEstimate
from vehanchor.records.advice import Advice, advice_for
from vehanchor.records.columns import ALL_COLUMNS, NOT_IN_TABLES
from vehanchor.records.contradiction import contradiction_text
from vehanchor.records.flat import flat_row

if TYPE_CHECKING:
    from vehanchor.errors import VehAnchorError


class BatchRow(BaseModel):
    """Result for one image.

    Attributes:
        photograph: as the caller named it.
        estimate: null if the image could not be read.
        error_code: stable code of the error; null with an estimate.
        error: the error and its remedy.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    photograph: str
    estimate: GsdEstimate | None = None
    error_code: str | None = None
    error: str | None = None

    @classmethod
    def failed(cls, photograph: str, error: VehAnchorError) -> BatchRow:
        """Make the row of an image that could not be read."""
        return cls(photograph=photograph, error_code=error.code, error=str(error))

    @property
    def outcome(self) -> str:
        """Status of the estimate, or ``error``."""
        return "error" if self.estimate is None else self.estimate.status

    @property
    def reason(self) -> str | None:
        """Why the scale is not usable, or the code of the error; None for a usable scale."""
        return self.error_code if self.estimate is None else self.estimate.reason

    @property
    def advice(self) -> Advice | None:
        """Problem and remedy; None for a usable scale."""
        if self.error is None:
            return advice_for(self.estimate)
        return Advice(self.error, ())  # The text of an error contains its remedy.

    def flat(self) -> dict[str, Any]:
        """Flatten the row to values by column; an image with an error has no estimate."""
        values: dict[str, Any] = dict.fromkeys(ALL_COLUMNS)
        if self.estimate is not None:
            values |= flat_row(self.estimate, without=NOT_IN_TABLES)
            values["contradiction"] = contradiction_text(self.estimate) or None
        values["photograph"] = self.photograph
        values["error_code"] = self.error_code
        values["error"] = self.error
        return values
