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
    from collections.abc import Callable

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
    """The same detections, with the reference length of the image's region where the model has one."""
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
    region = _REGION_OF_SET[image.set]
    return replace(
        options, reference=Reference(region=region if region in card.region_lengths_m else None)
    )


def report(trials: list[ScaleTrial], regional: list[ScaleTrial]) -> list[str]:
    """The tables as Markdown lines."""
    sets = sorted({t.image.set for t in trials})
    lines = [
        "| images | n | estimate | median | mean | < 10 % | < 20 % | bias |",
        "|---|---|---|---|---|---|---|---|",
    ]
    chosen = [t for t in trials if _labelled(t)]
    lines.append(_row("labelled, all sets", chosen))
    lines.append(_row("labelled, region given", [t for t in regional if _labelled(t)]))
    selections: list[tuple[str, Callable[[ScaleTrial], bool]]] = [
        (f"labelled, {name}", lambda t, name=name: _labelled(t) and t.image.set == name)  # type: ignore[misc]
        for name in sets
    ]
    selections.append(
        ("1 to 4 labelled cars", lambda t: 0 < (t.image.labelled_vehicles or 0) < _LABELLED)
    )
    for name, wanted in selections:
        some = [t for t in trials if wanted(t)]
        if some:
            lines.append(_row(name, some))

    known, known_regional = (
        [
            t
            for t in some
            if t.analysis.estimate.gsd_m_per_px is not None and t.image.labelled_vehicles
        ]
        for some in (trials, regional)
    )
    rho = spearmanr(
        [t.analysis.estimate.confidence for t in known], [t.error for t in known]
    ).statistic
    held, held_regional = (
        100 * float(np.mean([bool(t.covered) for t in some])) for some in (known, known_regional)
    )
    values: dict[str, float] = {
        "Spearman's rho of confidence and error": float(rho),
        "truth inside the 95 % interval, %, images with cars": held,
        "truth inside the 95 % interval, %, region given": held_regional,
        "images with cars and an estimate": len(known),
    }
    lines += ["", *values_table(values, {"Spearman's rho of confidence and error": -0.5})]
    return lines


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
