"""Images of known scale without oriented labels, and their held-out part; without PyTorch."""

from __future__ import annotations

import csv
import zlib
from pathlib import Path
from typing import NamedTuple

_LOOKED_AT = Path(__file__).with_name("looked_at.csv")
# Scales from the GPS track; each pair of photographs agrees within a fifth.
_FLIGHT_GSD = {"garfield": 0.047, "seneca": 0.058}
# One photograph in four of a flight trains, because neighbours show the same ground.
_EVERY_PHOTOGRAPH = 4
_DEV_SHARE = 10
_HELD_OUT = 0


class Place(NamedTuple):
    """An image without oriented labels."""

    path: Path
    set: str  # estonia, estonia_port, ucm_more, building, flights
    kind: str  # of place, see ``scenery.py``
    gsd_m_per_px: float
    labels: Path | None


def places(data: Path) -> list[Place]:
    """List the images of ``shared/data`` that may train and have no oriented labels."""
    out = []
    with (data / "upright" / "index.csv").open(newline="") as handle:
        for row in csv.DictReader(handle):
            if row["split"] == "train":
                path = data / "upright" / row["file"]
                labels = data / "upright" / "labels" / f"{path.stem}.txt"
                out.append(Place(path, row["set"], row["set"], float(row["gsd_m_per_px"]), labels))
    with (data / "unlabelled" / "index.csv").open(newline="") as handle:
        for row in csv.DictReader(handle):
            path = data / "unlabelled" / row["file"]
            kind = (
                path.stem.removeprefix("ucm_").rstrip("0123456789")
                if row["set"] == "ucm_more"
                else row["set"]
            )
            out.append(Place(path, row["set"], kind, float(row["gsd_m_per_px"]), None))
    with (data / "segments" / "index.csv").open(newline="") as handle:
        for row in csv.DictReader(handle):
            if row["split"] == "train" and row["category"] == "building":
                path = data / "segments" / row["image"]
                out.append(Place(path, "building", "building", float(row["gsd_m_per_px"]), None))
    with (data / "flights" / "table.csv").open(newline="") as handle:
        for number, row in enumerate(csv.DictReader(handle)):
            if number % _EVERY_PHOTOGRAPH == 0:
                path = data / "flights" / row["file"]
                out.append(Place(path, "flights", row["flight"], _FLIGHT_GSD[row["flight"]], None))
    return out


def is_held_out(place: Place) -> bool:
    """Return whether a place never trains: one in ten, by a checksum.

    Halves of one tile (``b``) and flights stay together.
    """
    stem = place.path.stem.rstrip("b") if place.set == "estonia" else place.path.stem
    return place.set != "flights" and zlib.crc32(stem.encode()) % _DEV_SHARE == _HELD_OUT


def looked_at() -> dict[str, list[tuple[float, float, str]]]:
    """Read candidates judged on contact sheets by file: x, y and kind (car, ignore, clutter)."""
    out: dict[str, list[tuple[float, float, str]]] = {}
    with _LOOKED_AT.open(newline="") as handle:
        for row in csv.DictReader(handle):
            of_file = out.setdefault(row["file"], [])
            judged = (float(row["x"]), float(row["y"]), row["kind"])
            of_file.append(judged)
    return out
