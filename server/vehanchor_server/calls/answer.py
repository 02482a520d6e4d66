"""The answer to one call: a record, and what explains it to people."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from mcp.server.mcpserver import Image
from mcp.types import CallToolResult, TextContent
from pydantic import BaseModel

from vehanchor_server.app_page import panel_meta
from vehanchor_server.app_page.panel import place_of_image

if TYPE_CHECKING:
    from vehanchor_server.app_page.panel import ImagePlace, LengthHistogram

__all__ = ["Answer"]

Record = TypeVar("Record", bound=BaseModel, covariant=True)


@dataclass(frozen=True)
class Answer(Generic[Record]):
    """A record and what explains it.

    Attributes:
        record: the result.
        overlay: the picture as JPEG, if it was asked for.
        histogram: of the lengths behind the scale; None without vehicles, or for a scale that the caller gave.
    """

    record: Record
    overlay: bytes | None = None
    histogram: LengthHistogram | None = None

    def _image_place(self) -> ImagePlace | None:
        """Where the image lies in the overlay; None without one."""
        width, height = (getattr(self.record, name, None) for name in ("image_width_px", "image_height_px"))
        return None if self.overlay is None or not width or not height else place_of_image(width, height)

    def to_result(self, sentence: str, *, include_overlay: bool) -> CallToolResult:
        """The record for programs, the sentence for models, the picture for those who asked, the panel for people.

        Args:
            sentence: the record in words.
            include_overlay: whether the caller asked for the picture; else only the host's page gets it.
        """
        content: list[Any] = [TextContent(type="text", text=sentence)]
        if include_overlay and self.overlay is not None:
            content.append(Image(data=self.overlay, format="jpeg").to_image_content())
        return CallToolResult(
            content=content,
            structured_content=self.record.model_dump(mode="json"),
            _meta=panel_meta(self.histogram, None if include_overlay else self.overlay, self._image_place()),
        )
