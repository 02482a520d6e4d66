"""Measure the fusion of rulers.

``python -m research.benchmarks.rulers [--images N] [--scenes N]``. Prints Markdown; ``--record``
keeps it.

The bundled models measure vehicles and scene-scale prior on val images of known scale and on
rendered scenes of 3 to 10 cars. The witnesses camera, given height and known length are drawn with
the spreads that those rulers state. A wrong ruler is off by a factor of 1.5 to 5 either way.
"""

from __future__ import annotations

import argparse
import math
import random
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from research.results.record import add_record_option, recording
from research.scenes import render_scene
from vehanchor import analyse_scale
from vehanchor.detection.detector import Detector
from vehanchor.errors import ImageError
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import resolve_model
from vehanchor.options import ScaleOptions
from vehanchor.rulers.ruler import point_witness
from vehanchor.scale.posterior import Witness, answer
from vehanchor_evaluation.table import survey_table

DATA = Path(__file__).resolve().parents[2].parent / "shared/data"
# Draws for each image.
DRAWS = 3
# Log spread and chance of being wrong of each ruler.
_STATED = {"camera": (0.13, 0.05), "height": (0.064, 0.05), "known_length": (0.015, 0.05)}
_LIE = (math.log(1.5), math.log(5.0))
_MIN_CARS = 5
_PROBABLY = 0.5
_SEED = 17


class MeasuredImage(NamedTuple):
    """Image with the witnesses of vehicles and scene-scale prior, and the truth.

    Attributes:
        cars: the witness of the vehicles.
        ground: the witness of the prior, if there is one.
        true_gsd: the true scale.
        usable: whether vehicles alone are usable.
    """

    cars: Witness
    ground: tuple[Witness, ...]
    true_gsd: float
    usable: bool


class Case(NamedTuple):
    """The rulers of a case, the wrong one among them, and whether the scene-scale prior counts."""

    name: str
    kinds: tuple[str, ...]
    wrong_kind: str | None = None
    only: Callable[[MeasuredImage], bool] = lambda _: True
    wrong_at_times: bool = False


def measure_images(data: Path, n_images: int, n_scenes: int) -> list[MeasuredImage]:
    """Measure val images with labelled cars, and scenes."""
    detector = Detector(resolve_model(None), runtime=Runtime(threads=1))
    items = [
        item
        for table in ("table.csv", "upright.csv")
        for item in survey_table(data / "gsd" / table).images
        if item.split == "val" and (item.labelled_vehicles or 0) >= 1
    ]
    random.Random(5).shuffle(items)
    options = ScaleOptions.of({"rulers": ("vehicles", "scene_scale")})
    measured: list[MeasuredImage] = []
    for item in items[:n_images]:
        try:
            analysis = analyse_scale(item.path, options, detector=detector)
        except ImageError:
            continue
        measured.append(
            _measured(analysis.witnesses, item.gsd_m_per_px, analysis.estimate.status == "ok")
        )
    rng = np.random.default_rng(3)
    for seed in range(n_scenes):
        gsd = float(np.exp(rng.uniform(math.log(0.06), math.log(0.22))))
        scene = render_scene(
            gsd, width_px=768, height_px=768, seed=900 + seed, n_vehicles=int(rng.integers(3, 11))
        )
        analysis = analyse_scale(scene.image, options, detector=detector)
        usable = analysis.estimate.status == "ok"
        measured.append(_measured(analysis.witnesses, gsd, usable))
    return [image for image in measured if image.cars.gsd_m_per_px is not None]


def _measured(witnesses: Sequence[Witness], true_gsd: float, usable: bool) -> MeasuredImage:
    cars, *ground = witnesses
    return MeasuredImage(cars, tuple(ground), true_gsd, usable and cars.n >= _MIN_CARS)


