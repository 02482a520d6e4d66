"""Measure courts as a ruler.

``python -m research.benchmarks.courts [PART ...]``. Prints Markdown; ``--record`` keeps it.

``tiles``: 70 real tiles with tennis courts at 0.3048 m/px, the held-out tenth apart; ``scenes``: rendered sports
grounds, by scale, where a whole court is visible; ``fused``: such grounds with 3 to 10 cars, by cars, by courts and by
both; ``val``: images of the validation splits, with next to no courts in them; ``time``: what looking for courts adds
to an estimate of 4096 x 4096 without any; ``cpu``: its cost on small images, tilted views included.
"""

from __future__ import annotations

import argparse
import csv
import os
import statistics
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from research.results.record import add_record_option, recording, values_table
from research.training.detector.places import is_held_out, places
from vehanchor import analyse_scale
from vehanchor.courts.find import find_courts
from vehanchor.detection.detections import Detections
from vehanchor.detection.detector import Detector
from vehanchor.detection.scene_scale import load_scene_scale
from vehanchor.imagery.detail import resolved_share
from vehanchor.imagery.facts import image_facts
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.zoo import resolve_model
from vehanchor.options import ScaleOptions
from vehanchor.rulers.courts import Courts, evidence_of
from vehanchor.rulers.view import View
from vehanchor_scenes import render_scene

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vehanchor.detection.card import DetectorCard
    from vehanchor.imagery.sources.opening import ImageSource

DATA = Path(os.environ.get("VEHANCHOR_DATA", "../shared/data"))
_SCALES = (0.05, 0.1, 0.15, 0.2, 0.3)
_VIEW_M = 90.0
_HIDDEN_SHARE = 0.05  # a court of which trees hide more is not visible
_FIRST_SEED = 5000  # training has other ones
_TOLERANCE = 0.1
_EVERY = 15  # image of val is timed
_SPORTS = ((0.15, 600), (0.2, 450))
NOTHING = Detections(np.zeros((0, 5)), np.zeros(0))
_PARTS = ("tiles", "scenes", "fused", "val", "time", "cpu")
_HEAD = (
    "| images | n | measured | median error | 90th percentile | worse than 10 % |",
    "|---|---|---|---|---|---|",
)


class Case(NamedTuple):
    """The true scale of an image and the scale by its courts, None without a court."""

    gsd_m_per_px: float
    said: float | None
    n: int


def measured_courts(image: ImageSource, card: DetectorCard) -> tuple[float | None, int]:
    """Scale by the courts of an image and their number, without a detector."""
    with open_raster(image) as raster:
        evidence = evidence_of(find_courts(raster, NOTHING, card))
    return evidence.gsd_m_per_px, evidence.n


def row(name: str, cases: Sequence[Case]) -> str:
    """One line of the table."""
    errors = [abs(case.said / case.gsd_m_per_px - 1) for case in cases if case.said is not None]
    share = len(errors) / max(1, len(cases))
    if not errors:
        return f"| {name} | {len(cases)} | 0 % | | | |"
    wrong = sum(error > _TOLERANCE for error in errors) / len(cases)
    tail = np.percentile(errors, 90)
    return (
        f"| {name} | {len(cases)} | {100 * share:.0f} % | {100 * statistics.median(errors):.2f} % | "
        f"{100 * tail:.2f} % | {100 * wrong:.1f} % |"
    )


def tiles(card: DetectorCard) -> list[str]:
    """Measure the real tiles."""
    held: list[Case] = []
    seen: list[Case] = []
    for place in places(DATA):
        if place.kind == "tenniscourt":
            case = Case(place.gsd_m_per_px, *measured_courts(str(place.path), card))
            (held if is_held_out(place) else seen).append(case)
    return [row("tennis tiles, held out", held), row("tennis tiles, others", seen)]


def scenes(card: DetectorCard, scales: Sequence[float], number: int) -> list[str]:
    """Measure rendered sports grounds with a whole court, by scale."""
    lines, total = [], []
    for gsd in scales:
        cases: list[Case] = []
        side, seed = round(_VIEW_M / gsd), _FIRST_SEED
        while len(cases) < number:
            scene = render_scene(gsd, width_px=side, height_px=side, seed=seed, layout="sports")
            seed += 1
            whole = [court for court in scene.courts if not court.cut and court.hidden_share <= _HIDDEN_SHARE]
            if whole:
                cases.append(Case(gsd, *measured_courts(scene.image, card)))
        lines.append(row(f"scenes, {gsd:g} m/px", cases))
        total += cases
    return [*lines, row("scenes, all", total)]


def fused(number: int) -> list[str]:
    """Rendered sports grounds with a whole court and 3 to 10 cars: errors by cars, by courts, by both."""
    detector = Detector(resolve_model())
    said: dict[str, list[Case]] = {"vehicles": [], "courts": [], "all rulers": []}
    rng, seed = np.random.default_rng(9), _FIRST_SEED + 500
    while len(said["courts"]) < number:
        gsd = float(np.exp(rng.uniform(np.log(0.12), np.log(0.3))))
        side = round(_VIEW_M / gsd)
        cars = int(rng.integers(3, 11))
        scene = render_scene(gsd, width_px=side, height_px=side, seed=seed, layout="sports", n_vehicles=cars)
        seed += 1
        if not any(not court.cut and court.hidden_share <= _HIDDEN_SHARE for court in scene.courts):
            continue
        estimate = analyse_scale(scene.image, detector=detector).estimate
        by_kind = {ruler.kind: ruler.gsd_m_per_px for ruler in estimate.rulers}
        if not {"vehicles", "courts"} <= set(by_kind):
            continue
        for name in ("vehicles", "courts"):
            said[name].append(Case(gsd, by_kind[name], 1))
        said["all rulers"].append(Case(gsd, estimate.gsd_m_per_px, 1))
    return [row(f"fused, {name}", cases) for name, cases in said.items()]


