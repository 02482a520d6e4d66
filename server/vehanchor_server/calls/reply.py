"""Reply to a call: one or more records with their picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Literal, NamedTuple, TypeAlias, TypeVar

from pydantic import BaseModel

from vehanchor.options import Frame
from vehanchor.records import GsdEstimate
from vehanchor_server.app_page.panel import panel_meta
from vehanchor_server.calls.compact import short_record
from vehanchor_server.calls.listed_vehicle import vehicles_in_words

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mcp.types import CallToolResult

    from vehanchor_server.app_page.panel import Drawing
    from vehanchor_server.calls.listed_vehicle import ListedVehicle

Record = TypeVar("Record", bound=BaseModel, covariant=True)

MAX_SIDE_PX = 1568  # the largest size that vision models see

Detail: TypeAlias = Literal["short", "full"]
"""Extent of the record in a reply: compact for models, or complete."""


class PictureRequest(NamedTuple):
    """Picture that a call should make.

    Attributes:
        kind: none; ``plain``, the image for a page; or ``evidence``, what the call saw, for
            ``view_image``.
        long_side_px: longest side of the evidence.
        part: corners of the displayed part, in the units of ``frame``; None for the usual view.
        frame: coordinate system of the part.
    """

    kind: Literal["", "plain", "evidence"] = ""
    long_side_px: int = MAX_SIDE_PX
    part: tuple[tuple[float, float], tuple[float, float]] | None = None
    frame: Frame = Frame()


@dataclass(frozen=True)
class Reply(Generic[Record]):
    """Records with a picture and page data.

    Attributes:
        records: the results, one per line or target.
        picture: the requested picture as JPEG.
        drawing: shapes that the page draws over the image.
        vehicles: the vehicles behind a scale, best first; None unless the caller asks for them.
    """

    records: tuple[Record, ...]
    picture: bytes | None = None
    drawing: Drawing | None = None
    vehicles: tuple[ListedVehicle, ...] | None = None

    @property
    def record(self) -> Record:
        """The first record."""
        return self.records[0]

    def to_result(
        self,
        text: str,
        warnings: Sequence[str] = (),
        *,
        detail: Detail = "full",
        shown: PictureRequest | None = None,
    ) -> CallToolResult:
        """Convert to a tool result.

        Text and structured content have the same facts; hosts with a page also get its data.

        Args:
            text: the records in words.
            warnings: the warnings in the text, for short structured content.
            detail: extent of the records.
            shown: the requested picture; the evidence follows the text, without structured content.
        """
        from mcp.server.mcpserver import Image
        from mcp.types import CallToolResult, TextContent

        if self.vehicles is not None:
            assert isinstance(self.record, GsdEstimate)
            n_detections = self.record.details.n_detections or 0
            text = f"{text} {vehicles_in_words(self.vehicles, n_detections)}"
        words = TextContent(type="text", text=text)
        kind = "" if shown is None else shown.kind
        if kind == "evidence":
            assert self.picture is not None
            picture = Image(data=self.picture, format="jpeg").to_image_content()
            return CallToolResult(content=[words, picture])
        records = [record.model_dump(mode="json") for record in self.records]
        full = records[0] if len(records) == 1 else {"measurements": records}
        structured = full
        hidden = None  # the whole record for the page, if models get the short one
        if detail == "short":
            structured = short_record(self.records, warnings)
            hidden = records[0]
        if self.vehicles is not None:
            vehicles = [vehicle.model_dump(mode="json") for vehicle in self.vehicles]
            structured = {**structured, "vehicles": vehicles}
        page = panel_meta()
        if kind:
            page = panel_meta(self.picture, self.drawing, record=hidden, shown=self.record)
        return CallToolResult(content=[words], structured_content=structured, _meta=page)
