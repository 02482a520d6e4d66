"""From log odds to a reference length: ``python -m training.fleet.calibrate MODEL.onnx``, MODEL the exported detector.

Writes ``RUN/fleet_lengths.json``, which ``training.fleet.export`` puts into the network's file. Of a
few settings it takes the one with the smallest mean error on the train images, every set counting alike. North
America's images are judged by the network of the fold that has not learned from them, the others by the network that
has never seen their set: as images of a new camera will be.
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

from training.detector.calibrate import REGION_OF_SET
from training.fleet.data import N_FOLDS, NORTH_AMERICA, fold_of
from vehanchor.detection.detector import Detector
from vehanchor.detection.look import MAX_CHIPS, FleetLengths, vehicle_chips
from vehanchor.estimate import analyse_scale
from vehanchor.imagery.raster import open_raster
from vehanchor_evaluation.gsd import KnownScaleImage, read_table

_LABELLED = 5  # cars of an image that counts
_LOG_ODDS = np.arange(-2.0, 3.01, 0.25)
_NEUTRAL_VEHICLES = (1.0, 2.0, 4.0)
_MANY_CARS = 20  # in such an image next to all of the error is the fleet's


class FleetCase(NamedTuple):
    """An image's vehicles: log odds from a network that has not seen it or its set, and their true modal length."""

    set: str
    log_odds: NDArray[np.float64]  # [n]
    length_m: float


def collect(images: list[KnownScaleImage], detector: Detector, run: Path) -> list[FleetCase]:
    """The train images with at least five labelled cars and a scale."""
    names = [f"fold-{fold}" for fold in range(N_FOLDS)] + [f"without-{n}" for n in REGION_OF_SET if n != NORTH_AMERICA]
    networks = {name: onnxruntime.InferenceSession(run / f"{name}.onnx") for name in names}
    cases = []
    for image in images:
        if image.split != "train" or image.set not in REGION_OF_SET or (image.labelled_vehicles or 0) < _LABELLED:
            continue
        analysis = analyse_scale(image.path, detector=detector)
        if analysis.estimate.mode_length_px is None:
            continue
        boxes = analysis.detections.boxes[analysis.kept][:MAX_CHIPS]
        with open_raster(image.path) as raster:
            chips = vehicle_chips(raster, boxes)
        judge = f"without-{image.set}"
        if image.set == NORTH_AMERICA:
            judge = f"fold-{fold_of(image.path.name, image.set)}"
        odds = networks[judge].run(["log_odds"], {"chips": chips})[0]
        length = analysis.estimate.mode_length_px * image.gsd_m_per_px
        cases.append(FleetCase(image.set, np.asarray(odds, dtype=np.float64), length))
    return cases


def log_errors(cases: list[FleetCase], lengths: FleetLengths) -> NDArray[np.float64]:
    """Log of the reference length over the true modal length, ``[n]``."""
    return np.array([np.log(lengths.reference_length(case.log_odds) / case.length_m) for case in cases])


def mean_error(cases: list[FleetCase], errors: NDArray[np.float64]) -> float:
    """Mean relative error, every set counting alike."""
    names = np.array([case.set for case in cases])
    wrong = np.abs(np.expm1(errors))
    return float(np.mean([wrong[names == name].mean() for name in np.unique(names)]))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("--run", type=Path, default=Path("runs/fleet"))
    parser.add_argument("--table", type=Path, default=Path("../shared/data/gsd/table.csv"))
    options = parser.parse_args()
    detector = Detector(options.model)
    cases = collect(read_table(options.table), detector, options.run)
    regions = detector.card.region_lengths_m
    others = [np.log(regions[region]) for name, region in REGION_OF_SET.items() if name != NORTH_AMERICA]
    ends = (round(float(np.exp(np.mean(others))), 4), regions[REGION_OF_SET[NORTH_AMERICA]])
    ranked = []
    for low, high, neutral in itertools.product(_LOG_ODDS, _LOG_ODDS, _NEUTRAL_VEHICLES):
        if low < high:
            lengths = FleetLengths((float(low), float(high)), ends, 0.0, neutral)
            ranked.append((mean_error(cases, log_errors(cases, lengths)), lengths))
    ranked.sort(key=lambda pair: pair[0])
    for error, lengths in ranked[:5]:
        print(f"{error:.4f} {lengths}")
    best = ranked[0][1]
    rest = log_errors([case for case in cases if len(case.log_odds) >= _MANY_CARS], best)
    best = best._replace(sd_m=round(float(np.std(rest) * np.mean(ends)), 4))
    fixed = best._replace(length_m=(detector.card.reference_length_m,) * 2)
    for name, choice in (("one length", fixed), ("by fleet", best)):
        wrong = np.abs(np.expm1(log_errors(cases, choice)))
        print(f"{name}: {len(cases)} images, median error {np.median(wrong):.4f}, mean {wrong.mean():.4f}")
    for name in REGION_OF_SET:
        means, logs = np.array([(c.log_odds.mean(), np.log(c.length_m)) for c in cases if c.set == name]).T
        within = np.corrcoef(means, logs)[0, 1]
        print(f"{name}: mean log odds {np.mean(means):+.2f}, correlation with the length within the set {within:+.2f}")
    out = options.run / "fleet_lengths.json"
    out.write_text(json.dumps(best._asdict(), indent=2) + "\n")
    print(out.read_text())


if __name__ == "__main__":
    main()
