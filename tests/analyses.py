"""Analyses of made-up boxes, without a detector, for the tests of results."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vehanchor.analysis.pipeline import analyse_view
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.detection.card import DetectorCard
from vehanchor.detection.detections import Detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.options import ScaleOptions
from vehanchor.rulers.camera_tilt import metadata_tilt
from vehanchor.rulers.ruler import Ruler, View
from vehanchor.scale.calibration import Calibration
from vehanchor.scale.defaults import Aggregation
from vehanchor.scale.lengths import Z95
from vehanchor.scale.posterior import Witness


def made_card(reference_length_m: float = 5.045, min_length_px: float = 0.0) -> DetectorCard:
    """Make the card of a detector that does not exist."""
    return DetectorCard(
        name="test",
        sha256="0" * 64,
        class_names={0: "small vehicle"},
        reference_length_m=reference_length_m,
        reference_length_sd_m=0.2,
        min_length_px=min_length_px,
    )


def measured_fleet(length_m: float) -> Calibration:
    """Make the calibration of a fleet of this length, which a caller has measured."""
    return Calibration(
        reference_length_m=length_m,
        reference_length_ci95_low_m=0.98 * length_m,
        reference_length_ci95_high_m=1.02 * length_m,
        reference_length_sd_m=0.02 * length_m,
        source="labels",
        n_vehicles=1000,
        n_images=20,
        mode_length_px=30.0,
        median_gsd_m_per_px=length_m / 30.0,
        detector=None,
        detector_sha256=None,
    )


def make_analysis(
    boxes: NDArray[np.float64],
    width_px: int,
    height_px: int,
    *,
    aggregation: Aggregation = "kde",
    reference_length_m: float = 5.045,
    min_length_px: float = 0.0,
) -> ScaleAnalysis:
    """Analyse an image in which a detector found ``boxes``, all with score 0.8."""
    return analyse_found(
        Detections(boxes, np.full(len(boxes), 0.8)),
        made_card(reference_length_m, min_length_px),
        ScaleOptions.of({"aggregation": aggregation}),
        image_width_px=width_px,
        image_height_px=height_px,
    )


def analyse_found(
    found: Detections,
    card: DetectorCard,
    options: ScaleOptions | None = None,
    *,
    image_width_px: int,
    image_height_px: int,
    detail_share: float = 1.0,
) -> ScaleAnalysis:
    """Analyse made-up vehicles: the second half of the pipeline."""
    image = ImageFacts(image_width_px, image_height_px)
    return analyse_view(
        View(
            image,
            found,
            card=card,
            options=options or ScaleOptions(),
            measure_detail_share=lambda *_: detail_share,
        )
    )


def with_tilt(view: View) -> View:
    """Add the tilt of the metadata to a view, as a search does."""
    return replace(view, tilt=metadata_tilt(view.image, view.options))


def found_witness(witness: Witness | None) -> Witness:
    """Return a witness; fail for a ruler that has nothing to report."""
    assert witness is not None
    return witness


def empty_view(
    camera: CameraMetadata | None = None,
    width_px: int = 4000,
    height_px: int = 3000,
    **options: Any,
) -> View:
    """Make the view of an image in which the search found nothing."""
    return View(
        ImageFacts(width_px, height_px, camera=camera),
        Detections(np.zeros((0, 5)), np.zeros(0)),
        card=made_card(5.0),
        options=ScaleOptions.of(options),
        measure_detail_share=lambda *_: 1.0,
    )


def measured(ruler: Ruler, view: View) -> Witness:
    """Measure with a ruler that has something to report."""
    return found_witness(ruler.measure(view))


def log_sd(witness: Witness) -> float:
    """Compute the standard deviation of a witness's log scale from its interval."""
    assert witness.interval is not None
    return math.log(witness.interval.high / witness.interval.low) / (2 * Z95)
