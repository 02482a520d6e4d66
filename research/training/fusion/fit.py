"""Fit how a detector's boxes vote: ``python -m research.training.fusion.fit DETECTOR.onnx``.

Searches the held-out tenth of all train images of known scale, the unlabelled ones included, and looks at their ground.
A box of a car's length in metres is taken for a car. The chance of that follows from the score by logistic regression;
the other numbers (``vehanchor.scale.fusion.Votes``) are those under which the true scales are most likely, among those
whose 95 % intervals hold 95 of 100. The result becomes ``vehanchor.votes`` of the detector's file.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnx
from numpy.typing import NDArray
from scipy.optimize import minimize

from research.training.detector.data import is_dev
from vehanchor.detection.detector import Detector, load_detector
from vehanchor.detection.scene_scale import SceneScaleNetwork, load_scene_scale
from vehanchor.detection.search import search
from vehanchor.imagery.facts import image_facts
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ScaleOptions, Search
from vehanchor.rulers.evidence import View
from vehanchor.rulers.vehicles import Vehicles
from vehanchor.scale.fusion import (
    GRID,
    LOG_STEP,
    TOLERANCE,
    Votes,
    credible_interval,
    mass_within,
    product,
    recalibrated,
    vehicle_density,
)
from vehanchor.storage.atomic import whole_file

_CAR_M = (3.0, 6.3)  # between these a box of known scale is taken for a car
_COVER = 0.95
_CERTAINTIES = tuple(np.arange(0.5, 2.51, 0.05).round(2).tolist())
_LOG_SDS, _CLUTTER, _TRUST, _WRONG = (0.10, 0.13, 0.16), (0.3, 0.6, 1.0), (0.3, 0.45, 0.6, 0.8), (0.02, 0.05, 0.1)


class Case(NamedTuple):
    """Image with at least one detection."""

    set: str
    gsd_m_per_px: float
    lengths_px: NDArray[np.float64]
    scores: NDArray[np.float64]
    reference_m: float
    reference_log_sds: tuple[float, float]
    scene: NDArray[np.float64]
    estimate_m_per_px: float


def known_images(data: Path, split: str) -> list[tuple[Path, str, float]]:
    """List files, sets and true scales of the held-out tenth of train, or of val."""
    tables = [(data / "gsd" / name, data / "gsd") for name in ("table.csv", "upright.csv")]
    rows = []
    for table, folder in [*tables, (data / "unlabelled" / "index.csv", data / "unlabelled")]:
        with table.open(newline="") as handle:
            for row in csv.DictReader(handle):
                if row.get("split", "train") == split and (split != "train" or is_dev(row["file"], row["set"])):
                    rows.append((folder / row["file"], row["set"], float(row["gsd_m_per_px"])))
    return rows


def measured_case(path: Path, set_name: str, gsd: float, detector: Detector, ground: SceneScaleNetwork) -> Case | None:
    """Measure an image with the vehicles alone; None without a scale."""
    options = ScaleOptions()
    with open_raster(path) as raster:
        prior = ground.predict(raster)
        detections = search(raster, detector, Search(), prior=prior)
        view = View(image_facts(raster), detections, detector.card, options, lambda *_: 1.0, prior=prior)
        evidence = Vehicles().measure(view)
    if evidence.gsd_m_per_px is None:
        return None
    lengths, reference = detections.boxes[:, 2], evidence.reference
    density = prior.density
    return Case(
        set_name, gsd, lengths, detections.scores, reference.length_m, reference.log_sds, density, evidence.gsd_m_per_px
    )


def car_chance(cases: list[Case]) -> tuple[float, float]:
    """Log odds at score 0, and what a score of 1 adds."""
    scores = np.concatenate([case.scores for case in cases])
    metres = np.concatenate([case.lengths_px * case.gsd_m_per_px for case in cases])
    car = (metres > _CAR_M[0]) & (metres < _CAR_M[1])

    def surprise(odds: NDArray[np.float64]) -> float:
        log_odds = odds[0] + odds[1] * scores
        return float(np.mean(np.logaddexp(0, np.where(car, -log_odds, log_odds))))

    found = minimize(surprise, [-3.0, 6.0], method="Nelder-Mead").x
    return float(found[0]), float(found[1])


class Verdict(NamedTuple):
    """Quality of densities: mean log density at the truth, coverage and width of intervals."""

    log_density: float
    cover: float
    width: float


def judged(cases: list[Case], votes: Votes) -> tuple[Verdict, NDArray[np.float64], NDArray[np.bool_]]:
    """Evaluate votes; also return each case's probability of an error below 20 % and the outcome."""
    logs, held, widths, chances, right = [], [], [], [], []
    for case in cases:
        said = vehicle_density(case.lengths_px, case.scores, case.reference_m, case.reference_log_sds, votes)
        density = product(said, case.scene)
        low, high = credible_interval(density)
        low, high = min(low, case.estimate_m_per_px), max(high, case.estimate_m_per_px)
        logs.append(np.log(density[np.argmin(np.abs(GRID - np.log(case.gsd_m_per_px)))] / LOG_STEP + 1e-9))
        held.append(low <= case.gsd_m_per_px <= high)
        widths.append(high / low)
        chances.append(mass_within(density, case.estimate_m_per_px, TOLERANCE))
        right.append(abs(case.estimate_m_per_px / case.gsd_m_per_px - 1) < TOLERANCE)
    verdict = Verdict(float(np.mean(logs)), float(np.mean(held)), float(np.median(widths)))
    return verdict, recalibrated(chances, votes.sharpness), np.array(right)


