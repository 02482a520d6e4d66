"""Analyses made of given boxes, without a detector, for the tests of what shows them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vehanchor.confidence import FALLBACK_CONFIDENCE, composite, confidence_terms, guard_length
from vehanchor.detection import Detections
from vehanchor.perception import ScaleAnalysis
from vehanchor.records import Aggregation, GsdEstimate
from vehanchor.scale import gsd_interval, inlier_mask, modal_length

__all__ = ["make_analysis"]


def make_analysis(
    boxes: NDArray[np.float64],
    width_px: int,
    height_px: int,
    *,
    aggregation: Aggregation = "kde",
    reference_length_m: float = 5.045,
) -> ScaleAnalysis:
    """The analysis of an image in which a detector found ``boxes``, all with score 0.8."""
    scores = np.full(len(boxes), 0.8)
    kept = inlier_mask(boxes[:, 2])
    lengths = boxes[kept, 2]
    mode = interval = None
    if len(lengths):
        mode, aggregation = modal_length(lengths, scores[kept], aggregation)
        interval = gsd_interval(lengths, mode, reference_length_m, 0.2)
    guarded = mode is not None and mode < guard_length(reference_length_m)
    terms = confidence_terms(lengths, scores[kept], mode or np.nan, (9.0, 120.0))
    confidence = composite(terms, guarded=guarded)
    estimate = GsdEstimate(
        status="no_anchor" if mode is None else "ok" if confidence >= FALLBACK_CONFIDENCE else "low_confidence",
        gsd_m_per_px=None if mode is None else reference_length_m / mode,
        confidence=confidence,
        n_vehicles=len(lengths),
        mode_length_px=mode,
        gsd_ci95_low_m_per_px=None if interval is None else interval.low,
        gsd_ci95_high_m_per_px=None if interval is None else interval.high,
        n_detections=len(boxes),
        aggregation=aggregation,
        reference_length_m=reference_length_m,
        resolution_guard=guarded,
        confidence_terms=terms,
        image_width_px=width_px,
        image_height_px=height_px,
        georeference_gsd_m_per_px=None,
        frame=None,
        model="test",
        model_sha256="0" * 64,
        warnings=(),
    )
    return ScaleAnalysis(estimate, Detections(boxes, scores), kept)
