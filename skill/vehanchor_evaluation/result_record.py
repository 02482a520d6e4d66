"""Base class of the records that an evaluation writes."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class ResultRecord(BaseModel):
    """Immutable record of a result, without unknown fields and infinite numbers."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
    )
