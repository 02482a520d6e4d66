"""Images of known scale, as data sets hold them: cars painted for the stand-in detector."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import rasterio
from numpy.typing import NDArray
from rasterio.transform import Affine

from tests.models import blank_image, paint_vehicles
from vehanchor.detection.boxes import box_corners

REFERENCE_M = 5.045


def dota_lines(boxes: NDArray[np.float64], name: str = "small-vehicle") -> str:
    return "".join(
        " ".join(f"{v:.1f}" for v in c.ravel()) + f" {name} 0\n" for c in box_corners(boxes)
    )


def cars(length_px: float, n: int = 12) -> NDArray[np.float64]:
    """Place vehicles in rows that are not quite straight, which might border an inset."""
    boxes = []
    for k in range(n):
        x = 40 + 70 * (k % 6)
        y = 50 + 60 * (k // 6) + 7 * (k % 3)
        boxes.append([x, y, length_px, 12, 0.0])
    return np.array(boxes, dtype=np.float64).reshape(n, 5)


def paint(path: Path, boxes: NDArray[np.float64]) -> None:
    image = blank_image(480, 240)
    paint_vehicles(image, boxes)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image[:, :, ::-1])


def write_geotiff(path: Path, crs: str, pixel: float, x: float, y: float) -> Path:
    with rasterio.open(
        path, "w", driver="GTiff", width=480, height=240, count=3, dtype="uint8", crs=crs,
        transform=Affine(pixel, 0, x, 0, -pixel, y),
    ) as file:  # fmt: skip
        image = blank_image(480, 240)
        paint_vehicles(image, cars(20))
        file.write(np.moveaxis(image, 2, 0))
    return path


def write_dota_split(folder: Path) -> Path:
    """A split of DOTA v1.5 as it is downloaded, with all that can be wrong with a file.

    P0000: 20 px cars found, 22 px labelled, at 5.045 m / 20 px; P0001: the scale is 10 % less than
        found; P0002:
    nothing found; P0003: found 30 % too long, no labelled vehicle.
    """
    images = folder / "images" / "part1" / "images"
    labels = folder / "labelTxt-v1.5" / "DOTA-v1.5_val"
    old = folder / "labelTxt-v1.0" / "labelTxt"
    upright = folder / "labelTxt-v1.5" / "DOTA-v1.5_val_hbb"
    for path in (labels, old, upright):
        path.mkdir(parents=True)
    found = REFERENCE_M / 20
    truth = REFERENCE_M / 20
    files: dict[str, tuple[NDArray[np.float64], str]] = {
        "P0000": (cars(20), f"imagesource:GoogleEarth\ngsd:{truth}\n{dota_lines(cars(22))}"),
        "P0001": (
            cars(20),
            f"imagesource:GoogleEarth\ngsd:{found / 0.9}\n{dota_lines(cars(20))}1 2 3 car\n",
        ),
        "P0002": (cars(20, 0), f"imagesource:GoogleEarth\ngsd:{truth}\n{dota_lines(cars(20))}"),
        "P0003": (cars(26), f"imagesource:GF-2\ngsd:{truth}\n{dota_lines(cars(40), 'plane')}"),
        "P0004": (cars(20), f"imagesource:GoogleEarth\ngsd:None\n{dota_lines(cars(20))}"),
        "P0005": (cars(20), dota_lines(cars(20))),
    }
    for name, (boxes, text) in files.items():
        paint(images / f"{name}.png", boxes)
        (labels / f"{name}.txt").write_text(text)
        (old / f"{name}.txt").write_text(text.replace("gsd:", "gsd:9"))
        (upright / f"{name}.txt").write_text(text.replace("gsd:", "gsd:8"))
    paint(images / "P0006.png", cars(20))  # without labels
    paint(folder / "images" / "part2" / "P0000.png", cars(20))  # the name is taken
    (images / "P0007.png").write_bytes(b"no image")
    (labels / "P0007.txt").write_text(f"gsd:{truth}\n")
    (labels / "P0008.txt").write_text(f"gsd:{truth}\n")  # without an image
    paint(images / "P0009.png", cars(20))
    (labels / "P0009.txt").write_bytes(b"gsd:0.2\n\xff\xfe\n")
    return folder


def n_results(path: Path) -> int:
    """The number of results in a file, of all settings."""
    with closing(sqlite3.connect(path)) as file:
        ((found,),) = file.execute("SELECT count(*) FROM results WHERE key <> ''")
    return int(found)
