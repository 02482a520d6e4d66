"""Fit how a detector's boxes vote: ``python -m research.training.fusion.fit RUN [--fit]``.

Reads the searches that ``research.training.fusion.cases`` stored in ``RUN``. A box is a car with
odds that depend on its score (``vehanchor.scale.density.Votes``), and a car's length errs as the
detector's errors state. The odds make the true scales most likely, with equal weights of all
photographs. With ``--fit`` it prints them as the table ``votes`` of the detector's errors, and how
often the answer is usable, how many usable ones are wrong by more than 20 %, and how often the
interval holds, with votes that the other places chose. Without it, it only reports on the
detector's own votes.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from research.results.record import header
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.detection.card import DetectorCard
from vehanchor.detection.detector import Detector, load_detector
from vehanchor.models.zoo import resolve_model
from vehanchor.options import ScaleOptions
from vehanchor.scale.density import TOLERANCE, Votes
from vehanchor.scale.posterior import answer
from vehanchor.scale.reliability import appearance_error
from vehanchor.storage.journal import Source
from vehanchor_evaluation.known_scale import KnownScaleImage
from vehanchor_evaluation.reliability import upper_bound
from vehanchor_evaluation.search import SearchedImage, open_detection_log
from vehanchor_evaluation.table import survey_table

# Ranges of the number of vehicles, in reports.
_NUMBERS = ((0, 0), (1, 1), (2, 2), (3, 4), (5, 12), (13, 10_000))


class Searched(NamedTuple):
    """Image of known scale with its search."""

    image: KnownScaleImage
    search: SearchedImage

    @property
    def place(self) -> str:
        """Place; crops and copies of one photograph count together."""
        return self.image.set.split("_")[0]


class Boxes(NamedTuple):
    """Boxes of many images.

    Attributes:
        scores: ``[n]``.
        log_errors: ``[n]``, log of the length in metres if the box is a car, over its true length.
        log_sds: ``[n]``, standard deviations of these for cars.
        weight: ``[n]``, 1 for the boxes of one image together.
    """

    scores: NDArray[np.float64]
    log_errors: NDArray[np.float64]
    log_sds: NDArray[np.float64]
    weight: NDArray[np.float64]


class Outcome(NamedTuple):
    """Answer to one image, and whether it was right.

    Attributes:
        n: number of vehicles.
        usable: whether a planner may act on it.
        error: relative; nan without a scale.
        held: whether the interval holds the true scale.
    """

    n: int
    usable: bool
    error: float
    held: bool


def kept_searches(run: Path, split: str, detector: Detector) -> list[Searched]:
    """Read the searches of a split."""
    log = open_detection_log(run / f"{split}.jsonl", detector, ScaleOptions())
    searched = []
    for image in survey_table(run / f"{split}.csv").images:
        search = log.get(Source.of(image.path))
        if search is not None:
            searched.append(Searched(image, search))
    return searched


def boxes_of(searched: Sequence[Searched], card: DetectorCard) -> Boxes:
    """Collect the boxes of images that the chip network examined, with the errors of their lengths.

    Args:
        searched: the images.
        card: card of the detector, with the errors that it states.
    """
    errors = card.errors.appearance
    parts = []
    for image, search in searched:
        appearance = search.detections.appearance
        if appearance is None or len(appearance) == 0:
            continue
        n = len(appearance)
        scores = search.detections.scores[:n]
        true_lengths_m = search.detections.boxes[:n, 2] * image.gsd_m_per_px
        log_errors = appearance.log_lengths + errors.log_mean - np.log(true_lengths_m)
        factors = appearance_error(
            scores, fair_odds=errors.fair_odds, doubt_power=errors.doubt_power
        )
        log_sds = np.hypot(appearance.log_sds * factors, errors.fleet_log_sd(float(scores.sum())))
        parts.append(Boxes(scores, log_errors, log_sds, np.full(n, 1.0 / n)))
    return Boxes(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def fit_votes(boxes: Boxes) -> Votes:
    """Fit the log odds of a car at score 0, and their increase to a score of 1.

    A box that is no car has a density of 1 per unit of log length, as in
    ``vehanchor.scale.density.vehicle_likelihood``.
    """
    deviations = boxes.log_errors / boxes.log_sds
    norm = boxes.log_sds * math.sqrt(2 * math.pi)
    of_cars = np.exp(-0.5 * deviations**2) / norm

    def loss(parameters: NDArray[np.float64]) -> float:
        log_odds = parameters[0] + parameters[1] * boxes.scores
        p_car = 1.0 / (1.0 + np.exp(-log_odds))
        losses = -np.log(p_car * of_cars + 1.0 - p_car)
        return float(np.average(losses, weights=boxes.weight))

    best = minimize(loss, [-8.0, 12.0], method="Nelder-Mead").x
    return Votes(float(best[0]), float(best[1]))


def outcome(analysis: ScaleAnalysis, true_gsd_m_per_px: float) -> Outcome:
    """Decide on the scale by vehicles and priors alone, and compare it with the truth."""
    vehicles = analysis.vehicles
    assert vehicles is not None
    priors = [witness for witness in analysis.witnesses if not witness.sets_scale]
    scale = answer([vehicles, *priors])
    if scale is None:
        return Outcome(vehicles.n, usable=False, error=math.nan, held=False)
    error = abs(scale.gsd_m_per_px / true_gsd_m_per_px - 1)
    held = scale.interval.low <= true_gsd_m_per_px <= scale.interval.high
    return Outcome(vehicles.n, scale.usable, error=error, held=held)


def outcomes(searched: Sequence[Searched], card: DetectorCard) -> list[Outcome]:
    """Apply a card's votes to kept searches."""
    options = ScaleOptions()
    return [
        outcome(search.analysis(card, options), image.gsd_m_per_px) for image, search in searched
    ]


