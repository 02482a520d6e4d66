"""Analyses: records with their evidence, drawing and export; first that of a scale."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from vehanchor.detection.boxes import box_corners
from vehanchor.errors import InvalidParameterError, MissingExtraError
from vehanchor.imagery.sources.opening import ImageSource, can_be_read_again, open_raster
from vehanchor.options import Reading
from vehanchor.pictures.evidence import ScaleEvidence

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from vehanchor.imagery.metadata.georeference import Ground
    from vehanchor.imagery.raster import Raster


@dataclass(frozen=True, eq=False, kw_only=True)
class Analysis:
    """Analysis that can be drawn over its image; the image is read again.

    Attributes:
        image: source to read the image from again; None for a stream.
        reading: options of reading.
        ground: position of the image on the ground; None without a georeference.
    """

    image: ImageSource | None = None
    reading: Reading = Reading()  # noqa: RUF009 - frozen
    ground: Ground | None = None

    def drawn_over(self, image: ImageSource, raster: Raster, reading: Reading) -> Self:
        """Copy the analysis with its image; a source that can be read only once is not kept."""
        source = image if can_be_read_again(image) else None
        return replace(self, image=source, reading=reading, ground=raster.ground)

    def overlay(self, image: ImageSource | None = None) -> NDArray[np.uint8]:
        """Draw the result and a scale bar over the image.

        A measurement shows its part of the image, with a margin.

        Args:
            image: source to read the image from; None for the first source, unless it is a stream.

        Returns:
            ``[h, w, 3]`` RGB, as written by ``--overlay``.

        Raises:
            InvalidParameterError: the source cannot be read twice, and no image is given.
            ImageError: the image can no longer be read.
        """
        source = self.image if image is None else image
        if source is None:
            raise InvalidParameterError(
                "the analysis does not have its image: give it, as overlay(image)"
            )
        with open_raster(source, self.reading) as raster:
            return self._draw(raster)

    def _draw(self, raster: Raster) -> NDArray[np.uint8]:
        """Draw the result over the image or its part, perhaps reduced; ``[h, w, 3]`` RGB."""
        raise NotImplementedError

    def _repr_png_(self) -> bytes | None:
        """Draw the overlay for notebooks; None if the image cannot be read again."""
        if self.image is None:
            return None
        import cv2

        rgb = self.overlay()
        bgr = np.ascontiguousarray(rgb[:, :, ::-1])
        _, encoded = cv2.imencode(".png", bgr)
        return encoded.tobytes()


def import_supervision() -> Any:
    """Import supervision.

    Raises:
        MissingExtraError: supervision or one of its dependencies is not installed.
    """
    try:
        import supervision
    except ImportError as error:
        raise MissingExtraError(
            f"to_supervision needs supervision ({error}): pip install supervision"
        ) from None
    return supervision


@dataclass(frozen=True, eq=False)
class ScaleAnalysis(Analysis, ScaleEvidence):
    """Estimate with its evidence, drawing and export."""

    @property
    def detail_share(self) -> float:
        """Share of the pixels' resolution at which there is detail; 1 without vehicles."""
        if self.vehicles is None:
            return 1.0
        return self.vehicles.detail_share

    def _draw(self, raster: Raster) -> NDArray[np.uint8]:
        """Draw the vehicles and the scale bar, ``[h, w, 3]`` RGB."""
        from vehanchor.pictures.scale import draw_overlay, read_reduced

        return draw_overlay(read_reduced(raster), self)

    def plot(self) -> Figure:
        """Plot the lengths, their density and the scale, as ``vehanchor estimate --plot`` does.

        Raises:
            MissingExtraError: matplotlib is not installed.
        """
        from vehanchor.pictures.plot import plot_scale

        return plot_scale(self)

    def to_supervision(self) -> Any:
        """Convert the vehicles for supervision.

        Returns:
            ``supervision.Detections``: upright boxes, scores as ``confidence``, and in ``data`` the
            corners of the oriented boxes (``xyxyxyxy``, for its oriented annotators), ``number``,
            and ``kept``, the vehicles behind the scale.

        Raises:
            MissingExtraError: supervision is not installed.
        """
        sv = import_supervision()
        corners = self.grid.to_file(box_corners(self.detections.boxes))
        first_corner = corners.min(axis=1)
        last_corner = corners.max(axis=1)
        upright = np.concatenate([first_corner, last_corner], axis=1)
        return sv.Detections(
            xyxy=upright.astype(np.float32),
            confidence=self.detections.scores.astype(np.float32),
            class_id=np.zeros(len(corners), dtype=int),
            data={
                "xyxyxyxy": corners.astype(np.float32),
                "kept": self.kept,
                "number": self.detections.numbers,
                "class_name": np.array(["vehicle"] * len(corners)),
            },
        )

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """Vehicles as a GeoJSON FeatureCollection, for geopandas and shapely; pixels, y down."""
        detections = self.detections
        kept = self.kept
        # A tilted view has no single scale, and an unusable scale gives no sizes.
        has_one_scale = self.estimate.status == "ok" and self.estimate.tilt is None
        gsd = self.estimate.gsd_m_per_px if has_one_scale else None
        corners = self.grid.to_file(box_corners(detections.boxes)).tolist()
        features = []
        for k, ring in enumerate(corners):
            # GeoJSON closes a ring by repeating its first corner.
            closed_ring = [*ring, ring[0]]
            geometry = {"type": "Polygon", "coordinates": [closed_ring]}
            properties = {
                "number": int(detections.numbers[k]),
                "kept": bool(kept[k]),
                "score": float(detections.scores[k]),
                "length_px": float(detections.boxes[k, 2]),
                "length_m": _metres(detections.boxes[k, 2], gsd),
                "width_m": _metres(detections.boxes[k, 3], gsd),
            }
            features.append({"type": "Feature", "geometry": geometry, "properties": properties})
        return {"type": "FeatureCollection", "features": features}


def _metres(side_px: float, gsd_m_per_px: float | None) -> float | None:
    """Convert the side of a box; None without one usable scale."""
    if gsd_m_per_px is None:
        return None
    return round(float(side_px) * gsd_m_per_px, 2)
