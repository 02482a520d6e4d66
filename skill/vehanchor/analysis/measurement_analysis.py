"""Areas and distances with their evidence, drawing and export."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.analysis.scale_analysis import Analysis, import_supervision
from vehanchor.errors import OutputError
from vehanchor.pictures.evidence import AreaEvidence, DistanceEvidence

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster
    from vehanchor.records import AreaMeasurement, DistanceMeasurement


@dataclass(frozen=True, eq=False)
class AreaAnalysis(Analysis, AreaEvidence):
    """Area with its evidence, drawing and export."""

    def _draw(self, raster: Raster) -> NDArray[np.uint8]:
        from vehanchor.pictures.measurement import cut_to_objects, draw_area
        from vehanchor.pictures.scale import read_reduced

        cut = cut_to_objects([self])
        image = read_reduced(raster, cut.part)
        return draw_area(image, self, cut=cut)

    def full_mask(self) -> NDArray[np.bool_]:
        """Make the mask in the size of the file, ``[h, w]``.

        Raises:
            OutputError: the image is too large for a mask in memory.
        """
        width = self.grid.square_width_px
        height = self.grid.square_height_px
        if width * height > self.reading.limits.max_pixels:
            raise OutputError(
                f"a mask of {width} x {height} px has more than {self.reading.limits.max_pixels} "
                "pixels: take the outline from the record"
            )
        full = np.zeros((height, width), dtype=bool)
        window = self.segmentation.window
        rows = slice(window.y_px, window.y_px + window.height_px)
        columns = slice(window.x_px, window.x_px + window.width_px)
        full[rows, columns] = self.segmentation.mask
        return self.grid.mask_to_file(full)

    def to_supervision(self) -> Any:
        """Convert the object for supervision.

        Returns:
            ``supervision.Detections`` of one object: its box, its mask, the mask's score as
            ``confidence``, and in ``data`` its ``area_m2``, NaN without a scale. Empty for an empty
            mask.

        Raises:
            MissingExtraError: supervision is not installed.
            OutputError: the image is too large for a mask in memory.
        """
        sv = import_supervision()
        record = self.measurement
        box = record.bounding_box
        if box is None:
            return sv.Detections.empty()
        corners = (box.x1_px, box.y1_px, box.x2_px, box.y2_px)
        return sv.Detections(
            xyxy=np.array([corners], np.float32),
            mask=self.full_mask()[None],
            confidence=np.array([record.mask_score], np.float32),
            class_id=np.zeros(1, dtype=int),
            data={
                "class_name": np.array(["object"]),
                "area_m2": np.array([record.area_m2], dtype=float),
            },
        )

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """Outline as a GeoJSON Feature with its area, for geopandas; pixels, y down."""
        return _feature(self.measurement, "area_m2", "area_ci95_low_m2", "area_ci95_high_m2")


@dataclass(frozen=True, eq=False)
class DistanceAnalysis(Analysis, DistanceEvidence):
    """Distance with its evidence, drawing and export."""

    def _draw(self, raster: Raster) -> NDArray[np.uint8]:
        from vehanchor.pictures.measurement import cut_to_lines, draw_distance
        from vehanchor.pictures.scale import read_reduced

        cut = cut_to_lines([self])
        image = read_reduced(raster, cut.part)
        return draw_distance(image, self, cut=cut)

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """Line as a GeoJSON Feature with its length, for geopandas; pixels, y down."""
        return _feature(
            self.measurement, "distance_m", "distance_ci95_low_m", "distance_ci95_high_m"
        )


def _feature(record: AreaMeasurement | DistanceMeasurement, *names: str) -> dict[str, Any]:
    """Make a GeoJSON Feature of a measurement.

    Args:
        record: the measurement.
        *names: names of the fields with the size and its interval.
    """
    fields = ("status", *names, "gsd_m_per_px", "scale_confidence")
    properties = {name: getattr(record, name) for name in fields}
    geometry = record.__geo_interface__
    return {"type": "Feature", "geometry": geometry, "properties": properties}