def drawn(rng: Generator, image: MeasuredImage, case: Case) -> tuple[list[Witness], float]:
    """Draw the witnesses of a case's rulers, and the true scale (another if vehicles are wrong)."""
    truth = image.true_gsd
    priors = image.ground
    # If the vehicles are wrong, the truth moves away from them, and the prior no longer applies.
    if case.wrong_kind == "vehicles":
        truth = _wrong_gsd(rng, truth)
        priors = ()
    witnesses: list[Witness] = [*priors]
    for kind in case.kinds:
        if kind == "vehicles":
            witnesses.append(image.cars)
            continue
        spread, chance_wrong = _STATED[kind]
        is_wrong = kind == case.wrong_kind or (case.wrong_at_times and rng.random() < chance_wrong)
        gsd = _wrong_gsd(rng, truth) if is_wrong else truth * math.exp(rng.normal(0, spread))
        witnesses.append(
            point_witness(kind, gsd, log_sd=spread, chance_wrong=chance_wrong, statement="{}")
        )
    return witnesses, truth


def _wrong_gsd(rng: Generator, gsd: float) -> float:
    log_error = rng.choice([-1, 1]) * rng.uniform(*_LIE)
    return float(np.clip(gsd * math.exp(log_error), 0.004, 2.5))


_THREE = ("vehicles", "camera", "known_length")
CASES = (
    Case("cars, camera", ("vehicles", "camera")),
    Case("cars, height", ("vehicles", "height")),
    Case("cars, line", ("vehicles", "known_length")),
    Case("cars, camera, line", ("vehicles", "camera", "known_length")),
    Case("cars, height, each but cars wrong in 5 %", ("vehicles", "height"), wrong_at_times=True),
    Case(
        "cars, camera, line, each but cars wrong in 5 %",
        ("vehicles", "camera", "known_length"),
        wrong_at_times=True,
    ),
    *(
        Case(f"{', '.join(_THREE)}: {wrong} wrong", _THREE, wrong, lambda image: image.usable)
        for wrong in ("camera", "known_length", "vehicles")
    ),
)


def row(case: Case, images: Sequence[MeasuredImage]) -> str:
    """Format a row of the table from ``DRAWS`` answers to each image."""
    rng = np.random.default_rng(_SEED)
    errors = []
    is_held = []
    is_named = []
    chances = []
    for image in images:
        if not case.only(image):
            continue
        for _ in range(DRAWS):
            witnesses, truth = drawn(rng, image, case)
            scale = answer(witnesses)
            assert scale is not None
            errors.append(abs(scale.gsd_m_per_px / truth - 1))
            is_held.append(scale.interval.low <= truth <= scale.interval.high)
            chances.append(scale.chance)
            heard = [witness for witness in witnesses if witness.found]
            doubted = {
                witness.kind
                for witness, chance in zip(heard, scale.p_right, strict=True)
                if chance < _PROBABLY
            }
            is_named.append(case.wrong_kind in doubted)
    error = np.array(errors)
    within_10 = np.mean(error < 0.1)
    within_20 = np.mean(error < 0.2)
    shares = [within_10, within_20, np.mean(chances), np.mean(is_held)]
    quantiles = [np.median(error), np.quantile(error, 0.9)]
    cells = [f"{100 * share:.1f} %" for share in (*quantiles, *shares)]
    named = f"{100 * np.mean(is_named):.1f} %" if case.wrong_kind else ""
    return f"| {case.name} | {len(error)} | {' | '.join(cells)} | {named} |"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--images", type=int, default=90)
    parser.add_argument("--scenes", type=int, default=50)
    options = add_record_option(parser).parse_args()
    images = measure_images(options.data, options.images, options.scenes)
    with recording("rulers", ["fused"], options.record):
        print(
            "| rulers | n | median | 90 % are below | within 10 % | within 20 % | said | cover "
            "| wrong ruler named |"
        )
        print("|---|---|---|---|---|---|---|---|---|")
        for case in CASES:
            print(row(case, images), flush=True)


if __name__ == "__main__":
    main()
