"""Masks to training crops: sampling, geometric augmentation, prompts drawn from the mask."""

from __future__ import annotations

import csv
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np
import torch

from research.training.detector.data import photometric
from research.training.segmenter.network import (
    BOTTOM_RIGHT,
    NEGATIVE,
    PADDING,
    POSITIVE,
    STRIDE_PX,
    TOP_LEFT,
    Prompt,
)
from research.training.segmenter.shapes import composite

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.random import Generator
    from numpy.typing import NDArray

    Picture: TypeAlias = NDArray[np.uint8]
    """RGB picture ``[h, w, 3]``."""

    Coverage: TypeAlias = NDArray[np.float32]
    """Coverage ``[h, w]`` in 0..1."""

    Box: TypeAlias = NDArray[np.float64]
    """Box x0, y0, x1, y1."""

# Smaller objects teach nothing.
LEAST_SIDE_PX = 10
MAX_POINTS = 6
_SOURCE_WEIGHT = {"swimming-pool": 0.27, "building": 0.33, "scene": 0.15, "shape": 0.25}
_MAX_ENLARGEMENT = 5.0
# Black, and the mean with which SAM pads its inputs.
_FILLS = ((0.0, 0.0, 0.0), (123.675, 116.28, 103.53))
_MIN_SOLIDITY = 0.72
# One train group in ten is held out: the mask's uncertainty is measured on it.
_DEV_SHARE = 10
HELD_OUT = 0


class MaskObject(NamedTuple):
    """Object of an image: its id in the mask, and its bounding box in whole pixels."""

    image: int
    id: int
    x0: int
    y0: int
    x1: int
    y1: int


class MaskImage(NamedTuple):
    """Image in memory with one mask of instances; scenes have one for each category.

    Attributes:
        source: ``real`` or ``scene``.
        category: category of its objects.
        group: group of its file.
        image: ``[h, w, 3]`` RGB.
        mask: ``[h, w]`` ids; 0 is the background.
    """

    source: str
    category: str
    group: str
    image: Picture
    mask: NDArray[np.uint16]


def group_of(name: str) -> str:
    """Return the group of an image: neighbours stay on one side of the train/dev line."""
    file = name.rsplit("/", 1)[-1]
    stem = file.rsplit(".", 1)[0]
    parts = stem.split("_")
    if parts[0] == "cannes":
        tile = int(parts[1])
        return f"cannes_{tile // 49 // 2}_{tile % 49 // 7}"
    if parts[0] == "oam":
        return f"oam_{parts[1]}_{int(parts[2]) // 8}_{int(parts[3]) // 8}"
    return "_".join(parts[:2])


def is_dev(group: str) -> bool:
    """Return whether a group belongs to the held-out tenth, by a checksum that never changes."""
    return zlib.crc32(group.encode()) % _DEV_SHARE == HELD_OUT


def _read(path: Path, flags: int) -> Picture | NDArray[np.uint16]:
    array = cv2.imread(str(path), flags)
    if array is None:
        raise FileNotFoundError(path)
    return array  # type: ignore[return-value]


def load_segments(folder: Path, split: str) -> list[MaskImage]:
    """Load one split of ``shared/data/segments``."""
    with (folder / "index.csv").open(newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if row["split"] == split]
    return [
        MaskImage(
            "real",
            row["category"],
            group=group_of(row["image"]),
            image=np.ascontiguousarray(
                _read(folder / row["image"], cv2.IMREAD_COLOR)[:, :, ::-1]
            ).astype(np.uint8),
            mask=_read(folder / row["mask"], cv2.IMREAD_UNCHANGED).astype(np.uint16),
        )
        for row in rows
    ]


def load_scenes(folder: Path) -> list[MaskImage]:
    """Load rendered scenes: ``NAME.jpg`` with ``NAME_CATEGORY.png`` instance masks beside it."""
    out = []
    for path in sorted(folder.glob("*.jpg")):
        rgb = _read(path, cv2.IMREAD_COLOR)[:, :, ::-1]
        image = np.ascontiguousarray(rgb).astype(np.uint8)
        for mask in sorted(folder.glob(f"{path.stem}_*.png")):
            category = mask.stem.removeprefix(f"{path.stem}_")
            ids = _read(mask, cv2.IMREAD_UNCHANGED).astype(np.uint16)
            if ids.ndim == 2:
                out.append(MaskImage("scene", category, group=path.stem, image=image, mask=ids))
    return out


