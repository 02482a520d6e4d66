"""Measure given masks, and whether a shape fits, on real masks.

``python -m research.benchmarks.shapes [--split val] [--record]``.

Each object of at least 15 px a side is measured twice: by its true mask, and by the segmenter's
mask in its box; each with the true scale, and with the scale of the photograph's cars. For a
circle and two rectangles, the size that fits with a probability of 0.9 is compared with what fits
into the true mask at the true scale. Prints Markdown; ``--record`` keeps it.
"""

from __future__ import annotations

import argparse
import itertools
import os
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from research.results.record import add_record_option, recording
from vehanchor.analysis.pipeline import analyse_raster
from vehanchor.engine import Engine
from vehanchor.errors import VehAnchorError
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.measure.area import analyse_objects
from vehanchor.measure.fit import fit_probability
from vehanchor.measure.placement import make_grid, place_circle, place_rectangle
from vehanchor.measure.scale_source import find_measurement_scale
from vehanchor.measure.shapes import CallerMask
from vehanchor.options import ScaleOptions
from vehanchor.scale.lengths import Z95
from vehanchor.segmentation.object_mask import ObjectMask
from vehanchor.segmentation.prompt import Prompt
from vehanchor_evaluation.areas import AreaEntry, read_areas

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.imagery.raster import Raster
    from vehanchor.measure.scale_source import MeasurementScale
    from vehanchor.records import AreaMeasurement

DATA = Path(os.environ.get("VEHANCHOR_DATA", "../shared/data"))
# Length over width; 0 is a circle.
PROPORTIONS = (0.0, 2.0, 3.0)
WANTED = 0.9
# A size is found within a thousandth.
N_HALVINGS = 14


@dataclass(frozen=True)
class Area:
    """Area of a given mask."""

    true_scale: AreaMeasurement
    end_to_end: AreaMeasurement
    entry: AreaEntry


@dataclass(frozen=True)
class Room:
    """Size that fits with a probability of 0.9, over the largest that fits in truth."""

    mask: str
    scale: str
    ratio: float


def measure_image(engine: Engine, entries: list[AreaEntry]) -> tuple[list[Area], list[Room]]:
    """Measure all objects of an image."""
    # The file's own scale may be the truth that the cars are compared with.
    options = ScaleOptions.of({"file_scale": False})
    with open_raster(entries[0].image, options.reading) as raster:
        analysis = analyse_raster(engine.detector, raster, options)

        def estimated(_raster: Raster, _options: ScaleOptions) -> ScaleAnalysis:
            return analysis

        size = (raster.width_px, raster.height_px)
        given = [
            CallerMask(entry.mask, size, left=entry.left_px, top=entry.top_px) for entry in entries
        ]
        by_truth = analyse_objects(
            raster, given, segmenter=None, scale=entries[0].gsd_m_per_px, options=options
        )
        by_cars = analyse_objects(raster, given, segmenter=None, scale=estimated, options=options)
        areas = [
            Area(one.measurement, other.measurement, entry)
            for one, other, entry in zip(by_truth, by_cars, entries, strict=True)
        ]
        prompts = [Prompt(box=entry.corners) for entry in entries]
        segmented = analyse_objects(
            raster,
            prompts,
            segmenter=engine.segmenter,
            scale=entries[0].gsd_m_per_px,
            options=options,
        )
        scales = {
            "true": find_measurement_scale(raster, entries[0].gsd_m_per_px, options),
            "cars": find_measurement_scale(raster, estimated, options),
        }
    rooms: list[Room] = []
    for entry, own, drawn in zip(entries, by_truth, segmented, strict=True):
        least_log_sd = engine.segmenter.card.mask_width_log_sd
        for mask, measured, least in (("given", own, 0.0), ("segmenter", drawn, least_log_sd)):
            record = measured.measurement
            if record.status == "ok":
                rooms += _rooms(
                    entry,
                    mask,
                    measured.segmentation,
                    record=record,
                    scales=scales,
                    least_log_sd=least,
                )
    return areas, rooms


