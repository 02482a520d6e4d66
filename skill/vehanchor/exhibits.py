"""An analysis as people look at it and other programs take it: pictures, plots, boxes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.errors import InvalidParameterError, MissingExtraError
from vehanchor.findings import ScaleFindings

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import ImageSource

__all__ = ["ScaleAnalysis", "read_again"]


def read_again(analysis: ScaleFindings, image: ImageSource | None) -> NDArray[np.uint8]:
    """Read the image of an analysis for a picture.

    Args:
        analysis: of the image.
        image: where to read it; None for where it was read first.

    Returns:
        ``[h, w, 3]`` RGB, no side above 4096 px.

    Raises:
        InvalidParameterError: it cannot be read twice, and no other is given.
        ImageError: it cannot be read any more.
    """
    from vehanchor.imagery.raster import open_raster
    from vehanchor.options import Reading
    from vehanchor.pictures.scale import read_reduced

    source = analysis.image if image is None else image
    if source is None:
        raise InvalidParameterError("the analysis does not have its image: give it, as overlay(image)")
    reading = analysis.reading or Reading()
    with open_raster(source, bands=reading.bands, limits=reading.limits, bgr=reading.bgr) as raster:
        return read_reduced(raster)


class ScaleAnalysis(ScaleFindings):
    """An estimate together with what it was concluded from, and the forms in which that is shown and handed on."""

    def overlay(self, image: ImageSource | None = None) -> NDArray[np.uint8]:
        """Draw the vehicles, other rulers and a scale bar over the image.

        Args:
            image: where to read it again; None for where ``analyse_scale`` read it, which a stream does not allow.

        Returns:
            ``[h, w, 3]`` RGB, as ``vehanchor estimate --overlay`` writes it.

        Raises:
            InvalidParameterError: the image cannot be read twice, and none is given.
            ImageError: it cannot be read any more.
        """
        from vehanchor.pictures.scale import draw_overlay

        return draw_overlay(read_again(self, image), self)

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
        try:
            import supervision as sv
        except ImportError:
            raise MissingExtraError("to_supervision needs supervision: pip install supervision") from None
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

    def _repr_png_(self) -> bytes | None:
        """The overlay, for notebooks; None where the image cannot be read again."""
        if self.image is None:
            return None
        import cv2

        _, encoded = cv2.imencode(".png", np.ascontiguousarray(self.overlay()[:, :, ::-1]))
        return encoded.tobytes()
