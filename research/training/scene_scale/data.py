"""Images of known scale, and an endless stream of crops resampled to random scales.

No labels are needed: whatever has a scale trains. The scale of ``jekhor`` comes from its cars, the
scale of ``flights`` from its GPS track. Nothing of a val split is read, nor what is for evaluation
only.
"""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np
import torch

from research.training.detector.data import is_dev, photometric
from research.training.scene_scale.bins import soft_target
from vehanchor_evaluation.dota import read_labels

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.random import Generator
    from numpy.typing import NDArray

    Picture: TypeAlias = NDArray[np.uint8]
    """RGB picture ``[h, w, 3]``."""

TILE_PX = 160
FINEST_M_PER_PX = 0.0135
COARSEST_M_PER_PX = 1.1
# Median length of Munich's and Minsk's cars.
_CAR_M = 4.6
# Cars that an image needs, so that they give its scale.
_MIN_CARS = 2
# Log standard deviation of these two kinds of label.
_CAR_SPREAD = 0.07
_FLIGHT_SPREAD = 0.12
# Log standard deviation of a height above take-off.
_HEIGHT_SPREAD = 0.03
# The latter are the photographs of tilt/, most of them oblique.
_CHECK_ONLY = re.compile(r"harlem|DJI_\d+$")
# Scales in m/px from the GPS track; each pair agrees within a fifth.
_FLIGHT_GSD = {"garfield": 0.047, "seneca": 0.058}
# From this pitch on, a camera looks down.
_DOWN_DEG = -85.0
# Width of the frame to which "35 mm" focal lengths refer.
_FULL_FRAME_MM = 36.0
_TILT_WIDTH_PX = 3000
# One photograph in two of a flight trains, because neighbours show the same ground.
_EVERY_PHOTOGRAPH = 2
# The last photographs of a flight are held out, with the last ground.
_HELD_OUT_PHOTOGRAPHS = 4
# Finest resampling of a source, as a share of its own metres a pixel; beyond is only blur.
_FINEST_SHARE = 0.75
# The same for flights, whose reduced copies are sharp to the pixel.
_FINEST_FLIGHT_SHARE = 0.6
_SET_WEIGHT = {
    "cannes": 1.0, "ucm": 0.8, "ucm_more": 0.8, "empty": 0.4, "saopaulo": 1.0, "estonia": 1.0,
    "estonia_port": 0.7, "building": 1.0, "munich": 0.5, "minsk": 0.8, "garfield": 1.0,
    "seneca": 0.8, "scene": 1.0, "chia": 1.5,
}  # fmt: skip
# Share of crops turned by any angle, which softens them; others have one of eight symmetries.
_TURNED_SHARE = 0.25
# Share of crops changed as for the detector, with blur and sharpening; others are retouched.
_PHOTOMETRIC_SHARE = 0.5
_BLURRED_SHARE = 0.08
_NOISE_SHARE = 0.05
# Standard deviations of the blur; from the upper one on, a crop shows nothing.
_BLUR_PX = (2.0, 9.0)
SETS = tuple(name for name in _SET_WEIGHT if name != "scene")


class ScaledImage(NamedTuple):
    """One image in memory."""

    set: str
    name: str
    pixels: Picture  # [h, w, 3] RGB
    gsd_m_per_px: float
    label_spread: float  # log standard deviation of gsd_m_per_px
    finest_m_per_px: float


class Source(NamedTuple):
    """A file of known scale."""

    path: Path
    set: str
    gsd_m_per_px: float
    label_spread: float
    held_out: bool


def sources(data: Path) -> list[Source]:
    """List every file of ``shared/data`` that may train and has a scale, each once."""
    out = [
        *_listed(data, "gsd/table.csv"),
        *_listed(data, "gsd/upright.csv"),
        *_listed(data, "unlabelled/index.csv"),
        *_segments(data),
        *_cars_as_rulers(data),
        *_photographs(data),
        *chia_photographs(data),
    ]
    return list({source.path: source for source in out}.values())