def objects_of(images: Sequence[MaskImage], least_side_px: int = LEAST_SIDE_PX) -> list[MaskObject]:
    """List every object whose bounding box is at least that large both ways."""
    out = []
    for index, sample in enumerate(images):
        for number in np.unique(sample.mask)[1:]:
            x, y, w, h = cv2.boundingRect((sample.mask == number).astype(np.uint8))
            if min(w, h) >= least_side_px:
                item = MaskObject(index, int(number), x0=x, y0=y, x1=x + w, y1=y + h)
                out.append(item)
    return out


def is_sound(sample: MaskImage, item: MaskObject) -> bool:
    """Return whether a mask can train.

    Ragged pools are those whose semi-automatic outline lost the shaded half.
    """
    if sample.category != "swimming-pool" or sample.source != "real":
        return True
    ids = sample.mask[item.y0 : item.y1, item.x0 : item.x1]
    inside = (ids == item.id).astype(np.uint8)
    outlines, _ = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    hull = cv2.convexHull(np.concatenate(outlines))
    # Contours run through pixel centres, so half a pixel around them is missing.
    margin = 0.5 * (item.x1 - item.x0 + item.y1 - item.y0)
    hull_area = cv2.contourArea(hull) + margin
    return bool(inside.sum() >= _MIN_SOLIDITY * hull_area)


class Example(NamedTuple):
    """Training crop: ``image`` ``[s, s, 3]``, and coverage ``mask`` ``[s, s]`` in 0..1."""

    image: Picture
    mask: Coverage


def _turn(rng: Generator) -> float:
    """Draw any angle, or nearly a multiple of a right angle, at which users' boxes fit."""
    if rng.random() < 0.5:
        return rng.uniform(0, 2 * np.pi)
    return float(rng.integers(4)) * np.pi / 2 + rng.normal(0, 0.08)


def cut(
    rng: Generator,
    sample: MaskImage,
    side: int,
    scale: float,
    focus: tuple[float, float],
    number: int | None,
) -> Example:
    """Cut a turned, flipped, rescaled crop around ``focus``, with one mask or none."""
    height, width = sample.image.shape[:2]
    reach = 0.75 * side / scale + 2
    x0 = int(max(0, focus[0] - reach))
    y0 = int(max(0, focus[1] - reach))
    x1 = int(min(width, focus[0] + reach)) + 1
    y1 = int(min(height, focus[1] + reach)) + 1
    part = sample.image[y0:y1, x0:x1]
    ids = sample.mask[y0:y1, x0:x1]
    part_mask = np.zeros(ids.shape, np.uint8)
    if number is not None:
        part_mask[ids == number] = 255
    # A strong reduction averages first, so that the warp does not alias.
    reduce = min(1.0, scale * 1.1)
    sx = 1.0
    sy = 1.0
    if reduce < 0.9:
        part_h, part_w = part.shape[:2]
        small_w = max(4, round(part_w * reduce))
        small_h = max(4, round(part_h * reduce))
        size = (small_w, small_h)
        sx = small_w / part_w
        sy = small_h / part_h
        part = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        small_mask = cv2.resize(part_mask, size, interpolation=cv2.INTER_AREA)
        part_mask = np.asarray(small_mask, dtype=np.uint8)
    turn = _turn(rng)
    flip = -1.0 if rng.random() < 0.5 else 1.0
    cos = np.cos(turn)
    sin = np.sin(turn)
    rotation = np.array([[cos * flip, -sin], [sin * flip, cos]]) * scale
    shift = side / 2 - rotation @ (focus[0] - x0, focus[1] - y0)
    matrix = np.column_stack([rotation / (sx, sy), shift])
    # warpAffine counts from pixel centres.
    matrix[:, 2] += matrix[:, :2] @ (0.5, 0.5) - 0.5
    if rng.random() < 0.6:
        fill = tuple(_FILLS[rng.integers(len(_FILLS))])
    else:
        fill = tuple(part[::8, ::8].reshape(-1, 3).mean(axis=0))
    method = cv2.INTER_CUBIC if rng.random() < 0.5 else cv2.INTER_LINEAR
    image = cv2.warpAffine(part, matrix, (side, side), flags=method, borderValue=fill)
    mask = cv2.warpAffine(part_mask, matrix, (side, side), flags=cv2.INTER_LINEAR)
    coverage = np.asarray(mask, np.float32) / np.float32(255.0)
    return Example(np.asarray(image, np.uint8), coverage)


