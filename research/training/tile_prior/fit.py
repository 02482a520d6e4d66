"""Fit the probability of a car in an image by its edges alone.

``python -m research.training.tile_prior.fit ../shared/data``.

A logistic regression of "somebody labelled a car here" on the log of the mean gradient at 1/8 of
the resolution, on the train split of the sets of known scale; prints the two numbers of
``tile_prior`` in ``vehicles.errors.toml``, and the area under the curve on train and val.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from research.training.logistic import area, logistic
from vehanchor.detection.tile_prior import NOISE_GRADIENT, gradient

if TYPE_CHECKING:
    from numpy.typing import NDArray

_TABLES = ("table.csv", "upright.csv")
_UNLABELLED = "estonia_port"
# Sets finer than this are also used at half their resolution.
_FINE_M = 0.16
# Penalty of the slope for a standard deviation of the log gradient.
_RIDGE = 1e-3


def read_images(data: Path, split: str) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Read the log gradients ``[n]`` of a split, and which of them have cars."""
    logs = []
    cars = []
    for table in _TABLES:
        with (data / "gsd" / table).open() as lines:
            for row in csv.DictReader(lines):
                if row["split"] != split or row["set"] == _UNLABELLED:
                    continue
                image = np.asarray(cv2.imread(str(data / "gsd" / row["file"])), np.uint8)[
                    :, :, ::-1
                ]
                for reduced in (8, 16) if float(row["gsd_m_per_px"]) < _FINE_M else (8,):
                    size = image.shape[1] // reduced, image.shape[0] // reduced
                    coarse = np.asarray(
                        cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8
                    )
                    logs.append(float(np.log(gradient(coarse).mean() + NOISE_GRADIENT)))
                    cars.append(int(row["labelled_small_vehicles"]) > 0)
    return np.array(logs), np.array(cars)


def fit(logs: NDArray[np.float64], cars: NDArray[np.bool_]) -> tuple[float, float]:
    """Fit intercept and slope of the log odds."""
    mean = logs.mean()
    spread = logs.std()
    design = np.column_stack([(logs - mean) / spread, np.ones(len(logs))])
    weight = np.full(len(logs), 1 / len(logs))
    slope, constant = logistic(design, cars, weight=weight, ridge=_RIDGE)
    return float(constant - slope * mean / spread), float(slope / spread)


def main() -> None:
    """Print the constants of the library."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    data = parser.parse_args().data
    train = read_images(data, "train")
    val = read_images(data, "val")
    at_one, per_log = fit(*train)
    print(f"_ODDS_AT_ONE, _ODDS_PER_LOG = {at_one:.2f}, {per_log:.3f}")
    areas = [area(logs[cars], logs[~cars]) for logs, cars in (train, val)]
    print(f"area under the curve: train {areas[0]:.3f}, val {areas[1]:.3f}")


if __name__ == "__main__":
    main()
