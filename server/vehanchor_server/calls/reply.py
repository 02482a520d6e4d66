"""Reply to a call: one or more records with their explanations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, Literal, NamedTuple, TypeAlias, TypeVar

from mcp.server.mcpserver import Image
from mcp.types import CallToolResult, TextContent
from pydantic import BaseModel

from vehanchor_server.app_page import panel_meta
from vehanchor_server.calls.compact import short_record

if TYPE_CHECKING:
    from vehanchor_server.app_page.panel import Drawing

Record = TypeVar("Record", bound=BaseModel, covariant=True)

MAX_SIDE_PX = 1568  # the largest size that vision models see

Detail: TypeAlias = Literal["short", "full"]
"""Extent of the record in a reply: compact for models, or complete."""


class PictureRequest(NamedTuple):
    """Pictures that a call should make.

    Attributes:
        overlay: whether the caller requested the overlay.
        page: whether the host's page needs the image.
        long_side_px: longer side of the overlay, at most.
    """

    overlay: bool
    page: bool
    long_side_px: int = MAX_SIDE_PX


@dataclass(frozen=True)
class Reply(Generic[Record]):
    """Records with pictures and page data.

    Attributes:
        records: the results, one per line or target.
        overlay: the overlay as JPEG, if requested.
        page_picture: the image as JPEG, if the host shows a page.
        drawing: shapes that the page draws over the image.
    """

    records: tuple[Record, ...]
    overlay: bytes | None = None
    page_picture: bytes | None = None
    drawing: Drawing | None = None

    @property
    def record(self) -> Record:
        """The first record."""
        return self.records[0]

    def to_result(self, sentence: str, *, detail: Detail = "full", paged: bool = False) -> CallToolResult:
        """Convert to a tool result: text for models, structured content for programs, pictures and page data.

        Args:
            sentence: the records in words.
            detail: extent of the records.
            paged: whether the host shows a page, which needs the whole record.
        """
        short = None if detail == "full" else short_record(self.records)
        content: list[Any] = [TextContent(type="text", text=sentence)]
        if self.overlay is not None:
            content.append(Image(data=self.overlay, format="jpeg").to_image_content())
        whole = [record.model_dump(mode="json") for record in self.records]
        full = whole[0] if len(whole) == 1 else {"measurements": whole}
        return CallToolResult(
            content=content,
            structured_content=full if short is None else short,
            _meta=panel_meta(
                self.page_picture,
                self.drawing,
                whole[0] if paged and detail == "short" else None,
                self.record if paged else None,
            ),
        )
