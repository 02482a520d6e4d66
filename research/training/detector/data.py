"""Training crops from labelled images: sampling, augmentation, dense targets."""

from __future__ import annotations

import csv
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np
import torch

from research.training.detector.distractors import draw_distractors
from research.training.detector.network import STRIDE_PX
from research.training.detector.shade import shaded
from vehanchor.detection.boxes import box_corners, boxes_from_corners
from vehanchor_evaluation.dota import read_labels

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.random import Generator
    from numpy.typing import NDArray

    Picture: TypeAlias = NDArray[np.uint8]
    """RGB picture ``[h, w, 3]``."""

    Boxes: TypeAlias = NDArray[np.float64]
    """Boxes ``[n, 5]``: x, y, length, width, angle."""

    Polygons: TypeAlias = NDArray[np.float64]
    """Corners ``[n, 4, 2]`` of areas."""

    Points: TypeAlias = NDArray[np.float64]
    """Points x, y ``[n, 2]``."""

    Mask: TypeAlias = NDArray[np.bool_]
    """Pixels ``[h, w]``."""

    Point: TypeAlias = NDArray[np.float64]
    """Point x, y ``[2]`` in pixels."""

    Affine: TypeAlias = NDArray[np.float64]
    """Affine map ``[2, 3]``."""

CROP_PX = 320
# Crops are scaled so that the length of cars is log-uniform in this range.
LENGTH_RANGE_PX = (9.0, 64.0)
# Beyond this factor, an enlarged image is only blur.
_MAX_ENLARGEMENT = 2.6
_SET_WEIGHT = {
    "ucm": 0.15, "cannes": 0.15, "jekhor": 0.14, "saopaulo": 0.09, "empty": 0.04, "scene": 0.06,
    "estonia": 0.14, "estonia_port": 0.07, "ucm_more": 0.08, "harbor": 0.06, "building": 0.04,
    "flights": 0.03,
}  # fmt: skip
# One train group in ten is held out: thresholds and confidence are fitted on it.
_DEV_SHARE = 10
HELD_OUT = 0
# Share of crops around clutter, of images with clutter.
_CLUTTER_SHARE = 0.35
# Share of crops finer than the range, of images that are: parts of a car are not cars.
_FINER_SHARE = 0.12
_FINEST_PX = 200.0
# Cars from this length on are found at a reduced resolution only.
_UNSEEN_PX = 105.0
_DISTRACTOR_SHARE = 0.12
CORRECTIONS = Path(__file__).with_name("corrections.csv")


class TrainImage(NamedTuple):
    """Labelled image in memory.

    Attributes:
        set: name of its set.
        image: ``[h, w, 3]`` RGB.
        boxes: ``[n, 5]`` small vehicles.
        ignore: ``[m, 4, 2]`` corners of areas that are neither car nor background.
        clutter: ``[k, 2]`` centres of false cars of an earlier detector.
        car_px: length of a car at the known scale; None takes it from the labelled cars.
    """

    set: str
    image: Picture
    boxes: Boxes
    ignore: Polygons
    clutter: Points
    car_px: float | None = None


def group_of(name: str, set_name: str) -> str:
    """Return the group of an image.

    Neighbours and frames of one video stay on one side of the train/dev line.
    """
    stem = name.rsplit("/", 1)[-1].rsplit(".", 1)[0]
    if set_name == "cannes":
        return (
            f"cannes_row_{int(stem.split('_')[1]) // 49 // 2}_{int(stem.split('_')[1]) % 49 // 7}"
        )
    if set_name == "saopaulo":
        return "_".join(stem.split("_")[:2])
    if set_name == "jekhor":
        return stem.rstrip("0123456789")
    return stem


def is_dev(name: str, set_name: str) -> bool:
    """Return whether a train image belongs to the held-out tenth.

    A checksum of its group decides, so it never changes.
    """
    return (
        set_name != "jekhor"
        and zlib.crc32(group_of(name, set_name).encode()) % _DEV_SHARE == HELD_OUT
    )


class Correction(NamedTuple):
    """One line of ``corrections.csv``: ``kind`` is car, ignore, clutter or unseen."""

    kind: str
    box: tuple[float, ...]


def read_corrections(path: Path) -> dict[str, list[Correction]]:
    """Load the corrections of the train labels by the image's file name."""
    out: dict[str, list[Correction]] = {}
    with path.open(newline="") as handle:
        for row in csv.DictReader(handle):
            box = tuple(float(row[name]) for name in ("x", "y", "length", "width", "angle"))
            out.setdefault(row["file"], []).append(Correction(row["kind"], box))
    return out


