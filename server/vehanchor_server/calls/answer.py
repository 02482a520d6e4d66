"""The answer to one call: a record or several, and what explains them to people."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, Literal, NamedTuple, TypeAlias, TypeVar

from mcp.server.mcpserver import Image
from mcp.types import Annotations, CallToolResult, TextContent
from pydantic import BaseModel

from vehanchor_server.app_page import panel_meta
from vehanchor_server.calls.compact import scale_in_words, short_answer

if TYPE_CHECKING:
    from vehanchor_server.app_page.panel import Drawing, LengthHistogram

Record = TypeVar("Record", bound=BaseModel, covariant=True)

Detail: TypeAlias = Literal["short", "full"]
"""How much of a record an answer holds: what a model needs, or all of it."""


class PictureRequest(NamedTuple):
    """Which pictures a call is to make.

    Attributes:
        overlay: the one that explains the result; the caller asked for it.
        page: the image for the host's page.
    """

    overlay: bool
    page: bool


@dataclass(frozen=True)
class Answer(Generic[Record]):
    """Records and what explains them.

    Attributes:
        records: the results, one for each thing that was asked about.
        overlay: the picture as JPEG, if it was asked for.
        histogram: of the lengths behind the scale; None without vehicles, or for a scale that the caller gave.
        page_picture: the image as JPEG, if the host shows a page.
        drawing: what the page draws over it.
    """

    records: tuple[Record, ...]
    overlay: bytes | None = None
    histogram: LengthHistogram | None = None
    page_picture: bytes | None = None
    drawing: Drawing | None = None

    @property
    def record(self) -> Record:
        """The first of them."""
        return self.records[0]

    def to_result(self, sentence: str, *, detail: Detail = "full", paged: bool = False) -> CallToolResult:
        """The record for programs, the sentence for models, the picture for those who asked, the panel for people.

        Args:
            sentence: the records in words.
            detail: how much of the records.
            paged: whether the host shows a page, which then gets the whole record.
        """
        short = None if detail == "full" else short_answer(self.records)
        content: list[Any] = [TextContent(type="text", text=sentence)]
        if self.overlay is not None:
            content.append(Image(data=self.overlay, format="jpeg").to_image_content())
        if short is not None and (scale := scale_in_words(self.records, short)):
            content.append(TextContent(type="text", text=scale, annotations=Annotations(audience=["assistant"])))
        whole = [record.model_dump(mode="json") for record in self.records]
        full = whole[0] if len(whole) == 1 else {"measurements": whole}
        return CallToolResult(
            content=content,
            structured_content=full if short is None else short,
            _meta=panel_meta(
                self.histogram, self.page_picture, self.drawing, whole[0] if paged and detail == "short" else None
            ),
        )