def load_images(
    data: Path, *, held_out: bool = False, without: Collection[str] = ()
) -> list[ScaledImage]:
    """Load the training part of ``shared/data`` or its held-out tenth.

    ``without`` names sets to leave out.
    """
    return [_load(s) for s in sources(data) if s.held_out == held_out and s.set not in without]


def load_scenes(folder: Path) -> list[ScaledImage]:
    """Load rendered scenes (``render_scenes detector``): images with DOTA text beside them."""
    out = []
    for path in sorted(folder.glob("*.jpg")):
        gsd = float(path.with_suffix(".txt").read_text().split()[0].removeprefix("gsd:"))
        out.append(_load(Source(path, "scene", gsd, 0.0, held_out=False)))
    return out


def load_val_images(data: Path, *, without: Collection[str] = ()) -> list[ScaledImage]:
    """Load the images for reports: val splits with a scale, and nadir photographs of ``tilt/``."""
    photographs = [
        *_listed(data, "gsd/table.csv", "val"),
        *_listed(data, "gsd/upright.csv", "val"),
        *_segments(data, "val"),
    ]
    for row in _rows(data / "tilt" / "table.csv"):
        if float(row["camera_pitch_deg"]) < _DOWN_DEG:
            width_m = (
                float(row["height_above_takeoff_m"])
                * _FULL_FRAME_MM
                / float(row["focal_length_35mm"])
            )
            photographs.append(
                Source(
                    data / "tilt" / row["file"],
                    "tilt",
                    width_m / _TILT_WIDTH_PX,
                    0.0,
                    held_out=False,
                )
            )
    photographs += chia_photographs(data, odd=False)
    return [_load(source) for source in photographs if source.set not in without]


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as handle:
        return list(csv.DictReader(handle))


def _listed(data: Path, index: str, split: str = "train") -> list[Source]:
    """Read a split of a table with ``file``, ``set``, ``gsd_m_per_px`` and perhaps ``split``."""
    folder = (data / index).parent
    return [
        Source(
            (folder / row["file"]).resolve(),
            row["set"],
            float(row["gsd_m_per_px"]),
            0.0,
            is_dev(row["file"], row["set"]),
        )
        for row in _rows(data / index)
        if row.get("split", "train") == split
    ]


def _segments(data: Path, split: str = "train") -> list[Source]:
    """List images that have masks and are in no other table, nor in a val split."""
    elsewhere = {Path(row["file"]).stem for row in _rows(data / "vehicles" / "index.csv")}
    out = []
    for row in _rows(data / "segments" / "index.csv"):
        name = Path(row["image"]).stem
        if row["split"] != split or name in elsewhere:
            continue
        kind = "building" if row["category"] == "building" else name.split("_")[0]
        path = (data / "segments" / row["image"]).resolve()
        out.append(Source(path, kind, float(row["gsd_m_per_px"]), 0.0, is_dev(name, kind)))
    return out


def _cars_as_rulers(data: Path) -> list[Source]:
    """List ``jekhor``: the median length of an image's cars is ``_CAR_M``."""
    out = []
    for row in _rows(data / "vehicles" / "index.csv"):
        stem = Path(row["file"]).stem
        if row["set"] != "jekhor" or row["split"] != "train" or _CHECK_ONLY.search(stem):
            continue
        labels = read_labels(data / "vehicles" / "labels" / f"{stem}.txt", [])
        corners = labels.of_class("small-vehicle")
        # Two adjacent sides of each box.
        sides = np.diff(corners[:, :3], axis=1)
        lengths = np.linalg.norm(sides, axis=2).max(axis=1)
        if len(lengths) >= _MIN_CARS:
            kind = "minsk" if "DJI" in stem else "munich"
            path = (data / "vehicles" / row["file"]).resolve()
            gsd = _CAR_M / float(np.median(lengths))
            out.append(Source(path, kind, gsd, _CAR_SPREAD, held_out=False))
    return out


