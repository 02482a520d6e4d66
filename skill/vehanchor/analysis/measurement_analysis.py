"""Areas and distances with their evidence, drawing and export."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.analysis.scale_analysis import Analysis, import_supervision
from vehanchor.errors import OutputError
from vehanchor.pictures.evidence import AreaEvidence, DistanceEvidence

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster
    from vehanchor.records import AreaMeasurement, DistanceMeasurement

_AREA_FIELDS = ("area_m2", "area_ci95_low_m2", "area_ci95_high_m2")


@dataclass(frozen=True, eq=False)
class AreaAnalysis(Analysis, AreaEvidence):
    """Area with its evidence, drawing and export.

    Attributes:
        name: the caller's name of a shape; may be empty.
    """

    name: str = ""

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
        """Convert the object for supervision; see ``all_to_supervision``."""
        return self.all_to_supervision([self])

    @staticmethod
    def all_to_supervision(analyses: Sequence[AreaAnalysis]) -> Any:
        """Convert objects of one image for supervision.

        Args:
            analyses: results of ``analyse_areas``, or several of ``analyse_area``.

        Returns:
            ``supervision.Detections`` of the objects with a mask: boxes, masks, and in ``data``
            their ``area_m2`` with its interval, ``area_ci95_low_m2`` and ``area_ci95_high_m2``, NaN
            without a scale. The ``confidence`` is the masks' score; there is none if the caller
            gave a shape.

        Raises:
            MissingExtraError: supervision is not installed.
            OutputError: the image is too large for a mask in memory.
        """
        sv = import_supervision()
        found = [analysis for analysis in analyses if analysis.measurement.bounding_box is not None]
        if not found:
            return sv.Detections.empty()
        records = [analysis.measurement for analysis in found]
        corners = []
        for record in records:
            box = record.bounding_box
            assert box is not None, "a mask with pixels has a box"
            corners.append((box.x1_px, box.y1_px, box.x2_px, box.y2_px))
        scores = [record.mask_score for record in records]
        confidence = None
        if None not in scores:
            confidence = np.array(scores, np.float32)
        data = {"class_name": np.array(["object"] * len(records))}
        for name in _AREA_FIELDS:
            sizes = [getattr(record, name) for record in records]
            data[name] = np.array(sizes, dtype=float)
        return sv.Detections(
            xyxy=np.array(corners, np.float32),
            mask=np.stack([analysis.full_mask() for analysis in found]),
            confidence=confidence,
            class_id=np.zeros(len(records), dtype=int),
            data=data,
        )

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """Outline as a GeoJSON Feature with its area, for geopandas; pixels, y down."""
        feature = _feature(self.measurement, *_AREA_FIELDS)
        if self.name:
            feature["properties"]["name"] = self.name
        return feature


@dataclass(frozen=True, eq=False, kw_only=True)
class AreaCollection(Analysis):
    """Areas of several objects in one image, with drawing and export.

    Attributes:
        analyses: the areas, one at least.
    """

    analyses: tuple[AreaAnalysis, ...]

    @classmethod
    def of(cls, analyses: Sequence[AreaAnalysis]) -> AreaCollection:
        """Collect areas of one image."""
        first = analyses[0]
        return cls(
            image=first.image,
            reading=first.reading,
            ground=first.ground,
            analyses=tuple(analyses),
        )

    def _draw(self, raster: Raster) -> NDArray[np.uint8]:
        from vehanchor.pictures.measurement import cut_to_objects, draw_area
        from vehanchor.pictures.scale import read_reduced

        cut = cut_to_objects(self.analyses)
        image = read_reduced(raster, cut.part)
        return draw_area(image, *self.analyses, cut=cut)

    def full_mask(self) -> NDArray[np.bool_]:
        """Make the mask of all objects in the size of the image, ``[h, w]``.

        Raises:
            OutputError: as ``AreaAnalysis.full_mask``.
        """
        full = self.analyses[0].full_mask()
        for analysis in self.analyses[1:]:
            full |= analysis.full_mask()
        return full

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """Outlines as a GeoJSON FeatureCollection with their areas; pixels, y down."""
        features = [analysis.__geo_interface__ for analysis in self.analyses]
        return {"type": "FeatureCollection", "features": features}


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
