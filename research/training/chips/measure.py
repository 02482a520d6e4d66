"""Measure edges, kinds and scales: ``python -m research.training.chips.measure CHIPS.onnx READ.npz``.

``READ.npz`` is of ``readings.py``. Without ``--places`` it takes the readings that are kept back.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from research.results.record import add_record_option, header, recording
from research.training.chips.kinds import BODY_M, CARS, GROUP_OF_KIND, GROUPS, UNKNOWN
from research.training.chips.readings import READ_LENGTH_PX, Read, load
from research.training.chips.stream import cut
from vehanchor.detection.chips import KINDS, ChipAnswers, ChipNetwork, read_appearance
from vehanchor.models.runtime import Runtime

_N_GROUPS = 4  # of cars
_BOX_M = 4.6  # about a detector's box
_FAR_PX = 10_000  # the border of an image that cuts no car


def sizes(edges: NDArray[np.floating]) -> NDArray[np.float64]:
    """Lengths and widths ``[n, 2]`` of edges ``[n, 4]``."""
    return np.asarray(edges[:, 1::2] - edges[:, ::2], np.float64)


def robust(values: NDArray[np.float64]) -> float:
    """Standard deviation by the median absolute deviation."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def log_scale(read: Read, said: ChipAnswers) -> NDArray[np.float64]:
    """Log of metres per pixel from each car alone, as the search has it."""
    width_px = np.nan_to_num(read.width_px, nan=1.0)
    middle = np.full(len(width_px), _FAR_PX / 2)
    boxes = np.column_stack([middle, middle, read.length_px, width_px, np.zeros(len(middle))])
    return read_appearance(boxes, said, (_FAR_PX, _FAR_PX)).log_lengths - np.log(
        said.sizes[:, 0] * read.length_px
    )


def edge_report(read: Read, said: ChipAnswers) -> Iterator[str]:
    """Length and width against the eye, of the detector's box and of the network."""
    whole = np.isfinite(read.edges).all(axis=1)
    eye, ours = (np.log(sizes(each[whole])) for each in (read.edges, said.edges))
    box = np.stack(
        [np.zeros(whole.sum()), np.log(read.width_px[whole] / read.length_px[whole])], axis=1
    )
    yield header("size", "n", "detector: bias", "detector: sd", "bias", "sd", "robust sd")
    for k, what in enumerate(("length", "width")):
        cells = [part for seen in (box, ours) for part in _errors(seen[:, k] - eye[:, k])]
        yield (
            f"| {what} | {len(eye)} | "
            f"{' | '.join((*cells, _percent(robust(ours[:, k] - eye[:, k]))))} |"
        )
    known = np.isfinite(read.edges)
    off = ((said.edges - read.edges) / said.edge_sd)[known]
    yield (
        f"\nError of an edge over its stated spread: robust {robust(off):.2f}, rms "
        f"{np.sqrt(np.mean(off**2)):.2f}"
    )


def kind_report(read: Read, said: ChipAnswers) -> Iterator[str]:
    """Agreement of kinds with the eye, in four groups of cars."""
    cars = (read.kind != UNKNOWN) & (read.kind < len(CARS))
    groups = np.stack(
        [said.kinds[:, k == GROUP_OF_KIND].sum(axis=1) for k in range(_N_GROUPS)], axis=1
    ).argmax(axis=1)
    truth = GROUP_OF_KIND[read.kind[cars]]
    same = np.mean(groups[cars] == truth)
    most = np.bincount(truth).max() / len(truth)
    yield f"kinds: n {len(truth)}, group {same:.2f}, commonest {most:.2f}"
    table = np.zeros((_N_GROUPS, _N_GROUPS), int)
    np.add.at(table, (truth, groups[cars]), 1)
    for name, row in zip(GROUPS, table.tolist(), strict=False):
        yield f"read {name}: said {dict(zip(GROUPS, row, strict=False))}"


def scale_report(read: Read, said: ChipAnswers) -> Iterator[str]:
    """Spread of the log of the scale from one car after its place, and bias by place."""
    eye, ours = (np.log(sizes(each) * read.length_px[:, None]) for each in (read.edges, said.edges))
    body = np.log([BODY_M.get(KINDS[max(kind, 0)], (np.nan, np.nan)) for kind in read.kind])
    ways = {
        "detector's length": np.log(_BOX_M / read.length_px),
        "length alone": -ours[:, 0],
        "looks over length": said.log_metres[:, 0] - ours[:, 0],
        "looks over width": said.log_metres[:, 1] - ours[:, 1],
        "looks, as the search": log_scale(read, said),
        "eye's length": -eye[:, 0],
        "eye's length and kind": body[:, 0] - eye[:, 0],
    }
    chosen = np.isfinite(read.edges).all(axis=1) & np.isfinite(body[:, 0]) & np.isfinite(read.gsd)
    yield header("scale of one car after its place", "n", "sd", "robust sd")
    for name, way in ways.items():
        off = []
        for place in np.unique(read.place[chosen]):
            here = chosen & (read.place == place)
            errors = way[here] - np.log(read.gsd[here])
            off.append(errors - np.median(errors))
        joined = np.concatenate(off)
        sd = float(np.sqrt(np.sum(joined**2) / (len(joined) - len(off))))
        yield f"| {name} | {len(joined)} | {_percent(sd)} | {_percent(robust(joined))} |"


def place_report(read: Read, said: ChipAnswers) -> Iterator[str]:
    """Bias and spread of one car's scale by place, of all cars of a known scale, and of the detector's length alone."""
    cars = (read.kind != UNKNOWN) & (read.kind < len(CARS)) & np.isfinite(read.gsd)
    yield header("place", "cars", "GSD", "detector: bias", "detector: sd", "bias", "sd")
    for place in np.unique(read.place[cars]):
        here = cars & (read.place == place)
        truth = np.log(read.gsd[here])
        ways = (np.log(_BOX_M / read.length_px[here]), log_scale(read, said)[here])
        cells = [part for way in ways for part in _errors(way - truth)]
        yield f"| {place} | {here.sum()} | {np.exp(np.median(truth)):.2f} m | {' | '.join(cells)} |"


def _errors(logs: NDArray[np.float64]) -> tuple[str, str]:
    """Median and standard deviation of errors."""
    return _percent(float(np.median(logs)), "+"), _percent(float(logs.std(ddof=1)))


def _percent(share: float, sign: str = "") -> str:
    return f"{100 * share:{sign}.1f} %"


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network", type=Path)
    parser.add_argument("readings", type=Path)
    parser.add_argument("--places", default="", help="whose readings are looked at, comma between")
    parser.add_argument("--views", type=int, default=4)
    options = add_record_option(parser).parse_args()
    read = load(options.readings)
    read = read.take(
        np.isin(read.place, options.places.split(",")) if options.places else read.check
    )
    chips = np.stack([cut(chip, READ_LENGTH_PX) for chip in read.chips])
    said = ChipNetwork(options.network, runtime=Runtime(threads=1)).answers(
        chips, views=options.views
    )
    print("\n".join(kind_report(read, said)), flush=True)
    with recording("scale", ["bodies", "one_car", "looks"], options.record):
        for report in (edge_report, scale_report, place_report):
            print("\n".join([*report(read, said), ""]), flush=True)


if __name__ == "__main__":
    main()
