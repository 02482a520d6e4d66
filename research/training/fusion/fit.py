"""Fit how a detector's boxes vote: ``python -m research.training.fusion.fit RUN DETECTOR.onnx``.

Reads the searches that ``research.training.fusion.cases`` has kept in ``RUN``. A box of a car's length in metres is
taken for a car: the chance of that follows from the score by logistic regression. The other numbers
(``vehanchor.scale.fusion.Votes``) are those under which the true scales are likeliest, few vehicles and many counting
alike. The 95 % intervals must hold 95 of 100 true scales of both, and of 100 photographs with a usable scale from few
vehicles at most two may be wrong. The result becomes ``vehanchor.votes`` of the detector's file.

In a place without training images a box is less often a car than on the held-out tenth: the log odds fall.
Prints what each fall brings, with each place left out in turn, and the reliability on
``fit`` and ``val``. Without a detector, it only reports.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnx
from numpy.typing import NDArray
from scipy.optimize import minimize

from vehanchor.detection.card import DetectorCard
from vehanchor.detection.detector import Detector, load_detector
from vehanchor.imagery.identity import Source
from vehanchor.options import ScaleOptions
from vehanchor.rulers.vehicles import VehicleEvidence
from vehanchor.scale.fusion import (
    GRID,
    LOG_STEP,
    TOLERANCE,
    USABLE_CHANCE,
    Votes,
    credible_interval,
    mass_within,
    median_near,
    product,
    recalibrated,
    vehicle_density,
)
from vehanchor.scale.lengths import MIN_KDE_VEHICLES
from vehanchor.scale.thresholds import WIDEST_USABLE
from vehanchor.storage.atomic import whole_file
from vehanchor_evaluation.gsd import ScaleTrial
from vehanchor_evaluation.known_scale import KnownScaleImage
from vehanchor_evaluation.reliability import group_row, report_reliability, upper_bound
from vehanchor_evaluation.report import group_table, reliability_markdown
from vehanchor_evaluation.search import SearchedImage, open_detection_log
from vehanchor_evaluation.table import read_table

_CAR_M = (3.0, 6.3)  # between these a box of known scale is taken for a car
_COVER = 0.95
_WRONG_SHARE = 0.02  # of photographs with a usable scale from few vehicles
_SHARPNESSES = tuple(np.arange(1.0, 2.51, 0.05).round(2).tolist())  # less would blunt the chances of many cars
_LOG_SDS, _TRUST = (0.07, 0.10), (0.6, 0.8, 1.0)
_CLUTTER, _WRONG = 1.0, 0.02
_STEEPER = (1.0, 1.25, 1.5)  # factor on the log odds of a car
_NUMBERS = ((1, 1), (2, 2), (3, 4), (5, 12), (13, 10_000))  # of vehicles, in reports
_NEW_PLACE = (0.0, 1.5, 3.0, 4.5)  # the log odds of a car fall by this much in a place of no training image


class Searched(NamedTuple):
    """An image of known scale with its search."""

    image: KnownScaleImage
    found: SearchedImage


class Case(NamedTuple):
    """An image in which something was found, without doubts about the vehicles.

    Attributes:
        set: its place.
        photograph: from which it was cut; windows of one photograph err alike.
        gsd_m_per_px: its true scale.
        vehicles: their evidence.
        scene: ``[g]`` density of the scene-scale prior.
    """

    set: str
    photograph: str
    gsd_m_per_px: float
    vehicles: VehicleEvidence
    scene: NDArray[np.float64]

    @property
    def place(self) -> str:
        """The place; crops and copies of one photograph count together."""
        return self.set.split("_")[0]

    @property
    def few(self) -> bool:
        """Whether the vehicles are fewer than five."""
        return self.vehicles.n < MIN_KDE_VEHICLES

    def estimate_m_per_px(self, posterior: NDArray[np.float64]) -> float:
        """Choose the scale as the library does."""
        assert self.vehicles.gsd_m_per_px is not None
        return median_near(self.vehicles.gsd_m_per_px, posterior) if self.few else self.vehicles.gsd_m_per_px


class Outcomes(NamedTuple):
    """What votes say of cases, and what happened.

    Attributes:
        log_density: ``[n]`` at the true scale.
        held: ``[n]`` whether the interval holds it.
        width: ``[n]`` of the interval, high over low.
        mass: ``[n]`` within the tolerance, before recalibration.
        error: ``[n]`` relative.
    """

    log_density: NDArray[np.float64]
    held: NDArray[np.bool_]
    width: NDArray[np.float64]
    mass: NDArray[np.float64]
    error: NDArray[np.float64]

    @property
    def right(self) -> NDArray[np.bool_]:
        """``[n]`` whether the error is within the tolerance."""
        return self.error < TOLERANCE

    def usable(self, sharpness: float) -> NDArray[np.bool_]:
        """``[n]`` whether the scales may be used."""
        return (recalibrated(self.mass, sharpness) >= USABLE_CHANCE) & (self.width <= WIDEST_USABLE)


def kept_searches(run: Path, split: str, detector: Detector) -> list[Searched]:
    """Read the searches of a split."""
    log = open_detection_log(run / f"{split}.jsonl", detector, ScaleOptions())
    found = ((image, log.get(Source.of(image.path))) for image in read_table(run / f"{split}.csv"))
    return [Searched(image, each) for image, each in found if each is not None]


def photograph_of(picture: Path) -> str:
    """Name the photograph of a window or of a reduced copy; see ``research.training.fusion.cases``."""
    if picture.suffix != ".png":
        return picture.stem
    return picture.stem.rsplit("_", 1)[0].split("_", 1)[1].removeprefix("crops_").removeprefix("copies_")


def cases_of(searched: Sequence[Searched], card: DetectorCard) -> list[Case]:
    """Measure the vehicles of each image; leave out images without any, and doubtful ones, which are limited anyway."""
    cases = []
    for image, found in searched:
        vehicles = found.analysis(card, ScaleOptions()).vehicles
        if vehicles.gsd_m_per_px is None or found.prior is None or vehicles.guarded or vehicles.disputed:
            continue
        cases.append(Case(image.set, photograph_of(image.path), image.gsd_m_per_px, vehicles, found.prior.density))
    return cases


def car_chance(cases: Sequence[Case]) -> tuple[float, float]:
    """Fit the log odds of a car at score 0, and their increase to a score of 1."""
    detections = [case.vehicles.fleet.detections for case in cases]
    scores = np.concatenate([each.scores for each in detections])
    metres = np.concatenate(
        [each.boxes[:, 2] * case.gsd_m_per_px for each, case in zip(detections, cases, strict=True)]
    )
    car = (metres > _CAR_M[0]) & (metres < _CAR_M[1])

    def surprise(odds: NDArray[np.float64]) -> float:
        log_odds = odds[0] + odds[1] * scores
        return float(np.mean(np.logaddexp(0, np.where(car, -log_odds, log_odds))))

    found = minimize(surprise, [-3.0, 6.0], method="Nelder-Mead").x
    return float(found[0]), float(found[1])


def outcomes(cases: Sequence[Case], votes: Votes) -> Outcomes:
    """Apply votes to cases."""
    rows = []
    for case in cases:
        found, reference = case.vehicles.fleet.detections, case.vehicles.reference
        said = vehicle_density(found.boxes[:, 2], found.scores, reference.length_m, reference.log_sds, votes)
        density = product(said, case.scene)
        estimate = case.estimate_m_per_px(density)
        low, high = credible_interval(density)
        low, high = min(low, estimate), max(high, estimate)
        rows.append(
            (
                np.log(density[np.argmin(np.abs(GRID - np.log(case.gsd_m_per_px)))] / LOG_STEP + 1e-9),
                low <= case.gsd_m_per_px <= high,
                high / low,
                mass_within(density, estimate, TOLERANCE),
                abs(estimate / case.gsd_m_per_px - 1),
            )
        )
    logs, held, width, mass, error = (np.array(column) for column in zip(*rows, strict=True))
    return Outcomes(logs, held.astype(bool), width, mass, error)


def best_sharpness(chances: NDArray[np.float64], right: NDArray[np.bool_]) -> float:
    """Find the factor on the log odds under which the outcomes are likeliest."""

    def likelihood(sharpness: float) -> float:
        said = recalibrated(chances, sharpness)
        return float(np.sum(np.log(np.where(right, said, 1 - said))))

    return max(_SHARPNESSES, key=likelihood)


def candidates(cases: Sequence[Case]) -> dict[Votes, tuple[float, Outcomes]]:
    """Apply all candidate votes; with the fall of the log odds in a new place."""
    zero, slope = car_chance([case for case in cases if case.few])
    print(f"log odds of a car among few boxes: {zero:.2f} + {slope:.2f} score")
    found = {}
    for log_sd, trust, steeper, fall in itertools.product(_LOG_SDS, _TRUST, _STEEPER, _NEW_PLACE):
        votes = Votes(steeper * zero - fall, steeper * slope, log_sd, _CLUTTER, trust, _WRONG)
        found[votes] = (fall, outcomes(cases, votes))
    return found


def best_votes(
    applied: dict[Votes, tuple[float, Outcomes]],
    few: NDArray[np.bool_],
    among: NDArray[np.bool_],
    photographs: NDArray[np.str_],
    fall: float | None = None,
) -> Votes:
    """Choose votes from the outcomes of some cases.

    Args:
        applied: fall of the log odds and outcomes by votes.
        few: ``[n]`` whether a case has fewer than five vehicles.
        among: ``[n]`` the cases to choose from.
        photographs: ``[n]`` of the cases.
        fall: of the log odds in a new place; None for any.

    Returns:
        The likeliest votes of those that keep the limits; if none does, those of the widest intervals.
    """

    def mean(values: NDArray[np.float64] | NDArray[np.bool_]) -> float:
        return float(np.mean([values[among & group].mean() for group in (few, ~few) if (among & group).any()]))

    def wrong_share(votes: Votes, seen: Outcomes) -> float:
        usable = seen.usable(votes.sharpness) & among & few
        wrong = np.unique(photographs[usable & ~seen.right])
        return len(wrong) / max(1, len(np.unique(photographs[usable])))

    some = {
        votes._replace(sharpness=best_sharpness(seen.mass[among], seen.right[among])): seen
        for votes, (own_fall, seen) in applied.items()
        if fall is None or fall == own_fall
    }
    enough = {
        votes: seen
        for votes, seen in some.items()
        if all(seen.held[among & group].mean() >= _COVER for group in (few, ~few) if (among & group).any())
        and (fall is not None or wrong_share(votes, seen) <= _WRONG_SHARE)
    }
    if not enough:
        return max(some, key=lambda votes: mean(some[votes].held))
    return max(enough, key=lambda votes: mean(enough[votes].log_density))


def told(name: str, seen: Outcomes, chances: NDArray[np.float64], among: NDArray[np.bool_]) -> str:
    """Describe outcomes in a line."""
    chance, right = chances[among], seen.right[among]
    usable = (chance >= USABLE_CHANCE) & (seen.width[among] <= WIDEST_USABLE)
    wrong = int((usable & ~right).sum())
    bound = upper_bound(wrong, int(usable.sum())) or 1.0
    surprise = -np.mean(np.log(np.where(right, chance, 1 - chance)))
    held = seen.held[among]
    return (
        f"  {name}: {usable.sum()} of {len(usable)} usable, {wrong} wrong (below {bound:.1%}), "
        f"median error {np.median(seen.error[among]):.1%}, surprise {surprise:.3f}, "
        f"cover {held[usable].mean() if usable.any() else math.nan:.3f} usable, "
        f"{held[~usable].mean() if not usable.all() else math.nan:.3f} else"
    )


def report_left_out(
    cases: Sequence[Case], applied: dict[Votes, tuple[float, Outcomes]], judged: Sequence[Case], fall: float | None
) -> None:
    """Print outcomes by number of vehicles and by place; each place is judged by votes that the others chose.

    Args:
        cases: to choose from.
        applied: fall of the log odds and outcomes of ``cases`` by votes.
        judged: cases to judge, of the same places and others.
        fall: of the log odds in a new place; None for any.
    """
    few = np.array([case.few for case in cases])
    places = np.array([case.place for case in cases])
    photographs = np.array([case.photograph for case in cases])
    own = np.array([case.place for case in judged])
    parts, which = [], []
    for place in np.unique(own):
        votes = best_votes(applied, few, places != place, photographs, fall)
        which.append(np.flatnonzero(own == place))
        parts.append((outcomes([judged[k] for k in which[-1].tolist()], votes), votes.sharpness))
    back = np.argsort(np.concatenate(which))
    seen = Outcomes(*(np.concatenate(column)[back] for column in zip(*(part for part, _ in parts), strict=True)))
    chances = np.concatenate([recalibrated(part.mass, sharpness) for part, sharpness in parts])[back]
    print(f"each place left out, log odds fall by {'a chosen number' if fall is None else fall}")
    n = np.array([case.vehicles.n for case in judged])
    for low, high in _NUMBERS:
        among = (low <= n) & (n <= high)
        if among.any():
            print(told(f"{low} to {high} vehicles", seen, chances, among))
    for place in np.unique(own):
        for name, group in (("few", n < MIN_KDE_VEHICLES), ("five and more", n >= MIN_KDE_VEHICLES)):
            if (group & (own == place)).any():
                print(told(f"{place}, {name}", seen, chances, group & (own == place)))


def report(name: str, searched: Sequence[Searched], card: DetectorCard) -> None:
    """Print the reliability on images, by vehicles, by resolution and by place; and of few vehicles by place."""
    trials = [ScaleTrial(image, found.analysis(card, ScaleOptions())) for image, found in searched]
    print(reliability_markdown(report_reliability(name, card.name, trials)))
    few = [trial for trial in trials if 0 < trial.analysis.estimate.n_vehicles < MIN_KDE_VEHICLES]
    for heading, some in (("place", trials), ("place, few", few)):
        places = sorted({trial.image.set for trial in some})
        rows = [group_row(place, [trial for trial in some if trial.image.set == place]) for place in places]
        print(group_table(heading, rows))
    empty = [trial for trial in trials if trial.image.labelled_vehicles == 0]
    usable = [trial.image.path.name for trial in empty if trial.analysis.estimate.status == "ok"]
    print(f"without cars: {len(usable)} of {len(empty)} usable {usable}\n")


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
    parser.add_argument("run", type=Path)
    parser.add_argument("detectors", type=Path, nargs="*", help="files that get the votes; none: only report")
    options = parser.parse_args()
    (copy,) = (path for path in (options.run / "models").glob("*.onnx") if "." not in path.stem)
    detector = load_detector(copy)
    card = detector.card
    searched = {split: kept_searches(options.run, split, detector) for split in ("fit", "val")}
    if options.detectors:
        cases, judged = (cases_of(searched[split], card) for split in ("fit", "val"))
        few = np.array([case.few for case in cases])
        applied = candidates(cases)
        for fall in (*_NEW_PLACE, None):
            report_left_out(cases, applied, cases, fall)
        print("the same votes, val:")
        report_left_out(cases, applied, judged, None)
        votes = best_votes(applied, few, np.ones(len(cases), bool), np.array([case.photograph for case in cases]))
        print(votes)
        card = card.model_copy(update={"votes": votes})
        for path in options.detectors:
            write(path, votes)
    for split, some in searched.items():
        report(split, some, card)


if __name__ == "__main__":
    main()