def _rooms(
    entry: AreaEntry,
    mask: str,
    pixels: ObjectMask,
    record: AreaMeasurement,
    scales: dict[str, MeasurementScale],
    least_log_sd: float,
) -> Iterator[Room]:
    """Compare sizes of a mask with those of the truth, for usable scales."""
    height, width = entry.mask.shape
    window = Window(entry.left_px, entry.top_px, width_px=width, height_px=height)
    truth = ObjectMask(entry.mask, window)
    assert record.area_m2 is not None
    assert record.area_ci95_high_m2 is not None
    assert record.perimeter_m is not None
    log_sd = float(np.log(record.area_ci95_high_m2 / record.area_m2)) / Z95
    gsd = entry.gsd_m_per_px
    edge_sd_px = log_sd * record.area_m2 / record.perimeter_m / gsd
    for proportion in PROPORTIONS:
        true_px = _narrowest(truth, proportion)
        mask_px = true_px if mask == "given" else _narrowest(pixels, proportion)
        if not true_px or not mask_px:
            continue
        width_log_sd = max(2 * edge_sd_px / mask_px, least_log_sd)
        for name, scale in scales.items():
            # Only a scale on which a planner acts.
            if scale.status != "ok":
                continue
            probability = partial(
                fit_probability, narrowest_px=mask_px, scale=scale, log_sd=width_log_sd
            )
            true_m = true_px * gsd
            wanted_m = _size_at(WANTED, probability, true_m)
            yield Room(mask, name, wanted_m / true_m)


def _narrowest(pixels: ObjectMask, proportion: float) -> float:
    """Measure the smaller extent of the largest shape inside; 0 without one."""
    grid = make_grid(pixels)
    if not proportion:
        circle = place_circle(grid)
        return 0.0 if circle is None else circle.diameter_px
    rectangle = place_rectangle(grid, proportion, 1.0)
    return 0.0 if rectangle is None else rectangle.width_px


def _size_at(wanted: float, probability: Callable[[float], float], about: float) -> float:
    """Find the largest size whose probability is at least the wanted one."""
    low = 0.0
    high = 4 * about
    for _ in range(N_HALVINGS):
        middle = (low + high) / 2
        if probability(middle) >= wanted:
            low = middle
        else:
            high = middle
    return low


def _print_areas(areas: list[Area]) -> None:
    exact = [
        area.true_scale.area_m2 == area.entry.mask_area_px * area.entry.gsd_m_per_px**2
        for area in areas
    ]
    print("**Given masks**\n")
    print("| scale | objects | median error | interval holds |")
    print("|---|---|---|---|")
    print(f"| true | {len(areas)} | {_median_error(areas, true=True)} | exact: {sum(exact)} |")
    scaled = [area for area in areas if area.end_to_end.area_m2 is not None]
    usable = [area for area in scaled if area.end_to_end.status == "ok"]
    for name, rows in (("cars", scaled), ("cars, ok", usable)):
        print(f"| {name} | {len(rows)} | {_median_error(rows)} | {_coverage(rows)} |")


def _median_error(areas: list[Area], *, true: bool = False) -> str:
    errors = []
    for area in areas:
        record = area.true_scale if true else area.end_to_end
        assert record.area_m2 is not None
        errors.append(abs(record.area_m2 / area.entry.area_m2 - 1))
    return f"{np.median(errors) * 100:.1f} %"


def _coverage(areas: list[Area]) -> str:
    n_held = 0
    for area in areas:
        low = area.end_to_end.area_ci95_low_m2
        high = area.end_to_end.area_ci95_high_m2
        assert low is not None
        assert high is not None
        n_held += low <= area.entry.area_m2 <= high
    return f"{n_held / len(areas) * 100:.1f} %"


def _print_rooms(rooms: list[Room]) -> None:
    print("\n**Sizes that fit with a probability of 0.9**\n")
    print("| mask | scale | sizes | fit in truth | median size over the largest |")
    print("|---|---|---|---|---|")
    for mask, scale in itertools.product(("given", "segmenter"), ("true", "cars")):
        kind = (mask, scale)
        ratios = np.array([room.ratio for room in rooms if (room.mask, room.scale) == kind])
        if not len(ratios):
            continue
        right = f"{(ratios <= 1).mean() * 100:.1f} %"
        median = f"{np.median(ratios):.2f}"
        print(f"| {mask} | {scale} | {len(ratios)} | {right} | {median} |")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--split", default="val")
    parser.add_argument("--limit", type=int)
    options = add_record_option(parser).parse_args()
    engine = Engine()
    data = read_areas(DATA / "segments", options.split)
    by_image: dict[Path, list[AreaEntry]] = {}
    for entry in data.entries[: options.limit]:
        by_image.setdefault(entry.image, []).append(entry)
    areas: list[Area] = []
    rooms: list[Room] = []
    for image, entries in by_image.items():
        try:
            image_areas, image_rooms = measure_image(engine, entries)
        except VehAnchorError as error:
            print(f"{image}: {error}")
            continue
        areas += image_areas
        rooms += image_rooms
    with recording("areas", ["given_masks", "must_fit"], options.record):
        _print_areas(areas)
        _print_rooms(rooms)


if __name__ == "__main__":
    main()
