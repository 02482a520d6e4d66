"""Measure a detector on images of known scale.

``python -m research.benchmarks.detector [--split val] [--detector FILE]``.

Prints Markdown; ``--record`` keeps it. "Labelled" images have at least five labelled cars; no
estimate counts as an error of 100 %.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import spearmanr

from research.results.record import add_record_option, recording, values_table
from vehanchor.analysis.pipeline import analyse_view
from vehanchor.detection.detector import Detector
from vehanchor.imagery.facts import ImageFacts
from vehanchor.models.zoo import resolve_model
from vehanchor.options import Reference, ScaleOptions
from vehanchor.rulers.ruler import View
from vehanchor_evaluation.gsd import ScaleTrial, run_trials, summarise
from vehanchor_evaluation.table import survey_table

if TYPE_CHECKING:
    from vehanchor.detection.card import DetectorCard
    from vehanchor_evaluation.known_scale import KnownScaleImage

DATA = Path(os.environ.get("VEHANCHOR_DATA", "../shared/data"))
_LABELLED = 5
_REGION_OF_SET = {
    "cannes": "europe",
    "saopaulo": "south_america",
    "ucm": "north_america",
    "empty": "north_america",
}


def _labelled(trial: ScaleTrial) -> bool:
    return (trial.image.labelled_vehicles or 0) >= _LABELLED


def _row(name: str, trials: list[ScaleTrial]) -> str:
    s = summarise(trials)
    return (
        f"| {name} | {s.images} | {s.coverage:.1%} | {s.median:.2%} | {s.mean:.2%} "
        f"| {s.within_10:.1%} | {s.within_20:.1%} | {s.bias:+.2%} |"
    )


def _with_region(trial: ScaleTrial, card: DetectorCard, options: ScaleOptions) -> ScaleTrial:
    """Repeat the trial with the reference length of the image's region, if the model has one."""
    before = trial.analysis
    estimate = trial.analysis.estimate
    facts = ImageFacts(estimate.image_width_px, estimate.image_height_px)
    regional = _in_region(options, trial.image, card)
    return ScaleTrial(
        trial.image,
        analyse_view(
            View(
                facts,
                before.detections,
                card=card,
                options=regional,
                measure_detail_share=lambda *_: before.detail_share,
            )
        ),
    )


def _in_region(options: ScaleOptions, image: KnownScaleImage, card: DetectorCard) -> ScaleOptions:
    """Choose the region of an image's set, if the model has it."""
    region: str | None = _REGION_OF_SET[image.set]
    if region not in card.region_lengths_m:
        region = None
    return replace(options, reference=Reference(region=region))


def report(trials: list[ScaleTrial], regional: list[ScaleTrial]) -> list[str]:
    """Build the tables as Markdown lines."""
    lines = [
        "| images | n | estimate | median | mean | < 10 % | < 20 % | bias |",
        "|---|---|---|---|---|---|---|---|",
    ]
    labelled = [trial for trial in trials if _labelled(trial)]
    lines.append(_row("labelled, all sets", labelled))
    lines.append(_row("labelled, region given", [trial for trial in regional if _labelled(trial)]))
    for name in sorted({trial.image.set for trial in trials}):
        of_set = [trial for trial in labelled if trial.image.set == name]
        if of_set:
            lines.append(_row(f"labelled, {name}", of_set))
    few = [trial for trial in trials if 0 < (trial.image.labelled_vehicles or 0) < _LABELLED]
    if few:
        lines.append(_row("1 to 4 labelled cars", few))

    with_cars = [trial for trial in trials if _has_cars_and_estimate(trial)]
    with_cars_regional = [trial for trial in regional if _has_cars_and_estimate(trial)]
    confidences = [trial.analysis.estimate.confidence for trial in with_cars]
    rho = spearmanr(confidences, [trial.error for trial in with_cars]).statistic
    values: dict[str, float] = {
        "Spearman's rho of confidence and error": float(rho),
        "truth inside the 95 % interval, %, images with cars": _coverage(with_cars),
        "truth inside the 95 % interval, %, region given": _coverage(with_cars_regional),
        "images with cars and an estimate": len(with_cars),
    }
    lines += ["", *values_table(values, {"Spearman's rho of confidence and error": -0.5})]
    return lines


def _has_cars_and_estimate(trial: ScaleTrial) -> bool:
    return trial.estimated and bool(trial.image.labelled_vehicles)


def _coverage(trials: list[ScaleTrial]) -> float:
    """Compute the share of 95 % intervals that hold the truth, in percent."""
    return 100 * float(np.mean([bool(trial.covered) for trial in trials]))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--split", default="val")
    parser.add_argument("--detector")
    options = add_record_option(parser).parse_args()
    detector = Detector(resolve_model(options.detector))
    images = [
        image
        for image in survey_table(DATA / "gsd" / "table.csv").images
        if image.split == options.split
    ]
    scale = ScaleOptions()
    print(
        f"Detector `{detector.card.name}`, sha256 `{detector.card.sha256}`, split "
        f"{options.split}:\n"
    )
    model = {detector.card.name: detector.card.sha256}
    trials = list(run_trials(images, detector, scale))
    regional = [_with_region(trial, detector.card, scale) for trial in trials]
    with recording("scale", ["val", "val_confidence"], options.record, model=model):
        print("\n".join(report(trials, regional)))


if __name__ == "__main__":
    main()