def _photographs(data: Path) -> list[Source]:
    out = []
    for flight, gsd in _FLIGHT_GSD.items():
        rows = _rows(data / "flights" / "table.csv")
        files = sorted(row["file"] for row in rows if row["flight"] == flight)
        first_held_out = len(files) - _HELD_OUT_PHOTOGRAPHS
        for number in (
            *range(0, first_held_out - 1, _EVERY_PHOTOGRAPH),
            *range(first_held_out + 1, len(files)),
        ):
            path = (data / "flights" / files[number]).resolve()
            held_out = number >= first_held_out
            out.append(Source(path, flight, gsd, _FLIGHT_SPREAD, held_out=held_out))
    return out


def chia_photographs(data: Path, *, odd: bool = True) -> list[Source]:
    """Load nadir photographs of ``chia/`` and crops of them: odd numbers train, even ones check."""
    out = []
    for table in ("chia/table.csv", "chia/crops.csv"):
        for row in _rows(data / table):
            if not row["gsd_m_per_px"]:
                continue
            number = int(Path(row["file"]).stem.split("_")[1])
            if (number % 2 == 1) == odd:
                path = (data / "chia" / row["file"]).resolve()
                gsd = float(row["gsd_m_per_px"])
                out.append(Source(path, "chia", gsd, _HEIGHT_SPREAD, held_out=False))
    return out


def _load(source: Source) -> ScaledImage:
    image = cv2.imread(str(source.path), cv2.IMREAD_COLOR)
    if image is None:
        raise FileNotFoundError(source.path)
    share = _FINEST_FLIGHT_SHARE if source.set in _FLIGHT_GSD else _FINEST_SHARE
    return ScaledImage(
        source.set,
        source.path.name,
        pixels=np.ascontiguousarray(image[:, :, ::-1]),
        gsd_m_per_px=source.gsd_m_per_px,
        label_spread=source.label_spread,
        finest_m_per_px=max(FINEST_M_PER_PX, share * source.gsd_m_per_px),
    )


def coarsest_m_per_px(image: ScaledImage) -> float:
    """Compute the scale at which a whole tile is the largest square of an image."""
    shorter_px = float(min(image.pixels.shape[:2]))
    return min(COARSEST_M_PER_PX, image.gsd_m_per_px * shorter_px / TILE_PX)


def draw_crop(rng: Generator, image: ScaledImage, gsd_m_per_px: float) -> Picture:
    """Cut a square of ``TILE_PX`` pixels, averaged over areas, turned and flipped at random.

    Returns:
        Pixels ``[TILE_PX, TILE_PX, 3]`` uint8.
    """
    height, width = image.pixels.shape[:2]
    side = TILE_PX * gsd_m_per_px / image.gsd_m_per_px  # of the square in the source, px
    angle = rng.uniform(0, 45) if rng.random() < _TURNED_SHARE else 0.0
    turn = math.radians(angle)
    around = math.cos(turn) + math.sin(turn)
    if side * around > min(height, width):
        angle = 0.0
        around = 1.0
    reach = max(2, min(round(side * around), height, width))
    top = int(rng.integers(height - reach + 1))
    left = int(rng.integers(width - reach + 1))
    part = image.pixels[top : top + reach, left : left + reach]
    outer = round(TILE_PX * around)
    how = cv2.INTER_AREA if reach >= outer else cv2.INTER_CUBIC
    part = np.asarray(cv2.resize(part, (outer, outer), interpolation=how), np.uint8)
    if angle:
        middle = (outer - 1) / 2
        matrix = cv2.getRotationMatrix2D((middle, middle), angle, 1.0)
        # The middle of the part becomes that of the tile.
        shift = middle - (TILE_PX - 1) / 2
        matrix[:, 2] = matrix[:, 2] - shift
        part = np.asarray(
            cv2.warpAffine(part, matrix, (TILE_PX, TILE_PX), borderMode=cv2.BORDER_REFLECT),
            np.uint8,
        )
    part = np.rot90(part, int(rng.integers(4)))
    return np.ascontiguousarray(part[:, ::-1] if rng.random() < 0.5 else part)