def val(card: DetectorCard) -> list[str]:
    """Find courts in the images of all validation splits, and name the images."""
    unique = val_paths()
    found = [(path, *measured_courts(str(path), card)) for path in unique]
    hits = [f"{path.name} ({n}, {gsd:.4f} m/px)" for path, gsd, n in found if gsd is not None]
    row = f"| val | {len(unique)} | {len(hits)} | {', '.join(hits)} |"
    return ["| images | n | with a court | which |", "|---|---|---|---|", row]


def val_paths() -> list[Path]:
    """Of all validation splits, sorted."""
    paths = []
    for table in ("gsd/table.csv", "gsd/upright.csv", "vehicles/index.csv", "upright/index.csv"):
        with (DATA / table).open(newline="") as handle:
            for entry in csv.DictReader(handle):
                if entry["split"] == "val":
                    paths.append((DATA / table).parent / entry["file"])
    return sorted({path.resolve() for path in paths})


def processor_time(card: DetectorCard, rounds: int) -> list[str]:
    """Time the ruler alone on small images: median and largest seconds, by kind of image."""
    park = render_scene(0.15, width_px=1024, height_px=1024, seed=5).image
    sports = [
        render_scene(gsd, width_px=side, height_px=side, seed=5001, layout="sports").image for gsd, side in _SPORTS
    ]
    lines = ["| images | n | median, CPU s | most, CPU s |", "|---|---|---|---|"]
    for name, images in (("car park", [park]), ("sports", sports), ("val", list(map(str, val_paths()[::_EVERY])))):
        spent = []
        for image in images:
            with open_raster(image) as raster:
                view = View(image_facts(raster), NOTHING, card, ScaleOptions(), partial(resolved_share, raster), raster)
                spent.append(statistics.median(_seconds(view) for _ in range(rounds)))
        lines.append(f"| {name} | {len(spent)} | {statistics.median(spent):.2f} | {max(spent):.2f} |")
    return lines


def _seconds(view: View) -> float:
    begun = time.process_time()
    Courts().measure(view)
    return time.process_time() - begun


def added_time(rounds: int) -> list[str]:
    """Time that courts add to an estimate of 4096 x 4096 px, in alternating runs."""
    scene = render_scene(0.15, width_px=1024, height_px=1024, seed=5, layout="parking")
    image = np.ascontiguousarray(np.tile(scene.image, (4, 4, 1)))
    detector = Detector(resolve_model())
    rulers = ("vehicles", "scene_scale", "camera", "known_length", "height")
    without, whole = ScaleOptions.of({"rulers": rulers}), ScaleOptions.of({"rulers": (*rulers, "courts")})
    analyse_scale(image[:1024, :1024], whole, detector=detector)
    ratios, apart = [], []
    for _ in range(rounds):
        seconds = []
        for options in (without, whole):
            started = time.process_time()
            analyse_scale(image, options, detector=detector)
            seconds.append(time.process_time() - started)
        ratios.append(seconds[1] / seconds[0] - 1)
    network = load_scene_scale()
    assert network is not None
    for _ in range(rounds):
        with open_raster(image) as raster:
            detections = Detections(np.zeros((0, 5)), np.zeros(0))
            prior = network.predict(raster)
            started = time.process_time()
            find_courts(raster, detections, detector.card, prior)
            apart.append(time.process_time() - started)
    return values_table(
        {
            "processor time added at 4096 x 4096, %": 100 * statistics.median(ratios),
            "looking for courts alone, CPU s": statistics.median(apart),
        },
        {"processor time added at 4096 x 4096, %": 5},
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", choices=_PARTS, default=_PARTS)
    parser.add_argument("--scenes", type=int, default=12, help="of each scale")
    parser.add_argument("--scales", type=float, nargs="+", default=_SCALES, metavar="M/PX")
    parser.add_argument("--rounds", type=int, default=5)
    options = add_record_option(parser).parse_args()
    cv2.setNumThreads(1)
    card = Detector(resolve_model()).card
    measures: dict[str, tuple[str, str, Callable[[], list[str]]]] = {
        "tiles": ("rulers", "courts_tiles", lambda: [*_HEAD, *tiles(card)]),
        "scenes": ("rulers", "courts_scenes", lambda: [*_HEAD, *scenes(card, options.scales, options.scenes)]),
        "fused": ("rulers", "courts_fused", lambda: [*_HEAD, *fused(options.scenes)]),
        "val": ("rulers", "courts_val", lambda: val(card)),
        "time": ("speed", "courts_time", lambda: added_time(options.rounds)),
        "cpu": ("speed", "courts_cpu", lambda: processor_time(card, options.rounds)),
    }
    for part in options.parts:
        topic, key, measure = measures[part]
        with recording(topic, [key], options.record):
            print(*measure(), "", sep="\n", flush=True)


if __name__ == "__main__":
    main()
