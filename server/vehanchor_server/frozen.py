"""The one base of the server's own pydantic models, and the types of numbers that callers send."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pydantic import BaseModel, ConfigDict, Strict

Number: TypeAlias = Annotated[float, Strict()]
"""A number, and nothing that might be read as one: ``true`` is no metre."""

WholeNumber: TypeAlias = Annotated[int, Strict()]
"""A number without a fraction."""

Flag: TypeAlias = Annotated[bool, Strict()]
"""Yes or no, and no number."""


class FrozenModel(BaseModel):
    """Values that do not change, without unknown fields, NaN or infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