def load_train_images(
    vehicles: Path, corrections: Path = CORRECTIONS, *, held_out: bool = False
) -> list[TrainImage]:
    """Load the training part of ``shared/data/vehicles``, or its held-out tenth."""
    corrections_by_file = read_corrections(corrections)
    out = []
    with (vehicles / "index.csv").open(newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if row["split"] == "train"]
    for row in rows:
        if is_dev(row["file"], row["set"]) == held_out:
            sample = _load(vehicles / row["file"], row["set"], vehicles / "labels")
            out.append(corrected(sample, corrections_by_file.get(Path(row["file"]).name, [])))
    return out


def corrected(sample: TrainImage, corrections: Sequence[Correction]) -> TrainImage:
    """Load an image with corrected labels.

    Cars are added; doubtful places and labels without a visible car are ignored.
    """

    def of(*kinds: str) -> Polygons:
        return np.asarray([c.box for c in corrections if c.kind in kinds], np.float64).reshape(
            -1, 5
        )

    unseen = of("unseen")
    offsets = sample.boxes[:, None, :2] - unseen[None, :, :2]
    gap = np.linalg.norm(offsets, axis=2)
    is_unseen = (gap < 1.0).any(axis=1)
    unclear = box_corners(of("ignore", "unseen"))
    return sample._replace(
        boxes=np.concatenate([sample.boxes[~is_unseen], of("car")]),
        ignore=np.concatenate([sample.ignore, unclear]),
        clutter=of("clutter")[:, :2],
    )


def load_scenes(folder: Path) -> list[TrainImage]:
    """Load rendered scenes: images with DOTA text of the same stem beside them."""
    return [_load(path, "scene", folder) for path in sorted(folder.glob("*.jpg"))]


def _load(path: Path, set_name: str, labels_folder: Path) -> TrainImage:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise FileNotFoundError(path)
    labels = read_labels(labels_folder / f"{path.stem}.txt")
    name = np.array(labels.classes, dtype=object)
    car = (name == "small-vehicle") & ~labels.difficult
    return TrainImage(
        set_name,
        np.ascontiguousarray(image[:, :, ::-1]),
        boxes=boxes_from_corners(labels.corners[car]),
        ignore=labels.corners[~car],
        clutter=np.zeros((0, 2)),
    )


class Crop(NamedTuple):
    """Training example at crop resolution.

    Attributes:
        image: ``[CROP_PX, CROP_PX, 3]``.
        boxes: ``[n, 5]``.
        ignore: ``[m, 4, 2]``.
        covered: ``[CROP_PX, CROP_PX]`` pixels that the source image covers.
    """

    image: Picture
    boxes: Boxes
    ignore: Polygons
    covered: Mask


def draw_crop(rng: Generator, sample: TrainImage) -> Crop:
    """Cut a rotated, flipped, rescaled crop.

    Cars at the crop's edge or outside the range of lengths are ignored.
    """
    scale = _drawn_scale(rng, sample)
    focus = _drawn_focus(rng, sample, scale)
    turn = rng.uniform(0, 2 * np.pi)
    flip = -1.0 if rng.random() < 0.5 else 1.0
    source, to_source = _reduced(sample.image, focus, scale)
    cos = np.cos(turn)
    sin = np.sin(turn)
    rotation = np.array([[cos * flip, -sin], [sin * flip, cos]]) * scale
    # Maps continuous pixels of the image to the crop.
    forward = np.column_stack([rotation, CROP_PX / 2 - rotation @ focus])
    # Continuous coordinates have pixel centres at +0.5; warpAffine works on pixel indices.
    matrix = _compose(forward, _invert(to_source))
    matrix[:, 2] += matrix[:, :2] @ (0.5, 0.5) - 0.5
    fill = np.zeros(3)
    if rng.random() < 0.5:
        fill = source[::16, ::16].reshape(-1, 3).mean(axis=0)
    interpolation = cv2.INTER_CUBIC if rng.random() < 0.5 else cv2.INTER_LINEAR
    size = (CROP_PX, CROP_PX)
    warped = cv2.warpAffine(source, matrix, size, flags=interpolation, borderValue=fill.tolist())
    image: Picture = np.asarray(warped, dtype=np.uint8)
    everywhere = np.ones(source.shape[:2], np.uint8)
    covered = cv2.warpAffine(everywhere, matrix, size, flags=cv2.INTER_NEAREST).astype(bool)

    def moved(points: Points) -> Points:
        return np.asarray(points @ forward[:, :2].T + forward[:, 2])

    corners = moved(box_corners(sample.boxes))
    boxes, undecided = _judged(boxes_from_corners(corners))
    ignore = np.concatenate([moved(sample.ignore), undecided])
    return Crop(image, boxes, ignore=ignore, covered=covered)