def box_of(mask: Coverage) -> Box | None:
    """Compute x0, y0, x1, y1 of the pixels that are more than half covered; None for too few."""
    x, y, w, h = cv2.boundingRect((mask > 0.5).astype(np.uint8))
    if min(w, h) < 4:
        return None
    return np.array([x, y, x + w, y + h], float)


def jitter(rng: Generator, box: Box, share: float) -> Box:
    """Move each side by up to ``share`` of the box's extent that way."""
    extent = np.tile(box[2:] - box[:2], 2)
    return box + rng.uniform(-share, share, 4) * extent


def draw_prompt(
    rng: Generator, mask: Coverage, box: Box
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Draw SAM points ``[6, 2]`` and labels ``[6]``: mostly a box, else points, or both."""
    points = np.zeros((MAX_POINTS, 2), np.float32)
    labels = np.full(MAX_POINTS, PADDING, np.float32)
    side = mask.shape[0]
    draw = rng.random()
    if draw < 0.84:
        share = float(rng.choice([0.04, 0.10]))
        shaken = np.clip(jitter(rng, box, share), 0, side)
        points[:2] = shaken.reshape(2, 2)
        labels[:2] = TOP_LEFT, BOTTOM_RIGHT
    if draw < 0.72:
        return points, labels
    inside = (mask > 0.5).astype(np.uint8)
    padded_depth = cv2.distanceTransform(np.pad(inside, 1), cv2.DIST_L2, 3)
    depth = padded_depth[1:-1, 1:-1]
    deep = np.argwhere(depth >= min(2.0, float(depth.max())))
    window = np.zeros_like(inside)
    # Negative points lie near the box, but clearly outside the object.
    margin = 0.4 * (box[2:] - box[:2])
    x0, y0 = np.maximum(0, (box[:2] - margin).astype(int))
    x1, y1 = np.maximum(0, (box[2:] + margin).astype(int))
    window[y0:y1, x0:x1] = 1
    grown = cv2.dilate(inside, np.ones((7, 7), np.uint8))
    clear = np.argwhere((grown == 0) & (window > 0))
    slot = 2
    for pixels, label, count in (
        (deep, POSITIVE, rng.integers(1, 4)),
        (clear, NEGATIVE, rng.integers(0, 2)),
    ):
        if not len(pixels):
            continue
        for _ in range(count):
            row, column = pixels[rng.integers(len(pixels))]
            # The first point is often the innermost one, where users click.
            if slot == 2 and rng.random() < 0.5:
                row, column = np.unravel_index(int(depth.argmax()), depth.shape)
            points[slot] = (column + 0.5, row + 0.5)
            labels[slot] = label
            slot += 1
    return points, labels


def draw_prior(rng: Generator, coverage: Coverage) -> NDArray[np.float32]:
    """Draw logits of a worse mask of the same object: shifted, blurred, grown or shrunk."""
    moved = np.roll(coverage, rng.integers(-2, 3, 2), axis=(0, 1))
    soft = cv2.GaussianBlur(moved, (0, 0), rng.uniform(0.8, 3.0))
    centred = soft - rng.uniform(0.3, 0.7)
    return (centred * rng.uniform(6, 16)).astype(np.float32)


class Batch(NamedTuple):
    """Batch: uint8 ``image`` ``[b, 3, s, s]``, prompt, ``target`` ``[b, 1, s / 2, s / 2]``."""

    image: torch.Tensor
    prompt: Prompt
    target: torch.Tensor


class CropSize(NamedTuple):
    """Size of a training batch: small crops are cheap, large ones teach outlines and context.

    Attributes:
        side_px: side of the crops.
        batch: crops in a batch.
        length_px: range of the objects' longer side, log-uniform.
        share: share of the batches.
    """

    side_px: int
    batch: int
    length_px: tuple[float, float]
    share: float


CROP_SIZES = (
    CropSize(160, 16, length_px=(20.0, 110.0), share=0.75),
    CropSize(256, 6, length_px=(70.0, 190.0), share=0.25),
)


@dataclass
class BatchStream:
    """Endless, seeded stream of whole batches of mixed sizes; the k-th is always the same."""

    images: list[MaskImage]
    seed: int

    def __post_init__(self) -> None:
        """Sort the objects by where they come from."""
        self._objects: dict[str, list[MaskObject]] = {}
        for item in objects_of(self.images):
            sample = self.images[item.image]
            name = "scene" if sample.source == "scene" else sample.category
            if is_sound(sample, item):
                self._objects.setdefault(name, []).append(item)

    def counts(self) -> dict[str, int]:
        """Count the objects from each source."""
        return {name: len(items) for name, items in self._objects.items()}

    def __getitem__(self, index: int) -> Batch:
        """Draw a size, then examples from sources by weight."""
        cv2.setNumThreads(1)
        rng = np.random.default_rng([self.seed, index])
        shares = np.array([size.share for size in CROP_SIZES])
        number = rng.choice(len(CROP_SIZES), p=shares / shares.sum())
        return self.batch(rng, CROP_SIZES[number])

    def batch(self, rng: Generator, size: CropSize) -> Batch:
        """Make one batch."""
        names = [name for name in _SOURCE_WEIGHT if name == "shape" or name in self._objects]
        weight = np.array([_SOURCE_WEIGHT[name] for name in names])
        images: list[Picture] = []
        targets = []
        points = []
        labels = []
        priors = []
        has_prior = []
        while len(images) < size.batch:
            name = names[rng.choice(len(names), p=weight / weight.sum())]
            example = self._draw(rng, name, size)
            box = box_of(example.mask)
            if box is None:
                continue
            point, label = draw_prompt(rng, example.mask, box)
            cells = size.side_px // STRIDE_PX
            small = cv2.resize(example.mask, (cells, cells), interpolation=cv2.INTER_AREA)
            target = np.asarray(small, np.float32)
            is_given = rng.random() < 0.06
            images.append(photometric(rng, example.image).transpose(2, 0, 1))
            targets.append(target[None])
            points.append(point)
            labels.append(label)
            prior = draw_prior(rng, target) if is_given else np.zeros_like(target)
            priors.append(prior[None])
            has_prior.append(np.float32(is_given))
        prompt = Prompt(
            *(torch.from_numpy(np.stack(part)) for part in (points, labels, priors, has_prior))
        )
        return Batch(
            torch.from_numpy(np.stack(images)), prompt, torch.from_numpy(np.stack(targets))
        )

    def _draw(self, rng: Generator, name: str, size: CropSize) -> Example:
        length = float(np.exp(rng.uniform(*np.log(size.length_px))))
        if name == "shape":
            return self._shape(rng, size, length)
        items = self._objects[name]
        item = items[rng.integers(len(items))]
        sample = self.images[item.image]
        item_px = max(item.x1 - item.x0, item.y1 - item.y0)
        scale = min(length / item_px, _MAX_ENLARGEMENT)
        wander = (
            rng.uniform(-1, 1, 2)
            * max(0.04, 0.5 - 0.75 * length / size.side_px)
            * size.side_px
            / scale
            * 0.7
        )
        height, width = sample.image.shape[:2]
        centre = (0.5 * (item.x0 + item.x1), 0.5 * (item.y0 + item.y1))
        reach = np.minimum(0.45 * size.side_px / scale, (width / 2, height / 2))
        reach = reach * float(rng.random() < 0.7)
        middle = np.clip(centre, reach, (width, height) - reach)
        # The object stays inside.
        limit = 0.5 * max(0.0, 0.95 * size.side_px - length) / scale
        lowest = np.subtract(centre, limit)
        highest = np.add(centre, limit)
        x, y = np.clip(middle + wander, lowest, highest).tolist()
        return cut(rng, sample, size.side_px, scale=scale, focus=(x, y), number=item.id)

    def _shape(self, rng: Generator, size: CropSize, length: float) -> Example:
        def patch() -> Picture:
            sample = self.images[rng.integers(len(self.images))]
            height, width = sample.image.shape[:2]
            drawn_scale = float(np.exp(rng.uniform(-0.5, 0.9)))
            scale = max(drawn_scale, 1.1 * size.side_px / min(height, width))
            focus = (rng.uniform(0.3, 0.7) * width, rng.uniform(0.3, 0.7) * height)
            return cut(rng, sample, size.side_px, scale, focus, None).image

        room = max(0.02, 0.5 - 0.6 * length / size.side_px) * size.side_px
        focus = size.side_px / 2 + rng.uniform(-1, 1, 2) * room
        image, mask = composite(rng, patch(), patch, length, focus)
        return Example(image, mask)
