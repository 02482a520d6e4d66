"""Fit how a network's answers combine.

``python -m research.training.scene_scale.calibrate OUT.json CASES.npz ...``.

The cases (``cases.py``) should be of networks that never saw the sets they are asked about: what
the shipped network says of a new place is as good as that. Every set counts alike. Fitted are the
mean log density at the truth and the share of intervals that hold it.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from research.training.scene_scale.bins import FIRST_LOG_GSD, LOG_STEP
from research.training.scene_scale.cases import Case, load
from vehanchor.detection.scene_scale import SceneCalibration, scene_density
from vehanchor.scale.density import GRID, credible_interval
from vehanchor.scale.density import LOG_STEP as GRID_STEP
from vehanchor.storage.atomic import whole_file

BEGIN = SceneCalibration(FIRST_LOG_GSD, LOG_STEP, doubt=0.01)
# Fields that the network determines, which are not fitted.
_OF_BINS = ("first_log_gsd", "log_step")
_CHOICES: dict[str, Sequence[float]] = {
    "temperature": tuple(np.exp(np.linspace(np.log(0.35), np.log(3.5), 13))),
    "levels": (0.0, 0.25, 0.5, 0.75, 1.0),
    "doubt": (0.0, 0.005, 0.01, 0.015, 0.02, 0.03),
    "floor": (0.005, 0.01, 0.02),
    "finer": (0.0, 0.1, 0.2, 0.3, 0.4, 0.5),
}
_ROUNDS = 2
_MIN_COVER = 0.9
_COVER_WEIGHT = 2.0
# Images that a set needs, so that its coverage counts.
_MIN_CASES = 15
_WITHIN = 1.5


def density_of(case: Case, calibration: SceneCalibration) -> NDArray[np.float64]:
    """Combine what was seen on an image's tiles, as the library does."""
    levels = [
        (factor, log_probs.astype(np.float64).mean(axis=0))
        for factor, log_probs in zip(case.factors, case.log_probs, strict=True)
    ]
    return scene_density(levels, calibration)


def log_score(cases: Sequence[Case], calibration: SceneCalibration) -> float:
    """Compute the mean log density (per unit of log m/px) at the truth, every set alike."""
    scores: dict[str, list[float]] = {}
    for case in cases:
        density = density_of(case, calibration)
        truth_bin = int(np.argmin(np.abs(GRID - np.log(case.gsd_m_per_px))))
        score = float(np.log(density[truth_bin] / GRID_STEP))
        scores.setdefault(case.set, []).append(score)
    return float(np.mean([np.mean(of_set) for of_set in scores.values()]))


def least_cover(cases: Sequence[Case], calibration: SceneCalibration) -> float:
    """Compute the share of intervals that hold the truth, in the set where it is lowest."""
    held: dict[str, list[bool]] = {}
    for case in cases:
        _, low, high = _row(case, calibration)
        held.setdefault(case.set, []).append(low < 0 < high)
    return float(min(np.mean(of_set) for of_set in held.values() if len(of_set) >= _MIN_CASES))


def fit(cases: Sequence[Case]) -> SceneCalibration:
    """Find the calibration of the highest score by coordinate ascent.

    Where intervals hold in less than ``_MIN_COVER`` of a set's images, that weighs against it.
    """

    def worth(option: SceneCalibration) -> float:
        lacking = max(0.0, _MIN_COVER - least_cover(cases, option))
        return log_score(cases, option) - _COVER_WEIGHT * lacking

    best = BEGIN
    for _, (name, values) in itertools.product(range(_ROUNDS), _CHOICES.items()):
        options = [replace(best, **{name: float(value)}) for value in values]
        best = max(options, key=worth)
    return best


def report(cases: Sequence[Case], calibration: SceneCalibration) -> list[str]:
    """Accuracy and cover by set, for images as they are and for reduced ones."""
    lines = [
        "set                   images  median |log error|  within 1.5  interval holds  median "
        "high/low"
    ]
    for reduced in (False, True):
        for name in (*sorted({case.set for case in cases}), "all"):
            selected = [
                case for case in cases if case.reduced == reduced and name in (case.set, "all")
            ]
            if not selected:
                continue
            rows = np.array([_row(case, calibration) for case in selected])
            error, low, high = rows.T
            held = np.mean((low < 0) & (high > 0))
            right = np.mean(np.abs(error) < np.log(_WITHIN))
            lines.append(
                f"{name:12s} {'reduced' if reduced else 'as it is':8s} {len(selected):6d}"
                f"  {np.median(np.abs(error)):18.3f}  {right:10.0%}  {held:14.0%}"
                f"  {np.median(np.exp(high - low)):15.2f}"
            )
    return lines


def _row(case: Case, calibration: SceneCalibration) -> tuple[float, float, float]:
    """Compute the logs of the density's median and of its interval's ends over the truth."""
    density = density_of(case, calibration)
    median = np.interp(0.5, np.cumsum(density), GRID + GRID_STEP / 2)
    low, high = np.log(credible_interval(density)) - np.log(case.gsd_m_per_px)
    error = median - np.log(case.gsd_m_per_px)
    return float(error), float(low), float(high)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "out", type=Path, help="JSON; where it exists already it is used, not fitted again"
    )
    parser.add_argument("cases", type=Path, nargs="+")
    options = parser.parse_args()
    cases = [case for path in options.cases for case in load(path)]
    if options.out.exists():
        calibration = replace(BEGIN, **json.loads(options.out.read_text()))
    else:
        calibration = fit(cases)
        with whole_file(options.out) as partial:
            fitted = {
                name: value for name, value in asdict(calibration).items() if name not in _OF_BINS
            }
            partial.write_text(json.dumps(fitted))
    print(f"{calibration}, log score {log_score(cases, calibration):.3f}")
    print("\n".join(report(cases, calibration)))


if __name__ == "__main__":
    main()