def row(name: str, results: Sequence[Outcome]) -> str:
    """Describe outcomes in a row of a table."""
    usable = [result for result in results if result.usable]
    scaled = [result for result in results if not math.isnan(result.error)]
    wrong = sum(result.error > TOLERANCE for result in usable)
    upper = upper_bound(wrong, len(usable))
    bound = "" if upper is None else f"{upper:.1%}"
    median = ""
    coverage = ""
    if scaled:
        median = f"{np.median([result.error for result in scaled]):.1%}"
        coverage = f"{np.mean([result.held for result in scaled]):.3f}"
    counts = f"{len(results)} | {len(usable)} | {wrong}"
    return f"| {name} | {counts} | {bound} | {median} | {coverage} |"


def report(name: str, searched: Sequence[Searched], cards: Sequence[DetectorCard]) -> None:
    """Print outcomes by number of vehicles and by place.

    Args:
        name: name of the images.
        searched: the images.
        cards: for each image, the detector's card with the votes to judge it by.
    """
    results = [outcomes([image], card)[0] for image, card in zip(searched, cards, strict=True)]
    columns = ("n", "ok", "wrong", "below", "median error", "interval holds")
    print(header(name, *columns))
    for low, high in _NUMBERS:
        in_range = [result for result in results if low <= result.n <= high]
        print(row(f"{low} to {high} vehicles", in_range))
    for place in sorted({image.place for image in searched}):
        at_place = [
            result for image, result in zip(searched, results, strict=True) if image.place == place
        ]
        print(row(place, at_place))
    print(row("all", results), end="\n\n", flush=True)


def left_out(searched: Sequence[Searched], card: DetectorCard) -> list[DetectorCard]:
    """Make the card of each image: its votes are fitted on the other places."""
    card_by_place = {}
    for place in {image.place for image in searched}:
        others = [image for image in searched if image.place != place]
        votes = fit_votes(boxes_of(others, card))
        card_by_place[place] = card.model_copy(update={"votes": votes})
    return [card_by_place[image.place] for image in searched]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--fit", action="store_true", help="fit the votes, and report with them")
    options = parser.parse_args()
    # The copy of the detector that made the searches; files of its auxiliary models have a dot.
    files = (options.run / "models").glob("*.onnx")
    (copy,) = [path for path in files if "." not in path.stem]
    detector = load_detector(copy)
    # The copy has no file of errors, so that the searches stay valid when these change.
    shipped = load_detector(resolve_model()).card
    card = detector.card.model_copy(update={"votes": shipped.votes, "errors": shipped.errors})
    searched = {split: kept_searches(options.run, split, detector) for split in ("fit", "val")}
    if options.fit:
        report("fit, each place left out", searched["fit"], left_out(searched["fit"], card))
        votes = fit_votes(boxes_of(searched["fit"], card))
        print(f"[votes]\nat_zero = {votes.share_at_zero:.2f}\nslope = {votes.share_slope:.2f}\n")
        card = card.model_copy(update={"votes": votes})
    for split, images in searched.items():
        report(split, images, [card] * len(images))


if __name__ == "__main__":
    main()