def best_certainty(chances: NDArray[np.float64], right: NDArray[np.bool_]) -> float:
    """Fit the exponent of the odds by maximum likelihood."""

    def likelihood(sharpness: float) -> float:
        said = recalibrated(chances, sharpness)
        return float(np.sum(np.log(np.where(right, said, 1 - said))))

    return max(_CERTAINTIES, key=likelihood)


def best_votes(cases: list[Case]) -> Votes:
    """Choose the votes of the highest likelihood among those with sufficient coverage."""
    zero, slope = car_chance(cases)
    trials = []
    for log_sd, clutter, trust, wrong in itertools.product(_LOG_SDS, _CLUTTER, _TRUST, _WRONG):
        votes = Votes(zero, slope, log_sd, clutter, trust, wrong)
        trials.append((judged(cases, votes)[0], votes))
    enough = [trial for trial in trials if trial[0].cover >= _COVER]
    votes = max(enough or trials, key=lambda trial: trial[0].log_density if enough else trial[0].cover)[1]
    _, chances, right = judged(cases, votes)
    return votes._replace(sharpness=best_certainty(chances, right))


def tell(name: str, cases: list[Case], votes: Votes) -> None:
    """Print the quality and a reliability table of five equal bins."""
    verdict, chances, right = judged(cases, votes)
    print(f"{name}: {len(cases)} images, log density {verdict.log_density:.3f}, cover {verdict.cover:.3f}, ", end="")
    print(f"median width {verdict.width:.2f}, Brier {np.mean((chances - right) ** 2):.3f}")
    for part in np.array_split(np.argsort(chances), 5):
        print(f"  said {chances[part].mean():.2f}, was {right[part].mean():.2f}")


def write(path: Path, votes: Votes) -> None:
    """Put the votes into the detector's file; its graph stays as it is."""
    model = onnx.load(path)
    lognormal_evidence = {entry.key: entry.value for entry in model.metadata_props}
    onnx.helper.set_model_props(model, lognormal_evidence | {"vehanchor.votes": json.dumps(votes._asdict())})
    with whole_file(path) as partial:
        onnx.save(model, partial)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("detector", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument(
        "--only-report", action="store_true", help="judge the votes that the file has, on held-out and val"
    )
    options = parser.parse_args()
    detector, ground = load_detector(options.detector), load_scene_scale()
    if ground is None:
        raise SystemExit(
            "the network of scene scale is missing: train and export it first (research/training/scene_scale)"
        )
    seen = [measured_case(*image, detector, ground) for image in known_images(options.data, "train")]
    held_out = [case for case in seen if case is not None]
    votes = detector.card.votes if options.only_report else best_votes(held_out)
    if votes is None:
        raise SystemExit(f"{options.detector} has no votes yet: fit them first")
    print(votes)
    tell("held-out tenth", held_out, votes)
    if options.only_report:
        seen = [measured_case(*image, detector, ground) for image in known_images(options.data, "val")]
        tell("val", [case for case in seen if case is not None], votes)
    else:
        write(options.detector, votes)


if __name__ == "__main__":
    main()
