"""The preset ``paper``: the paper's method to the letter, computed here again from its description."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import gaussian_kde

import vehanchor
from tests.conftest import ROOT
from tests.records import CASES
from vehanchor.detection.detector import Detector
from vehanchor.detection.search import search
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.zoo import resolve_model
from vehanchor.options import ScaleOptions, Search

LENGTH_M, WEIGHTS = 5.045, {"sample": 0.35, "concentration": 0.35, "quality": 0.20, "plausibility": 0.10}


@pytest.fixture(scope="module")
def detector() -> Detector:
    return Detector(resolve_model())


@pytest.mark.parametrize("scene", CASES)
def test_the_preset_gives_the_papers_numbers(scene: Path, detector: Detector) -> None:
    record = vehanchor.estimate_gsd(scene, detector=detector, preset="paper")
    with open_raster(str(ROOT / scene)) as raster:
        found = search(raster, detector, Search(min_score=0.1, search_scales=False, verify=False, effort="full"))
    lengths = found.boxes[:, 2]
    kept = lengths[lengths <= 1.5 * np.median(lengths)]
    assert record.n_vehicles == len(kept) >= 5
    points = np.linspace(kept.min(), kept.max(), 20_000)
    mode = float(points[np.argmax(gaussian_kde(kept)(points))])  # Scott's rule
    assert record.mode_length_px == pytest.approx(mode, rel=1e-3)
    assert record.mode_length_px is not None
    assert record.gsd_m_per_px == pytest.approx(LENGTH_M / record.mode_length_px, rel=1e-12)
    assert record.details.confidence_terms is not None
    terms = record.details.confidence_terms.model_dump()
    total = sum(weight * terms[name] for name, weight in WEIGHTS.items())
    guarded = record.mode_length_px < max(LENGTH_M / 0.3, detector.card.min_length_px)
    assert record.details.resolution_guard == guarded
    assert record.confidence == pytest.approx(min(total, 0.3) if guarded else total, rel=1e-12)
    assert record.details.composite_confidence == record.confidence
    assert record.status == ("ok" if record.confidence >= 0.5 else "low_confidence")
    assert (record.details.reference_length_m, record.details.aggregation) == (LENGTH_M, "kde")
    assert record.details.tiles_searched == record.details.tiles_total
    assert [ruler.kind for ruler in record.rulers] == ["vehicles"]


@pytest.mark.parametrize(
    "other",
    [
        {"alpha": 2.0},
        {"alpha": None},
        {"region": "europe"},
        {"rulers": ("courts",)},
        {"height_m": 50.0},
        {"drop": (1,)},
    ],
)
def test_the_preset_takes_no_other_value_of_its_options(other: dict[str, Any]) -> None:
    with pytest.raises(InvalidParameterError, match=f"the preset paper sets {next(iter(other))}"):
        ScaleOptions.of({"preset": "paper", **other})


def test_options_beside_the_preset_are_free_and_defaults_are_no_conflict() -> None:
    chosen = ScaleOptions.of({"preset": "paper", "alpha": 1.5, "effort": "auto", "known_lengths": [], "bgr": True})
    assert (chosen.search.effort, chosen.reading.bgr, chosen.rulers.rulers) == ("full", True, ("vehicles",))
    assert chosen.with_keywords({"bgr": False}).method.preset == "paper"
    with pytest.raises(InvalidParameterError, match="sets region"):
        chosen.with_keywords({"region": "europe"})


def test_an_unknown_preset_is_refused() -> None:
    with pytest.raises(InvalidParameterError, match="preset is 'essay': use one of paper"):
        ScaleOptions.of({"preset": "essay"})
