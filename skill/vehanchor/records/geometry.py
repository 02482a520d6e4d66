"""Points, boxes and outlines in pixels of the image."""

from __future__ import annotations

from pydantic import Field

from vehanchor.records.record import Record


class ImagePoint(Record):
    """A point in the image; the first pixel spans 0 to 1."""

    x_px: float = Field(description="Pixels from the left edge.")
    y_px: float = Field(description="Pixels from the upper edge.")


class BoundingBox(Record):
    """An upright box; the first pixel spans 0 to 1."""

    x1_px: float = Field(description="Left side, pixels from the left edge.")
    y1_px: float = Field(description="Upper side, pixels from the upper edge.")
    x2_px: float = Field(description="Right side, pixels from the left edge.")
    y2_px: float = Field(description="Lower side, pixels from the upper edge.")

    def scaled(self, across: float, down: float) -> BoundingBox:
        """Return the box in a copy of the image; the factors are the copy's sides over the image's."""
        return BoundingBox(
            x1_px=self.x1_px * across, y1_px=self.y1_px * down, x2_px=self.x2_px * across, y2_px=self.y2_px * down
        )


class OutlineRing(Record):
    """A closed line; the last point is joined to the first."""

    points: tuple[ImagePoint, ...] = Field(description="Corners in order, pixels of the full image.")


class OutlinePolygon(Record):
    """One piece of an object's outline."""

    exterior: OutlineRing = Field(description="The line around the piece.")
    holes: tuple[OutlineRing, ...] = Field(description="The lines around its holes.")
