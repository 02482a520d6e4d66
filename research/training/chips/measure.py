"""Measure edges, kinds and scales of the chip network against readings by eye.

``python -m research.training.chips.measure CHIPS.onnx READ.npz``. ``readings.py`` writes
``READ.npz``. Without ``--places``, the readings that training does not use are measured.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from research.results.record import add_record_option, header, recording
from research.training.chips.kinds import BODY_M, CARS, GROUP_OF_KIND, GROUPS, UNKNOWN
from research.training.chips.readings import READ_LENGTH_PX, Read, load
from research.training.chips.stream import cut
from vehanchor.detection.chips import KINDS, ChipAnswers, ChipNetwork, read_appearance
from vehanchor.models.runtime import Runtime

Values: TypeAlias = NDArray[np.float64]
"""A number ``[n]`` of each reading."""

# Groups of cars.
_N_GROUPS = 4
# Length of a car as a detector's box has it, about.
_BOX_M = 4.6
# Side of an image whose border is too far to cut a car.
_FAR_PX = 10_000


def sizes(edges: NDArray[np.floating]) -> Values:
    """Compute lengths and widths ``[n, 2]`` from edges ``[n, 4]``."""
    return np.asarray(edges[:, 1::2] - edges[:, ::2], np.float64)


def robust(values: Values) -> float:
    """Compute the standard deviation from the median absolute deviation."""
    deviations = np.abs(values - np.median(values))
    return float(1.4826 * np.median(deviations))


def log_scale(read: Read, answers: ChipAnswers) -> Values:
    """Compute the log of metres per pixel from each car alone, as the search does."""
    width_px = np.nan_to_num(read.width_px, nan=1.0)
    middle = np.full(len(width_px), _FAR_PX / 2)
    boxes = np.column_stack([middle, middle, read.length_px, width_px, np.zeros(len(middle))])
    log_lengths_m = read_appearance(boxes, answers, (_FAR_PX, _FAR_PX)).log_lengths
    return log_lengths_m - np.log(answers.sizes[:, 0] * read.length_px)


def edge_report(read: Read, answers: ChipAnswers) -> Iterator[str]:
    """Compare length and width of the detector's box and of the network with the eye."""
    whole = np.isfinite(read.edges).all(axis=1)
    eye = np.log(sizes(read.edges[whole]))
    network = np.log(sizes(answers.edges[whole]))
    # Sizes are relative to the box's length.
    box_log_width = np.log(read.width_px[whole] / read.length_px[whole])
    box = np.stack([np.zeros(whole.sum()), box_log_width], axis=1)
    columns = ("n", "detector: bias", "detector: sd", "bias", "sd", "robust sd")
    yield header("size", *columns)
    for k, size in enumerate(("length", "width")):
        errors = network[:, k] - eye[:, k]
        box_errors = box[:, k] - eye[:, k]
        cells = [*_errors(box_errors), *_errors(errors), _percent(robust(errors))]
        yield f"| {size} | {len(eye)} | {' | '.join(cells)} |"
    is_read = np.isfinite(read.edges)
    ratio = ((answers.edges - read.edges) / answers.edge_sd)[is_read]
    rms = np.sqrt(np.mean(ratio**2))
    yield (f"\nError of an edge over its stated spread: robust {robust(ratio):.2f}, rms {rms:.2f}")


def kind_report(read: Read, answers: ChipAnswers) -> Iterator[str]:
    """Compare kinds with the eye, in four groups of cars."""
    cars = (read.kind != UNKNOWN) & (read.kind < len(CARS))
    chances = [answers.kinds[:, k == GROUP_OF_KIND].sum(axis=1) for k in range(_N_GROUPS)]
    groups = np.stack(chances, axis=1).argmax(axis=1)
    truth = GROUP_OF_KIND[read.kind[cars]]
    agreement = np.mean(groups[cars] == truth)
    commonest = np.bincount(truth).max() / len(truth)
    yield f"kinds: n {len(truth)}, group {agreement:.2f}, commonest {commonest:.2f}"
    table = np.zeros((_N_GROUPS, _N_GROUPS), int)
    np.add.at(table, (truth, groups[cars]), 1)
    for name, row in zip(GROUPS, table.tolist(), strict=False):
        yield f"read {name}: said {dict(zip(GROUPS, row, strict=False))}"


