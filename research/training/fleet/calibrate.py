"""Calibrate the reference length from estimated vehicle lengths.

``python -m research.training.fleet.calibrate MODEL.onnx``.

MODEL is the exported detector. Writes ``RUN/fleet_lengths.json``; ``research.training.fleet.export`` puts it into the
network's file. The settings with the smallest mean error on the train images win; every set counts alike, and each
image is judged by the network of the fold that has not learned from it. The networks that have never seen an image's
set tell how far the settings hold elsewhere. The standard deviation covers both cases in equal parts: half of the
photographs to come are assumed to show known fleets.
"""

from __future__ import annotations

import argparse
import itertools
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from research.training.fleet.data import MEASURED, N_FOLDS, fold_of
from vehanchor import analyse_scale
from vehanchor.detection.appearance import MAX_CHIPS, FleetLengths, vehicle_chips
from vehanchor.detection.detector import Detector
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.storage.atomic import whole_file
from vehanchor_evaluation.known_scale import KnownScaleImage
from vehanchor_evaluation.table import survey_table

_LABELLED = 5  # cars of an image that counts
_RANGE_M = (3.6, 5.3)  # of fleets' modal lengths
_GAINS = (0.8, 1.0, 1.2, 1.4, 1.6, 1.8, 2.0)  # of the log of the reference length by that of the seeming length
_NEUTRAL_VEHICLES = (1.0, 2.0, 4.0)
_MANY_CARS = 20  # in such an image next to all of the error is the fleet's


class FleetCase(NamedTuple):
    """Vehicles of an image: estimated log lengths and true modal length in metres."""

    set: str
    log_lengths: NDArray[np.float64]  # [n]
    length_m: float


def collect(images: list[KnownScaleImage], detector: Detector, run: Path) -> tuple[list[FleetCase], list[FleetCase]]:
    """The train images with at least five labelled cars and a scale.

    Returns:
        As seen by a network that has learned from other images of their set, and by one that has never seen the set.
    """
    names = [f"fold-{fold}" for fold in range(N_FOLDS)] + [f"without-{name}" for name in MEASURED]
    networks = {name: onnxruntime.InferenceSession(run / f"{name}.onnx") for name in names}
    known: list[FleetCase] = []
    unseen: list[FleetCase] = []
    for image in images:
        if image.split != "train" or image.set not in MEASURED or (image.labelled_vehicles or 0) < _LABELLED:
            continue
        analysis = analyse_scale(image.path, detector=detector)
        if analysis.estimate.mode_length_px is None:
            continue
        boxes = analysis.detections.boxes[analysis.kept][:MAX_CHIPS]
        with open_raster(image.path) as raster:
            chips = vehicle_chips(raster, boxes)
        length = analysis.estimate.mode_length_px * image.gsd_m_per_px
        for cases, judge in (
            (known, f"fold-{fold_of(image.path.name, image.set)}"),
            (unseen, f"without-{image.set}"),
        ):
            seen = networks[judge].run(["log_length"], {"chips": chips})[0]
            cases.append(FleetCase(image.set, np.asarray(seen, dtype=np.float64), length))
    return known, unseen


def lengths_for(gain: float, neutral: float, cases: list[FleetCase]) -> FleetLengths:
    """The lengths of a gain, their middle such that the sets' median errors have no mean; ends where fleets end.

    The reference length is linear between the ends, as their logs are to two hundredths.
    """
    errors = {
        name: np.median([np.log(case.length_m) - gain * case.log_lengths.mean() for case in cases if case.set == name])
        for name in {case.set for case in cases}
    }
    offset = float(np.mean(list(errors.values())))
    low, high = ((np.log(end) - offset) / gain for end in _RANGE_M)
    return FleetLengths((round(float(low), 4), round(float(high), 4)), _RANGE_M, 0.0, neutral)


def log_errors(cases: list[FleetCase], lengths: FleetLengths) -> NDArray[np.float64]:
    """Log of the reference length over the true modal length, ``[n]``."""
    return np.array([np.log(lengths.reference_length(case.log_lengths) / case.length_m) for case in cases])


def mean_error(cases: list[FleetCase], errors: NDArray[np.float64]) -> float:
    """Mean relative error, every set counting alike."""
    names = np.array([case.set for case in cases])
    wrong = np.abs(np.expm1(errors))
    return float(np.mean([wrong[names == name].mean() for name in np.unique(names)]))


def spread(cases: list[FleetCase], lengths: FleetLengths) -> float:
    """Root mean square of the log errors on images with many cars, every set counting alike."""
    many = [case for case in cases if len(case.log_lengths) >= _MANY_CARS]
    squares = [
        np.mean(np.square(log_errors([case for case in many if case.set == name], lengths)))
        for name in sorted({case.set for case in many})
    ]
    return float(np.sqrt(np.mean(squares)))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("--run", type=Path, default=Path("runs/fleet"))
    parser.add_argument(
        "--tables", type=Path, nargs="+", default=[Path("../shared/data/gsd", n) for n in ("table.csv", "upright.csv")]
    )
    options = parser.parse_args()
    detector = Detector(options.model)
    images = [image for table in options.tables for image in survey_table(table).images]
    known, unseen = collect(images, detector, options.run)
    ranked = []
    for gain, neutral in itertools.product(_GAINS, _NEUTRAL_VEHICLES):
        lengths = lengths_for(gain, neutral, known)
        ranked.append((mean_error(known, log_errors(known, lengths)), gain, lengths))
    ranked.sort(key=lambda trial: trial[0])
    for error, gain, lengths in ranked[:5]:
        print(f"{error:.4f} gain {gain} {lengths}")
    best = ranked[0][2]
    best = best._replace(sd_m=round(spread(known + unseen, best) * detector.card.reference_length_m, 4))
    fixed = best._replace(length_m=(detector.card.reference_length_m,) * 2)
    for name, cases, choice in (("one length", known, fixed), ("set known", known, best), ("set unseen", unseen, best)):
        wrong = np.abs(np.expm1(log_errors(cases, choice)))
        print(f"{name}: {len(cases)} images, median error {np.median(wrong):.4f}, mean {wrong.mean():.4f}")
    for name in MEASURED:
        for kind, cases in (("known", known), ("unseen", unseen)):
            errors = log_errors([case for case in cases if case.set == name], best)
            print(f"{name} {kind}: {len(errors)} images, median log error {np.median(errors):+.3f}")
    out = options.run / "fleet_lengths.json"
    with whole_file(out) as partial:
        partial.write_text(json.dumps(best._asdict(), indent=2) + "\n")
    print(out.read_text())


if __name__ == "__main__":
    main()
