"""The answer to one call: a record or several, and what explains them to people."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, Literal, TypeAlias, TypeVar

from mcp.server.mcpserver import Image
from mcp.types import CallToolResult, TextContent
from pydantic import BaseModel

from vehanchor_server.app_page import panel_meta
from vehanchor_server.app_page.panel import place_of_image
from vehanchor_server.calls.short import short_answer

if TYPE_CHECKING:
    from vehanchor_server.app_page.panel import ImagePlace, LengthHistogram

__all__ = ["Answer", "Detail"]

Record = TypeVar("Record", bound=BaseModel, covariant=True)

Detail: TypeAlias = Literal["short", "full"]
"""How much of a record an answer holds: what a model needs, or all of it."""


@dataclass(frozen=True)
class Answer(Generic[Record]):
    """Records and what explains them.

    Attributes:
        records: the results, one for each thing that was asked about.
        overlay: the picture as JPEG, if it was asked for.
        histogram: of the lengths behind the scale; None without vehicles, or for a scale that the caller gave.
    """

    records: tuple[Record, ...]
    overlay: bytes | None = None
    histogram: LengthHistogram | None = None

    @property
    def record(self) -> Record:
        """The first of them."""
        return self.records[0]

    def _image_place(self) -> ImagePlace | None:
        """Where the image lies in the overlay; None without one."""
        width, height = (getattr(self.record, name, None) for name in ("image_width_px", "image_height_px"))
        return None if self.overlay is None or not width or not height else place_of_image(width, height)

    def to_result(
        self, sentence: str, *, include_overlay: bool, detail: Detail = "full", paged: bool = False
    ) -> CallToolResult:
        """The record for programs, the sentence for models, the picture for those who asked, the panel for people.

        Args:
            sentence: the records in words.
            include_overlay: whether the caller asked for the picture; else only the host's page gets it.
            detail: how much of the records.
            paged: whether the host shows a page, which then gets the whole record.
        """
        content: list[Any] = [TextContent(type="text", text=sentence)]
        if include_overlay and self.overlay is not None:
            content.append(Image(data=self.overlay, format="jpeg").to_image_content())
        whole = [record.model_dump(mode="json") for record in self.records]
        full = whole[0] if len(whole) == 1 else {"measurements": whole}
        return CallToolResult(
            content=content,
            structured_content=full if detail == "full" else short_answer(self.records),
            _meta=panel_meta(
                self.histogram,
                None if include_overlay else self.overlay,
                whole[0] if paged and detail == "short" else None,
                self._image_place(),
            ),
        )