def _drawn_scale(rng: Generator, sample: TrainImage) -> float:
    """Draw crop pixels per image pixel: the cars' length is log-uniform in its range."""
    if len(sample.boxes):
        car_px = float(np.median(sample.boxes[:, 2]))
    else:
        car_px = sample.car_px or rng.uniform(14, 40)
    log_target = rng.uniform(*np.log(LENGTH_RANGE_PX))
    if car_px > LENGTH_RANGE_PX[1] and rng.random() < _FINER_SHARE:
        longest = min(_FINEST_PX, 1.3 * car_px)
        log_target = rng.uniform(np.log(LENGTH_RANGE_PX[1]), np.log(longest))
    target = float(np.exp(log_target))
    return min(target / car_px, _MAX_ENLARGEMENT * rng.uniform(0.6, 1.0))


def _drawn_focus(rng: Generator, sample: TrainImage, scale: float) -> Point:
    """Draw the image point in the middle of the crop: near clutter, near a car, or anywhere."""
    height, width = sample.image.shape[:2]
    if len(sample.clutter) and rng.random() < _CLUTTER_SHARE:
        target = sample.clutter[rng.integers(len(sample.clutter))]
        focus = target + rng.uniform(-0.35, 0.35, 2) * CROP_PX / scale
    elif len(sample.boxes) and rng.random() < 0.75:
        target = sample.boxes[rng.integers(len(sample.boxes)), :2]
        focus = target + rng.uniform(-0.35, 0.35, 2) * CROP_PX / scale
    else:
        focus = rng.uniform(0, 1, 2) * (width, height)
    margin = np.minimum(0.4 * CROP_PX / scale, (width / 2, height / 2))
    return np.asarray(np.clip(focus, margin, (width, height) - margin))


def _reduced(image: Picture, focus: Point, scale: float) -> tuple[Picture, Affine]:
    """Cut the part around the focus, reduced by averaging; return it with its affine map."""
    height, width = image.shape[:2]
    reduce = min(1.0, scale * 1.15)
    if reduce >= 0.95:
        return image, np.array([[1.0, 0, 0], [0, 1.0, 0]])
    # The part reaches beyond any corner of the rotated crop.
    half = CROP_PX / scale
    x0 = min(int(max(0, focus[0] - half)), width - 8)
    y0 = min(int(max(0, focus[1] - half)), height - 8)
    x1 = int(min(width, focus[0] + half))
    y1 = int(min(height, focus[1] + half))
    part = image[y0 : max(y1, y0 + 8), x0 : max(x1, x0 + 8)]
    part_h, part_w = part.shape[:2]
    small_w = max(4, round(part_w * reduce))
    small_h = max(4, round(part_h * reduce))
    small = cv2.resize(part, (small_w, small_h), interpolation=cv2.INTER_AREA)
    to_source = np.array(
        [
            [small_w / part_w, 0, -x0 * small_w / part_w],
            [0, small_h / part_h, -y0 * small_h / part_h],
        ]
    )
    return np.asarray(small, dtype=np.uint8), to_source


def _judged(boxes: Boxes) -> tuple[Boxes, Polygons]:
    """Select the boxes that a crop shows whole and at a length to learn, and corners to ignore."""
    corners = box_corners(boxes)
    is_near = (corners > -4) & (corners < CROP_PX + 4)
    near = np.any(np.all(is_near, axis=2), axis=1)
    boxes = boxes[near]
    corners = corners[near]
    centres = boxes[:, :2]
    lengths = boxes[:, 2]
    inside = ((centres > 1) & (centres < CROP_PX - 1)).all(axis=1)
    border = 0.15 * boxes[:, 2, None, None]
    whole = ((corners > -border) & (corners < CROP_PX + border)).all(axis=(1, 2))
    shortest, longest = LENGTH_RANGE_PX
    sized = (lengths > 0.8 * shortest) & (lengths < 1.3 * longest)
    good = inside & whole & sized
    undecided = ~good & (lengths < _UNSEEN_PX)
    return boxes[good], corners[undecided]


