"""Base class of the server's pydantic models, and strict types of numbers."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pydantic import BaseModel, ConfigDict, Strict

Number: TypeAlias = Annotated[float, Strict()]
"""A number; strings and booleans are refused."""

WholeNumber: TypeAlias = Annotated[int, Strict()]
"""An integer; strings and booleans are refused."""

Flag: TypeAlias = Annotated[bool, Strict()]
"""A boolean; numbers and strings are refused."""


class FrozenModel(BaseModel):
    """Immutable model without unknown fields, NaN or infinity."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
