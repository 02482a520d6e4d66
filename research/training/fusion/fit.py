"""Fit how a detector's boxes vote: ``python -m research.training.fusion.fit RUN DETECTOR.onnx``.

Reads the searches that ``research.training.fusion.cases`` has kept in ``RUN``. A box of a car's
length in metres is taken for a car: its log odds follow from the score by logistic regression
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

_CAR_M = (3.0, 6.3)  # between these a box of known scale is taken for a car
_NUMBERS = ((0, 0), (1, 1), (2, 2), (3, 4), (5, 12), (13, 10_000))  # of vehicles, in reports


class Searched(NamedTuple):
    """An image of known scale with its search."""

    image: KnownScaleImage
    found: SearchedImage

    @property
    def place(self) -> str:
        """The place; crops and copies of one photograph count together."""
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
    found = (
        (image, log.get(Source.of(image.path)))
        for image in survey_table(run / f"{split}.csv").images
    )
    return [Searched(image, each) for image, each in found if each is not None]


def boxes_of(searched: Sequence[Searched]) -> Boxes:
    """Collect the boxes of images, and tell which are as long as a car."""
    scores = [each.found.detections.scores for each in searched]
    metres = [each.found.detections.boxes[:, 2] * each.image.gsd_m_per_px for each in searched]
    weights = [np.full(len(some), 1.0 / max(1, len(some))) for some in scores]
    joined = np.concatenate(metres)
    return Boxes(
        np.concatenate(scores), (joined > _CAR_M[0]) & (joined < _CAR_M[1]), np.concatenate(weights)
    )


def fit_votes(boxes: Boxes) -> Votes:
    """Fit the log odds of a car at score 0, and their increase to a score of 1."""

    def surprise(odds: NDArray[np.float64]) -> float:
        log_odds = odds[0] + odds[1] * boxes.scores
        return float(
            np.average(
                np.logaddexp(0, np.where(boxes.car, -log_odds, log_odds)), weights=boxes.weight
            )
        )

    found = minimize(surprise, [-3.0, 6.0], method="Nelder-Mead").x
    return Votes(float(found[0]), float(found[1]))


def outcome(analysis: ScaleAnalysis, true_gsd_m_per_px: float) -> Outcome:
    """Decide on the scale by vehicles and priors alone, and compare it with the truth."""
    vehicles = analysis.vehicles
    assert vehicles is not None
    n = vehicles.n
    found = answer([vehicles, *(each for each in analysis.witnesses if not each.sets_scale)])
    if found is None:
        return Outcome(n, False, math.nan, False)
    error = abs(found.gsd_m_per_px / true_gsd_m_per_px - 1)
    return Outcome(
        n, found.usable, error, found.interval.low <= true_gsd_m_per_px <= found.interval.high
    )


def outcomes(searched: Sequence[Searched], card: DetectorCard) -> list[Outcome]:
    """Apply a card's votes to kept searches."""
    options = ScaleOptions()
    return [outcome(found.analysis(card, options), image.gsd_m_per_px) for image, found in searched]


def row(name: str, some: Sequence[Outcome]) -> str:
    """Describe outcomes in a row of a table."""
    usable = [each for each in some if each.usable]
    scaled = [each for each in some if not math.isnan(each.error)]
    wrong = sum(each.error > TOLERANCE for each in usable)
    bound = upper_bound(wrong, len(usable))
    median = f"{np.median([each.error for each in scaled]):.1%}" if scaled else ""
    cover = f"{np.mean([each.held for each in scaled]):.3f}" if scaled else ""
    return (
        f"| {name} | {len(some)} | {len(usable)} | {wrong} | "
        f"{'' if bound is None else f'{bound:.1%}'} | {median} | "
        f"{cover} |"
    )


def report(name: str, searched: Sequence[Searched], cards: Sequence[DetectorCard]) -> None:
    """Print outcomes by number of vehicles and by place.

    Args:
        name: of the images.
        searched: the images.
        cards: for each image, the detector's card with the votes to judge it by.
    """
    seen = [outcomes([each], card)[0] for each, card in zip(searched, cards, strict=True)]
    print(header(name, "n", "ok", "wrong", "below", "median error", "interval holds"))
    for low, high in _NUMBERS:
        print(row(f"{low} to {high} vehicles", [each for each in seen if low <= each.n <= high]))
    for place in sorted({each.place for each in searched}):
        some = [found for each, found in zip(searched, seen, strict=True) if each.place == place]
        print(row(place, some))
    print(row("all", seen), end="\n\n", flush=True)


def left_out(searched: Sequence[Searched], card: DetectorCard) -> list[DetectorCard]:
    """Make the card of each image: its votes are fitted on the other places."""
    by_place = {
        place: card.model_copy(
            update={
                "votes": fit_votes(boxes_of([each for each in searched if each.place != place]))
            }
        )
        for place in {each.place for each in searched}
    }
    return [by_place[each.place] for each in searched]


def write(path: Path, votes: Votes) -> None:
    """Put the votes into the detector's file; its graph stays as it is."""
    model = onnx.load(path)
    stated = {entry.key: entry.value for entry in model.metadata_props}
    onnx.helper.set_model_props(model, stated | {"vehanchor.votes": json.dumps(votes._asdict())})
    with whole_file(path) as partial:
        onnx.save(model, partial)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument(
        "detectors", type=Path, nargs="*", help="files that get the votes; none: only report"
    )
    options = parser.parse_args()
    (copy,) = (path for path in (options.run / "models").glob("*.onnx") if "." not in path.stem)
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
    for split, some in searched.items():
        report(split, some, [card] * len(some))


if __name__ == "__main__":
    main()