def scale_report(read: Read, answers: ChipAnswers) -> Iterator[str]:
    """Measure the spread of the log scale from one car, without the bias of its place."""
    eye = np.log(sizes(read.edges) * read.length_px[:, None])
    network = np.log(sizes(answers.edges) * read.length_px[:, None])
    kinds = [KINDS[max(kind, 0)] for kind in read.kind]
    body = np.log([BODY_M.get(kind, (np.nan, np.nan)) for kind in kinds])
    log_scales = {
        "detector's length": np.log(_BOX_M / read.length_px),
        "length alone": -network[:, 0],
        "looks over length": answers.log_metres[:, 0] - network[:, 0],
        "looks over width": answers.log_metres[:, 1] - network[:, 1],
        "looks, as the search": log_scale(read, answers),
        "eye's length": -eye[:, 0],
        "eye's length and kind": body[:, 0] - eye[:, 0],
    }
    # Only cars with all edges, a body of known size and a known scale can be compared.
    complete = np.isfinite(read.edges).all(axis=1)
    complete &= np.isfinite(body[:, 0]) & np.isfinite(read.gsd)
    yield header("scale of one car after its place", "n", "sd", "robust sd")
    for name, logs in log_scales.items():
        residuals = []
        for place in np.unique(read.place[complete]):
            here = complete & (read.place == place)
            errors = logs[here] - np.log(read.gsd[here])
            residuals.append(errors - np.median(errors))
        joined = np.concatenate(residuals)
        # Each place's median takes a degree of freedom.
        sd = float(np.sqrt(np.sum(joined**2) / (len(joined) - len(residuals))))
        yield f"| {name} | {len(joined)} | {_percent(sd)} | {_percent(robust(joined))} |"


def place_report(read: Read, answers: ChipAnswers) -> Iterator[str]:
    """Measure bias and spread of one car's scale by place, beside the detector's length alone."""
    cars = (read.kind != UNKNOWN) & (read.kind < len(CARS)) & np.isfinite(read.gsd)
    yield header("place", "cars", "GSD", "detector: bias", "detector: sd", "bias", "sd")
    for place in np.unique(read.place[cars]):
        here = cars & (read.place == place)
        truth = np.log(read.gsd[here])
        gsd = f"{np.exp(np.median(truth)):.2f} m"
        by_detector = np.log(_BOX_M / read.length_px[here])
        by_network = log_scale(read, answers)[here]
        cells = [*_errors(by_detector - truth), *_errors(by_network - truth)]
        yield f"| {place} | {here.sum()} | {gsd} | {' | '.join(cells)} |"


def _errors(logs: Values) -> tuple[str, str]:
    """Format median and standard deviation of errors."""
    median = float(np.median(logs))
    sd = float(logs.std(ddof=1))
    return _percent(median, "+"), _percent(sd)


def _percent(share: float, sign: str = "") -> str:
    return f"{100 * share:{sign}.1f} %"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network", type=Path)
    parser.add_argument("readings", type=Path)
    parser.add_argument("--places", default="", help="places to measure, separated by commas")
    parser.add_argument("--views", type=int, default=4)
    options = add_record_option(parser).parse_args()
    read = load(options.readings)
    measured = read.check
    if options.places:
        measured = np.isin(read.place, options.places.split(","))
    read = read.take(measured)
    chips = np.stack([cut(chip, READ_LENGTH_PX) for chip in read.chips])
    network = ChipNetwork(options.network, runtime=Runtime(threads=1))
    answers = network.answers(chips, views=options.views)
    print("\n".join(kind_report(read, answers)), flush=True)
    with recording("scale", ["bodies", "one_car", "looks"], options.record):
        for report in (edge_report, scale_report, place_report):
            print("\n".join([*report(read, answers), ""]), flush=True)


if __name__ == "__main__":
    main()