def lay_over(top: Crop, bottom: Crop) -> Crop:
    """Fill with ``bottom`` what ``top`` leaves uncovered, so that small images waste nothing."""
    image = np.where(top.covered[:, :, None], top.image, bottom.image)
    below = _hidden_by(top.covered, bottom)
    return Crop(
        image,
        np.concatenate([top.boxes, below.boxes]),
        ignore=np.concatenate([top.ignore, below.ignore]),
        covered=top.covered | bottom.covered,
    )


def distracted(rng: Generator, crop: Crop) -> Crop:
    """Draw striped or gridded objects over a part of a crop."""
    image, hides = draw_distractors(rng, crop.image)
    return _hidden_by(hides, crop)._replace(image=image)


def _hidden_by(cover: Mask, crop: Crop) -> Crop:
    """Select the boxes that ``cover`` does not hide; boxes that it cuts are ignored."""
    corners = box_corners(crop.boxes)
    probe = np.concatenate([corners, crop.boxes[:, None, :2]], axis=1)
    cells = np.clip(np.floor(probe), 0, CROP_PX - 1).astype(int)
    hidden = cover[cells[:, :, 1], cells[:, :, 0]]
    clear = ~hidden.any(axis=1)
    cut = ~clear & ~hidden.all(axis=1)
    ignore = np.concatenate([crop.ignore, corners[cut]])
    return crop._replace(boxes=crop.boxes[clear], ignore=ignore)


def _compose(a: Affine, b: Affine) -> Affine:
    matrix = a[:, :2] @ b[:, :2]
    shift = a[:, :2] @ b[:, 2] + a[:, 2]
    return np.column_stack([matrix, shift])


def _invert(a: Affine) -> Affine:
    inverse = np.linalg.inv(a[:, :2])
    return np.column_stack([inverse, -inverse @ a[:, 2]])


def photometric(rng: Generator, image: Picture) -> Picture:
    """Change exposure, colour, sharpness, noise and compression strongly at random."""
    x = image.astype(np.float32) / 255.0
    if rng.random() < 0.12:
        x = x[:, :, rng.permutation(3)]
    if rng.random() < 0.15:
        x = np.repeat(x.mean(axis=2, keepdims=True), 3, axis=2)
    else:
        grey = x.mean(axis=2, keepdims=True)
        x = grey + (x - grey) * np.float32(rng.uniform(0.4, 1.5))
        x = x * rng.uniform(0.85, 1.15, 3).astype(np.float32)
    gamma = np.float32(np.exp(rng.uniform(-0.4, 0.4)))
    x = np.clip(x, 0, 1) ** gamma
    contrast = np.float32(rng.uniform(0.6, 1.45))
    brightness = np.float32(rng.uniform(-0.15, 0.15))
    x = (x - x.mean()) * contrast + x.mean() + brightness
    # A gradient of shadow or haze across the crop.
    if rng.random() < 0.15:
        down = np.linspace(-1, 1, x.shape[0], dtype=np.float32)
        right = np.linspace(-1, 1, x.shape[1], dtype=np.float32)
        slope_down = np.float32(rng.uniform(-1, 1))
        slope_right = np.float32(rng.uniform(-1, 1))
        field = down[:, None] * slope_down + right * slope_right
        x = x * (1 + 0.3 * field[:, :, None])
    draw = rng.random()
    if draw < 0.35:
        x = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.3, 1.1))
    elif draw < 0.5:
        amount = np.float32(rng.uniform(0.3, 1.0))
        x = x + amount * (x - cv2.GaussianBlur(x, (0, 0), 1.2))
    if rng.random() < 0.4:
        noise = rng.normal(0, rng.uniform(0.005, 0.04), x.shape)
        x = x + noise.astype(np.float32)
    out: Picture = np.clip(x * 255.0 + 0.5, 0, 255).astype(np.uint8)
    if rng.random() < 0.5:
        quality = int(rng.integers(35, 96))
        ok, coded = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if ok:
            out = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), dtype=np.uint8)
    return out


class Target(NamedTuple):
    """Dense targets at stride 4 for one crop (or, stacked, a batch)."""

    heat: torch.Tensor  # [1, h, w] in 0..1, exactly 1 at centres
    care: torch.Tensor  # [1, h, w] 0 where the heat loss looks away
    shape: torch.Tensor  # [6, h, w]
    weight: torch.Tensor  # [1, h, w] of the shape loss


