"""Collect images on which the chance of a scale is calibrated and reported.

``python -m research.training.fusion.cases RUN``.

``fit``: the held-out tenth of the train images, whole and as windows with one to four cars at
several resolutions; the odd numbers of ``chia/``, reduced; rendered scenes of mixed fleets.
``val``: the same of val and of the even numbers, with other seeds. Writes ``RUN/fit.csv`` and
``RUN/val.csv``, tables of images of known scale, and searches their images into ``RUN/fit.jsonl``
and ``RUN/val.jsonl`` with a copy of the networks, ``RUN/models``, without their errors. The fit
changes these; the searches stay valid. An interrupted run resumes; other networks need another
``RUN``.
"""

from __future__ import annotations

import argparse
import csv
import shutil
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from research.scenes import render_scene
from research.training.detector.data import is_dev
from research.training.detector.places import is_held_out, places
from vehanchor.detection.detector import Detector, load_detector
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import auxiliary_model, resolve_model
from vehanchor.options import ScaleOptions
from vehanchor.storage.atomic import whole_file
from vehanchor_evaluation.dota import SMALL_VEHICLE, read_labels
from vehanchor_evaluation.search import search_known_scale
from vehanchor_evaluation.table import survey_table

# Windows of an image.
_WINDOWS = {"fit": 4, "val": 2}
# Random trials to find one window.
_TRIALS = 40
_MAX_CARS = 4
_WINDOW_PX = (200, 640)
_FACTORS = (1.0, 0.7, 0.5)
_COARSEST_M_PER_PX = 0.3
_CHIA_FACTORS = {"crops": (1.0, 0.7, 0.5, 0.35), "copies": (1.0, 0.6)}
_RENDERED = 80
_SEEDS = {"fit": 300_000, "val": 400_000}
_RENDERED_M_PER_PX = (0.03, 0.25)
_NO_CARS_SHARE = 0.3
# Kinds of ``ucm_more`` without cars.
_WITHOUT_CARS = ("harbor", "runway")
_CARS = "labelled_small_vehicles"


class Picture(NamedTuple):
    """Image of known scale.

    Attributes:
        file: its path.
        set: name of its place.
        gsd_m_per_px: its true scale.
        cars: number of labelled cars; None without labels.
    """

    file: Path
    set: str
    gsd_m_per_px: float
    cars: int | None


def known_images(data: Path, split: str) -> list[tuple[Path, str, float]]:
    """List files, sets and true scales: of the held-out tenth of train, or of val."""
    tables = [(data / "gsd" / name, data / "gsd") for name in ("table.csv", "upright.csv")]
    rows = []
    for table, folder in [*tables, (data / "unlabelled" / "index.csv", data / "unlabelled")]:
        with table.open(newline="") as handle:
            for row in csv.DictReader(handle):
                if row.get("split", "train") != split:
                    continue
                if split == "train" and not is_dev(row["file"], row["set"]):
                    continue
                rows.append((folder / row["file"], row["set"], float(row["gsd_m_per_px"])))
    return rows


def labelled_centres(image: Path) -> np.ndarray | None:
    """Read the centres ``[n, 2]`` of the labelled cars of an image; None without labels."""
    labels = image.parent.parent / "labels" / f"{image.stem}.txt"
    if not labels.exists():
        return None
    return read_labels(labels, []).of_class(SMALL_VEHICLE).mean(axis=1)


def whole_images(data: Path, split: str) -> Iterator[Picture]:
    """List whole images of known scale: of the held-out tenth (``fit``), or of val."""
    for path, name, gsd in known_images(data, "train" if split == "fit" else "val"):
        centres = labelled_centres(path)
        cars = None if centres is None else len(centres)
        kind = path.stem.removeprefix("ucm_").rstrip("0123456789")
        if name == "empty" or kind in _WITHOUT_CARS:
            cars = 0
        yield Picture(path, name, gsd, cars)
    if split == "fit":
        for place in places(data):
            if place.set == "building" and is_held_out(place):
                yield Picture(place.path, place.set, place.gsd_m_per_px, None)
        return
    with (data / "segments" / "index.csv").open(newline="") as handle:
        for row in csv.DictReader(handle):
            if (row["split"], row["category"]) == ("val", "building"):
                path = data / "segments" / row["image"]
                yield Picture(path, "building", float(row["gsd_m_per_px"]), None)


def windows(whole: Picture, split: str, folder: Path) -> Iterator[Picture]:
    """Cut windows with one to four cars out of a labelled image, and reduce them."""
    centres = labelled_centres(whole.file)
    pixels = cv2.imread(str(whole.file))
    if centres is None or not len(centres) or pixels is None:
        return
    if whole.gsd_m_per_px > _COARSEST_M_PER_PX:
        return
    rng = np.random.default_rng(zlib.crc32(whole.file.name.encode()))
    size = np.array(pixels.shape[1::-1])
    for number in range(_WINDOWS[split]):
        factors = [
            factor for factor in _FACTORS if whole.gsd_m_per_px / factor <= _COARSEST_M_PER_PX
        ]
        factor = float(rng.choice(factors))
        for _ in range(_TRIALS):
            side_px = np.exp(rng.uniform(*np.log(_WINDOW_PX))) / factor
            side = np.minimum(side_px, size).astype(int)
            corner = rng.integers(0, size - side + 1)
            is_inside = ((centres > corner) & (centres < corner + side)).all(axis=1)
            cars = int(is_inside.sum())
            if 1 <= cars <= _MAX_CARS:
                left, top = corner
                right, bottom = corner + side
                cut = pixels[top:bottom, left:right]
                file = folder / f"{whole.set}_{whole.file.stem}_{number}.png"
                yield reduced(cut, factor, Picture(file, whole.set, whole.gsd_m_per_px, cars))
                break


