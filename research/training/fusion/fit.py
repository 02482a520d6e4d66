"""Fit how a detector's boxes vote: ``python -m research.training.fusion.fit RUN DETECTOR.onnx``.

Reads the searches that ``research.training.fusion.cases`` stored in ``RUN``. A box with a
car's length in metres counts as a car. Logistic regression gives its log odds from its score
(``vehanchor.scale.density.Votes``), with equal weights of all photographs. The result becomes
``vehanchor.votes`` of the detector's file. Prints how often the answer is usable, how many usable
ones are wrong, and how often the interval holds the true scale: by number of vehicles, and by place
with votes that the other places chose. Without a detector, it only reports on the detector's own
votes.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnx
from numpy.typing import NDArray
from scipy.optimize import minimize

from research.results.record import header
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.detection.card import DetectorCard
from vehanchor.detection.detector import Detector, load_detector
from vehanchor.options import ScaleOptions
from vehanchor.scale.density import TOLERANCE, Votes
from vehanchor.scale.posterior import answer
from vehanchor.storage.atomic import whole_file
from vehanchor.storage.journal import Source
from vehanchor_evaluation.known_scale import KnownScaleImage
from vehanchor_evaluation.reliability import upper_bound
from vehanchor_evaluation.search import SearchedImage, open_detection_log
from vehanchor_evaluation.table import survey_table

# A box of known scale with a length in this range counts as a car.
_CAR_M = (3.0, 6.3)
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
        car: ``[n]`` bool, of a car's length.
        weight: ``[n]``, 1 for the boxes of one image together.
    """

    scores: NDArray[np.float64]
    car: NDArray[np.bool_]
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


def boxes_of(searched: Sequence[Searched]) -> Boxes:
    """Collect the boxes of images, and mark those that are as long as a car."""
    scores = [search.detections.scores for _, search in searched]
    lengths_m = np.concatenate(
        [search.detections.boxes[:, 2] * image.gsd_m_per_px for image, search in searched]
    )
    weights = [np.full(len(of_image), 1.0 / max(1, len(of_image))) for of_image in scores]
    is_car = (lengths_m > _CAR_M[0]) & (lengths_m < _CAR_M[1])
    return Boxes(np.concatenate(scores), is_car, np.concatenate(weights))


def fit_votes(boxes: Boxes) -> Votes:
    """Fit the log odds of a car at score 0, and their increase to a score of 1."""

    def cross_entropy(parameters: NDArray[np.float64]) -> float:
        log_odds = parameters[0] + parameters[1] * boxes.scores
        losses = np.logaddexp(0, np.where(boxes.car, -log_odds, log_odds))
        return float(np.average(losses, weights=boxes.weight))

    best = minimize(cross_entropy, [-3.0, 6.0], method="Nelder-Mead").x
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
        votes = fit_votes(boxes_of(others))
        card_by_place[place] = card.model_copy(update={"votes": votes})
    return [card_by_place[image.place] for image in searched]


def write(path: Path, votes: Votes) -> None:
    """Put the votes into the detector's file; its graph stays as it is."""
    model = onnx.load(path)
    properties = {entry.key: entry.value for entry in model.metadata_props}
    properties["vehanchor.votes"] = json.dumps(votes._asdict())
    onnx.helper.set_model_props(model, properties)
    with whole_file(path) as partial:
        onnx.save(model, partial)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument(
        "detectors", type=Path, nargs="*", help="files that get the votes; without any, only report"
    )
    options = parser.parse_args()
    # The copy of the detector that made the searches; files of its auxiliary models have a dot.
    files = (options.run / "models").glob("*.onnx")
    (copy,) = [path for path in files if "." not in path.stem]
    detector = load_detector(copy)
    card = detector.card
    searched = {split: kept_searches(options.run, split, detector) for split in ("fit", "val")}
    if options.detectors:
        report("fit, each place left out", searched["fit"], left_out(searched["fit"], card))
        votes = fit_votes(boxes_of(searched["fit"]))
        print(votes)
        card = card.model_copy(update={"votes": votes})
        for path in options.detectors:
            write(path, votes)
    for split, images in searched.items():
        report(split, images, [card] * len(images))


if __name__ == "__main__":
    main()
