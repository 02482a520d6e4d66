"""What the work of one call brings back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from vehanchor_server.app_page.panel import LengthHistogram

__all__ = ["Answer"]

Record = TypeVar("Record", covariant=True)


@dataclass(frozen=True)
class Answer(Generic[Record]):
    """A record and what explains it to people.

    Attributes:
        record: the result.
        overlay: the picture as JPEG, if it was asked for.
        histogram: of the lengths behind the scale; None without vehicles, or for a scale that the caller gave.
    """

    record: Record
    overlay: bytes | None
    histogram: LengthHistogram | None