def dense_target(boxes: Boxes, ignore: Polygons) -> Target:
    """Draw oriented Gaussians at the centres, and spread each box's numbers over near cells."""
    side = CROP_PX // STRIDE_PX
    heat = np.zeros((side, side), np.float32)
    care = np.ones((side, side), np.uint8)
    for polygon in ignore:
        cells = np.round(polygon / STRIDE_PX - 0.5).astype(np.int32)
        cv2.fillPoly(care, [cells], 0)
    shape = np.zeros((6, side, side), np.float32)
    weight = np.zeros((side, side), np.float32)
    rows, cols = np.mgrid[0:side, 0:side].astype(np.float32) + 0.5
    for x, y, length, width, angle in boxes:
        u = x / STRIDE_PX
        v = y / STRIDE_PX
        reach = int(np.ceil(max(3.0, 0.4 * length / STRIDE_PX)))
        r0 = max(0, int(v) - reach)
        r1 = min(side, int(v) + reach + 1)
        c0 = max(0, int(u) - reach)
        c1 = min(side, int(u) + reach + 1)
        dx = cols[r0:r1, c0:c1] - u
        dy = rows[r0:r1, c0:c1] - v
        along = dx * np.cos(angle) + dy * np.sin(angle)
        across = -dx * np.sin(angle) + dy * np.cos(angle)
        sigma_l = max(0.55, 0.11 * length / STRIDE_PX)
        sigma_w = max(0.5, 0.13 * width / STRIDE_PX)
        squared_distance = (along / sigma_l) ** 2 + (across / sigma_w) ** 2
        blob = np.exp(-0.5 * squared_distance).astype(np.float32)
        heat[r0:r1, c0:c1] = np.maximum(heat[r0:r1, c0:c1], blob)
        closer = blob > np.maximum(weight[r0:r1, c0:c1], 0.2)
        weight[r0:r1, c0:c1][closer] = blob[closer]
        numbers = (np.log(length), np.log(width), np.cos(2 * angle), np.sin(2 * angle))
        shape[0, r0:r1, c0:c1][closer] = -dx[closer]
        shape[1, r0:r1, c0:c1][closer] = -dy[closer]
        for channel, number in enumerate(numbers, start=2):
            shape[channel, r0:r1, c0:c1][closer] = number
        row = min(int(v), side - 1)
        col = min(int(u), side - 1)
        heat[row, col] = 1.0
        care[row, col] = 1
    return Target(
        torch.from_numpy(heat)[None],
        torch.from_numpy(care.astype(np.float32))[None],
        torch.from_numpy(shape),
        torch.from_numpy(weight)[None],
    )


@dataclass
class CropStream:
    """An endless, seeded stream of crops; the k-th is the same whenever it is asked for."""

    images: list[TrainImage]
    seed: int

    def __post_init__(self) -> None:
        """Sort the images by their sets."""
        self._by_set: dict[str, list[TrainImage]] = {}
        for sample in self.images:
            self._by_set.setdefault(sample.set, []).append(sample)
        self._names = sorted(self._by_set)
        share = np.array([_SET_WEIGHT[name] for name in self._names])
        self._share = share / share.sum()
        self._pick = {}
        for name, samples in self._by_set.items():
            counts = np.array([len(sample.boxes) + len(sample.clutter) for sample in samples])
            weight = 1.0 + np.sqrt(counts)
            self._pick[name] = weight / weight.sum()

    def __getitem__(self, index: int) -> tuple[torch.Tensor, Target]:
        """Draw a set by weight, an image in it, then a crop; images with more cars are more likely.

        Returns:
            The image ``[3, h, w]`` uint8 and its target.
        """
        cv2.setNumThreads(1)
        rng = np.random.default_rng([self.seed, index])
        name = self._names[rng.choice(len(self._names), p=self._share)]

        samples = self._by_set[name]

        def draw() -> Crop:
            number = rng.choice(len(samples), p=self._pick[name])
            return draw_crop(rng, samples[number])

        crop = draw()
        for _ in range(2):
            if crop.covered.mean() < 0.75 and rng.random() < 0.9:
                crop = lay_over(crop, draw())
        if rng.random() < _DISTRACTOR_SHARE:
            crop = distracted(rng, crop)
        image = photometric(rng, shaded(rng, crop.image, crop.boxes))
        pixels = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))
        return pixels, dense_target(crop.boxes, crop.ignore)