def retouched(rng: Generator, crop: Picture) -> Picture:
    """Change colours, tones and compression, but not sharpness."""
    x = crop.astype(np.float32) / 255.0
    grey = x.mean(axis=2, keepdims=True)
    x = grey + (x - grey) * np.float32(rng.uniform(0.3, 1.4))
    x = x * rng.uniform(0.9, 1.1, 3).astype(np.float32)
    gamma = np.float32(np.exp(rng.uniform(-0.35, 0.35)))
    x = np.clip(x, 0, 1) ** gamma
    x = (
        (x - x.mean()) * np.float32(rng.uniform(0.65, 1.35))
        + x.mean()
        + np.float32(rng.uniform(-0.1, 0.1))
    )
    out = np.asarray(np.clip(x * 255 + 0.5, 0, 255), np.uint8)
    if rng.random() < 0.4:
        _, coded = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, int(rng.integers(60, 97))])
        out = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)
    return out


def featureless(rng: Generator) -> Picture:
    """Draw noise of any roughness in any colour, ``[TILE_PX, TILE_PX, 3]``: water, sand, cloud."""
    field = np.zeros((TILE_PX, TILE_PX), np.float32)
    roughness = rng.uniform(0.2, 1.2)
    for side in (2, 5, 10, 20, 40, 80, 160):
        octave = rng.normal(0, side**-roughness, (side, side)).astype(np.float32)
        field += cv2.resize(octave, (TILE_PX, TILE_PX), interpolation=cv2.INTER_CUBIC)
    field /= max(float(field.std()), 1e-6)
    colour = rng.uniform(20, 220, 3)
    contrast = np.exp(rng.uniform(np.log(1.0), np.log(40.0)))
    tint = contrast * rng.uniform(0.7, 1.3, 3)
    coloured = colour + field[:, :, None] * tint
    return np.asarray(np.clip(coloured, 0, 255), np.uint8)


@dataclass
class CropStream:
    """An endless, seeded stream of crops; the k-th is the same whenever it is asked for.

    The scale is drawn first, log-uniform, then a set among those that can show it, so that no set
    owns a scale.
    """

    images: list[ScaledImage]
    seed: int

    def __post_init__(self) -> None:
        """Sort the images by their sets."""
        finest = [image.finest_m_per_px for image in self.images]
        coarsest = [coarsest_m_per_px(image) for image in self.images]
        self._range = np.column_stack([finest, coarsest])
        self._set = np.array([image.set for image in self.images])
        self._within = np.log([min(finest), max(coarsest)])

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw a crop.

        Returns:
            Pixels ``[3, TILE_PX, TILE_PX]`` uint8 and the probabilities ``[BINS]`` to be learned.
        """
        cv2.setNumThreads(1)
        rng = np.random.default_rng([self.seed, index])
        if rng.random() < _NOISE_SHARE:
            crop = featureless(rng)
            target = soft_target(1.0, lost=1.0)
        else:
            image, gsd = self._draw(rng)
            crop = draw_crop(rng, image, gsd)
            lost = 0.0
            if rng.random() < _BLURRED_SHARE:
                blur = rng.uniform(*_BLUR_PX)
                crop = np.asarray(cv2.GaussianBlur(crop, (0, 0), blur), np.uint8)
                lost = (blur - _BLUR_PX[0]) / (_BLUR_PX[1] - _BLUR_PX[0])
            target = soft_target(gsd, image.label_spread, lost)
        changed = photometric if rng.random() < _PHOTOMETRIC_SHARE else retouched
        pixels = changed(rng, crop).transpose(2, 0, 1)
        return torch.from_numpy(np.ascontiguousarray(pixels)), torch.from_numpy(target)

    def _draw(self, rng: Generator) -> tuple[ScaledImage, float]:
        gsd = float(np.exp(rng.uniform(*self._within)))
        able = (self._range[:, 0] <= gsd) & (gsd <= self._range[:, 1])
        names = np.unique(self._set[able])
        share = np.array([_SET_WEIGHT[name] for name in names])
        name = names[rng.choice(len(names), p=share / share.sum())]
        return self.images[rng.choice(np.flatnonzero(able & (self._set == name)))], gsd
