"""Analyses as people look at them and other programs take them: pictures, plots, boxes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.analysis.findings import AreaFindings, DistanceFindings, ScaleFindings
from vehanchor.errors import InvalidParameterError, MissingExtraError

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from vehanchor.imagery.sources.opening import ImageSource
    from vehanchor.options import Reading
    from vehanchor.records import AreaMeasurement, DistanceMeasurement


def _import_supervision() -> Any:
    """Import supervision.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import supervision
    except ImportError as error:  # it, or something that it needs
        raise MissingExtraError(f"to_supervision needs supervision ({error}): pip install supervision") from None
    return supervision


class Exhibit:
    """An analysis that is drawn over its image, which is read again for that.

    Attributes:
        image: where it can be read again; None for a stream.
        reading: how it was read; None for the defaults.
    """

    image: ImageSource | None
    reading: Reading | None

    def overlay(self, image: ImageSource | None = None) -> NDArray[np.uint8]:
        """Draw what was measured and a scale bar over the image.

        Args:
            image: where to read it again; None for where it was read first, which a stream does not allow.

        Returns:
            ``[h, w, 3]`` RGB, as ``--overlay`` of the command writes it.

        Raises:
            InvalidParameterError: the image cannot be read twice, and none is given.
            ImageError: it cannot be read any more.
        """
        from vehanchor.imagery.sources.opening import open_raster
        from vehanchor.options import Reading
        from vehanchor.pictures.scale import read_reduced

        source = self.image if image is None else image
        if source is None:
            raise InvalidParameterError("the analysis does not have its image: give it, as overlay(image)")
        reading = self.reading or Reading()
        with open_raster(source, bands=reading.bands, limits=reading.limits, bgr=reading.bgr) as raster:
            return self._drawn(read_reduced(raster))

    def _drawn(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Draw it over ``[h, w, 3]`` RGB, the image or a reduced copy."""
        raise NotImplementedError

    def _repr_png_(self) -> bytes | None:
        """The overlay, for notebooks; None where the image cannot be read again."""
        if self.image is None:
            return None
        import cv2

        _, encoded = cv2.imencode(".png", np.ascontiguousarray(self.overlay()[:, :, ::-1]))
        return encoded.tobytes()


class ScaleAnalysis(Exhibit, ScaleFindings):
    """An estimate together with what it was concluded from, and the forms in which that is shown and handed on."""

    def _drawn(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        from vehanchor.pictures.scale import draw_overlay

        return draw_overlay(image, self)

    def plot(self) -> Figure:
        """Plot the lengths, their density and the scale, as ``vehanchor estimate --plot`` writes it.

        Raises:
            MissingExtraError: there is no matplotlib.
        """
        from vehanchor.pictures.plot import plot_scale

        return plot_scale(self)

    def to_supervision(self) -> Any:
        """Give the vehicles to supervision.

        Returns:
            ``supervision.Detections``: upright boxes, scores as ``confidence``, and in ``data`` the corners of the
            oriented boxes (``xyxyxyxy``, which its oriented annotators draw) and ``kept``, which of them were measured.

        Raises:
            MissingExtraError: there is no supervision.
        """
        sv = _import_supervision()
        from vehanchor.detection.boxes import box_corners

        corners = box_corners(self.detections.boxes)
        return sv.Detections(
            xyxy=np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1).astype(np.float32),
            confidence=self.detections.scores.astype(np.float32),
            class_id=np.zeros(len(corners), dtype=int),
            data={
                "xyxyxyxy": corners.astype(np.float32),
                "kept": self.kept,
                "class_name": np.array(["vehicle"] * len(corners)),
            },
        )

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """The vehicles as a GeoJSON FeatureCollection, which geopandas and shapely take; pixels, y down."""
        from vehanchor.detection.boxes import box_corners

        boxes, scores = self.detections.boxes, self.detections.scores
        features = [
            {
                "type": "Feature",
                "geometry": {"type": "Polygon", "coordinates": [[*map(list, ring.tolist()), ring[0].tolist()]]},
                "properties": {"kept": bool(kept), "score": float(score), "length_px": float(length)},
            }
            for ring, kept, score, length in zip(box_corners(boxes), self.kept, scores, boxes[:, 2], strict=True)
        ]
        return {"type": "FeatureCollection", "features": features}


class AreaAnalysis(Exhibit, AreaFindings):
    """A measurement of an object together with what it came from, and the forms in which that is handed on."""

    def _drawn(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        from vehanchor.pictures.area import draw_area

        return draw_area(image, self)

    def full_mask(self) -> NDArray[np.bool_]:
        """Give the object's mask in the size of the image, ``[h, w]``.

        Raises:
            OutputError: the image has more pixels than may be held at once.
        """
        from vehanchor.options import Reading
        from vehanchor.pictures.area import full_mask

        return full_mask(self, (self.reading or Reading()).limits)[:, :, 0] > 0

    def to_supervision(self) -> Any:
        """Give the object to supervision.

        Returns:
            ``supervision.Detections`` of one object: its box, its mask, the mask's score as ``confidence``, and in
            ``data`` its ``area_m2``, NaN without a scale; of none, for an empty mask.

        Raises:
            MissingExtraError: there is no supervision.
            OutputError: the image is too large for a mask of its size.
        """
        sv, record = _import_supervision(), self.measurement
        box = record.bounding_box
        if box is None:
            return sv.Detections.empty()
        return sv.Detections(
            xyxy=np.array([[box.x1_px, box.y1_px, box.x2_px, box.y2_px]], np.float32),
            mask=self.full_mask()[None],
            confidence=np.array([record.mask_score], np.float32),
            class_id=np.zeros(1, dtype=int),
            data={"class_name": np.array(["object"]), "area_m2": np.array([record.area_m2], dtype=float)},
        )

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """The outline as a GeoJSON Feature with its area, which geopandas takes; pixels, y down."""
        return _feature(self.measurement, "area_m2", "area_ci95_low_m2", "area_ci95_high_m2")


class DistanceAnalysis(Exhibit, DistanceFindings):
    """A measured line together with what its length came from, and the forms in which that is handed on."""

    def _drawn(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        from vehanchor.pictures.distance import draw_distance

        return draw_distance(image, self)

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """The line as a GeoJSON Feature with its length, which geopandas takes; pixels, y down."""
        return _feature(self.measurement, "distance_m", "distance_ci95_low_m", "distance_ci95_high_m")


def _feature(record: AreaMeasurement | DistanceMeasurement, *names: str) -> dict[str, Any]:
    """What was measured as a GeoJSON Feature; ``names`` are those of the size and its interval."""
    properties = {name: getattr(record, name) for name in ("status", *names, "gsd_m_per_px", "confidence")}
    return {"type": "Feature", "geometry": record.__geo_interface__, "properties": properties}
