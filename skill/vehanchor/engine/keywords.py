"""The keywords of the verbs, and the models and runtime that they take."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any, TypeAlias

from vehanchor.detection.detector import Detector
from vehanchor.models.runtime import RuntimeKeywords
from vehanchor.options import OptionKeywords
from vehanchor.segmentation.segmenter import Segmenter

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from vehanchor.records import GsdEstimate, KnownScale
    from vehanchor.segmentation.prompt import Box, Point

DetectorSource: TypeAlias = Detector | str | os.PathLike[str]
SegmenterSource: TypeAlias = Segmenter | tuple[str | os.PathLike[str], str | os.PathLike[str]]


class EstimateKeywords(OptionKeywords, RuntimeKeywords, total=False):
    """Keywords of every verb: options of the method, fields of the runtime, and the detector for this call.

    Attributes:
        detector: a bundled model's name, the path of an ONNX oriented-box model, or a loaded ``Detector``. A loaded
            one keeps its own threads, providers and precision.
    """

    detector: DetectorSource | None


class MeasureKeywords(EstimateKeywords, total=False):
    """Keywords of measurements.

    Attributes:
        gsd_m_per_px: known scale, metres per pixel of the full image; the detector does not run.
        scale: an earlier estimate of this image, or its ``scale``; the detector does not run, and the estimate's
            interval and confidence hold.
        object_height_m: height of the measured object above the ground, as of a roof; None for 0.
    """

    gsd_m_per_px: float | None
    scale: KnownScale | GsdEstimate | Mapping[str, Any] | None
    object_height_m: float | None


class AreaKeywords(MeasureKeywords, total=False):
    """Keywords of an area: exactly one of ``box`` and ``points``.

    Attributes:
        box: x1, y1, x2, y2, a geometry of shapely, or supervision's ``Detections`` of one object.
        points: x, y and, optionally, whether the point lies on the object (the default) or beside it.
        segmenter: paths of encoder and decoder, or a loaded ``Segmenter``.
    """

    box: Box | None
    points: Sequence[Point] | None
    segmenter: SegmenterSource | None