def reduced(pixels: np.ndarray, factor: float, picture: Picture) -> Picture:
    """Write a reduced copy; return its table row with the coarser scale."""
    if not picture.file.exists():
        small = cv2.resize(pixels, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(picture.file), small)
    return picture._replace(gsd_m_per_px=picture.gsd_m_per_px / factor)


def chia(data: Path, split: str, folder: Path) -> Iterator[Picture]:
    """List crops and nadir copies of ``chia/`` without metadata.

    Odd numbers are reduced (``fit``), even numbers are not.
    """
    for kind, table in (("crops", "crops.csv"), ("copies", "table.csv")):
        with (data / "chia" / table).open(newline="") as handle:
            rows = [row for row in csv.DictReader(handle) if row["gsd_m_per_px"]]
        for row in rows:
            path = data / "chia" / row["file"]
            if (int(path.stem[-4:]) % 2 == 1) != (split == "fit"):
                continue
            factors = _CHIA_FACTORS[kind] if split == "fit" else (1.0,)
            for factor in factors:
                file = folder / f"chia_{kind}_{path.stem}_{factor:g}.png"
                picture = Picture(file, f"chia_{kind}", float(row["gsd_m_per_px"]), None)
                pixels = cv2.imread(str(path))
                assert pixels is not None
                yield reduced(pixels, factor, picture)


def rendered(split: str, folder: Path) -> Iterator[Picture]:
    """Render scenes of mixed fleets with up to six vehicles, a part of them without any."""
    for seed in range(_SEEDS[split], _SEEDS[split] + _RENDERED):
        rng = np.random.default_rng(seed)
        gsd = float(np.exp(rng.uniform(*np.log(_RENDERED_M_PER_PX))))
        cars = 0 if rng.random() < _NO_CARS_SHARE else int(rng.integers(1, 7))
        side = int(rng.integers(384, 768))
        length = rng.uniform(3.7, 5.2)
        file = folder / f"rendered_{seed}.jpg"
        if not file.exists():
            render_scene(
                gsd,
                width_px=side,
                height_px=side,
                seed=seed,
                n_vehicles=cars,
                mean_vehicle_length_m=length,
                fleet_kind="mixed",
            ).write(file)
        yield Picture(file, "rendered", gsd, cars)


def pictures(data: Path, split: str, folder: Path) -> Iterator[Picture]:
    """List all pictures of a split."""
    folder.mkdir(parents=True, exist_ok=True)
    for whole in whole_images(data, split):
        yield whole
        yield from windows(whole, split, folder)
    yield from chia(data, split, folder)
    yield from rendered(split, folder)


def write_table(run: Path, data: Path, split: str) -> Path:
    """Write the table of a split."""
    table = run / f"{split}.csv"
    with whole_file(table) as partial, partial.open("w", newline="") as handle:
        writer = csv.writer(handle)
        writer.writerow(["file", "gsd_m_per_px", "set", "split", _CARS])
        for picture in pictures(data, split, run / "pictures" / split):
            cars = "" if picture.cars is None else picture.cars
            writer.writerow(
                [picture.file.resolve(), picture.gsd_m_per_px, picture.set, split, cars]
            )
    return table


def search_table(table: Path, detector: Detector) -> None:
    """Search the images of a table into the log beside it."""
    search_known_scale(
        survey_table(table),
        detector,
        ScaleOptions(),
        cache=table.with_suffix(".jsonl"),
        workers=1,
        progress=lambda done, total: print(
            f"{table.stem}: {done} of {total}", end="\r", flush=True
        ),
    )


def copied(detector: Path, folder: Path) -> Path:
    """Copy a detector with its auxiliary models, unless it is there; its path in the folder."""
    copy = folder / detector.name
    if not copy.exists():
        folder.mkdir(parents=True, exist_ok=True)
        for kind in ("verifier", "chips"):
            model = auxiliary_model(detector, kind)
            if model is not None:
                shutil.copy(model, folder / f"{detector.stem}.{kind}.onnx")
        shutil.copy(detector, copy)
    return copy


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--detector", default=None)
    parser.add_argument("--splits", nargs="+", choices=("fit", "val"), default=("fit", "val"))
    options = parser.parse_args()
    copy = copied(resolve_model(options.detector), options.run / "models")
    detector = load_detector(copy, Runtime(threads=1))
    for split in options.splits:
        search_table(write_table(options.run, options.data, split), detector)


if __name__ == "__main__":
    main()
