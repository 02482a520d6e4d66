"""Accuracy of a detector on images of known scale: ``python benchmarks/detector.py [--split val] [--detector FILE]``.

Prints Markdown, kept in RESULTS.md. "Labelled" images have at least five labelled cars; no estimate counts as an error
of 100 %.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import spearmanr

from vehanchor.detection import Detector
from vehanchor.evaluation.gsd import ScaleTrial, read_table, run_trials, summarise
from vehanchor.model_zoo import resolve_model
from vehanchor.perception import ScaleOptions

if TYPE_CHECKING:
    from collections.abc import Callable

DATA = Path(os.environ.get("VEHANCHOR_DATA", "../shared/data"))
_LABELLED = 5
_REGION_OF_SET = {"cannes": "europe", "saopaulo": "south_america", "ucm": "north_america", "empty": "north_america"}


def _labelled(trial: ScaleTrial) -> bool:
    return (trial.image.labelled_vehicles or 0) >= _LABELLED


def _row(name: str, trials: list[ScaleTrial]) -> str:
    s = summarise(trials)
    return (
        f"| {name} | {s.images} | {s.coverage:.1%} | {s.median:.2%} | {s.mean:.2%} "
        f"| {s.within_10:.1%} | {s.within_20:.1%} | {s.bias:+.2%} |"
    )


def _correlation(trials: list[ScaleTrial]) -> tuple[float, float]:
    """Spearman's and Pearson's correlation of confidence and error."""
    confidence = [t.analysis.estimate.confidence for t in trials]
    error = [t.error for t in trials]
    return float(spearmanr(confidence, error).statistic), float(np.corrcoef(confidence, error)[0, 1])


def report(trials: list[ScaleTrial], regional: list[ScaleTrial]) -> list[str]:
    """The tables as Markdown lines."""
    sets = sorted({t.image.set for t in trials})
    lines = ["| images | n | estimate | median | mean | < 10 % | < 20 % | bias |", "|---|---|---|---|---|---|---|---|"]
    chosen = [t for t in trials if _labelled(t)]
    lines.append(_row("labelled, all sets", chosen))
    lines.append(_row("labelled, region given", [t for t in regional if _labelled(t)]))
    selections: list[tuple[str, Callable[[ScaleTrial], bool]]] = [
        (f"labelled, {name}", lambda t, name=name: _labelled(t) and t.image.set == name)  # type: ignore[misc]
        for name in sets
    ]
    selections.append(("1 to 4 labelled cars", lambda t: 0 < (t.image.labelled_vehicles or 0) < _LABELLED))
    for name, wanted in selections:
        some = [t for t in trials if wanted(t)]
        if some:
            lines.append(_row(name, some))

    known, known_regional = (
        [t for t in some if t.analysis.estimate.gsd_m_per_px is not None and t.image.labelled_vehicles]
        for some in (trials, regional)
    )
    rho, r = _correlation(known)
    rho_regional, r_regional = _correlation(known_regional)
    covered = [bool(t.covered) for t in known]
    covered_labelled = [bool(t.covered) for t in known if _labelled(t)]
    covered_regional = [bool(t.covered) for t in known_regional]
    mistakes = [t for t in trials if (t.error > 0.2 or not t.image.labelled_vehicles)]
    confident = [t for t in mistakes if t.analysis.estimate.confidence >= 0.5]
    good = [
        t for t in trials if t.image.gsd_m_per_px < 0.3 and (t.image.labelled_vehicles or 0) >= 20 and t.error < 0.1
    ]
    sure = [t for t in good if t.analysis.estimate.confidence >= 0.5]
    found = [t.analysis.estimate.n_vehicles > 0 for t in trials if t.image.labelled_vehicles]
    lines += [
        "",
        f"- Spearman's rho of confidence and error: {rho:+.3f}, Pearson's r {r:+.3f}; with the region given "
        f"{rho_regional:+.3f}, {r_regional:+.3f} ({len(known)} images with cars and an estimate)",
        f"- true scale inside the 95 % interval: {np.mean(covered):.1%} of {len(covered)} images with cars; "
        f"{np.mean(covered_labelled):.1%} of the {len(covered_labelled)} with at least five; with the region given "
        f"{np.mean(covered_regional):.1%}",
        f"- confidence >= 0.5 on {len(confident)} of {len(mistakes)} images without cars or with error > 20 % "
        f"({len(confident) / max(1, len(trials)):.1%} of all {len(trials)} images)",
        f"- confidence >= 0.5 on {len(sure)} of {len(good)} images with GSD < 0.3, >= 20 cars, error < 10 %",
        f"- estimate on {np.mean(found):.1%} of {len(found)} images with cars",
        f"- no estimate on {sum(t.analysis.estimate.n_vehicles == 0 for t in trials if t.image.set == 'empty')} of "
        f"{sum(t.image.set == 'empty' for t in trials)} scenes without vehicles",
    ]
    return lines


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--split", default="val")
    parser.add_argument("--detector")
    parser.add_argument("--min-score", type=float)
    parser.add_argument("--aggregation", default="kde")
    options = parser.parse_args()
    detector = Detector(resolve_model(options.detector))
    images = [image for image in read_table(DATA / "gsd" / "table.csv") if image.split == options.split]
    scale = ScaleOptions(min_score=options.min_score, aggregation=options.aggregation)
    trials = list(run_trials(images, detector, scale))
    regional = [
        trial
        for name in sorted({image.set for image in images})
        for trial in run_trials(
            [image for image in images if image.set == name],
            detector,
            replace(
                scale, region=_REGION_OF_SET[name] if _REGION_OF_SET[name] in detector.card.region_lengths_m else None
            ),
        )
    ]
    print(f"Detector `{detector.card.name}`, sha256 `{detector.card.sha256}`, split {options.split}:\n")
    print("\n".join(report(trials, regional)))


if __name__ == "__main__":
    main()
