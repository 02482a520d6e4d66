"""Collect what the search proposes: ``python -m research.training.letters.mine OUT``.

Pages, charts and other drawings are rendered, as they are or degraded, captions are drawn over
photographs, and scenes show equal things or small vehicles, or cars in their places. The search
runs as the library runs it, and each candidate that reaches the chip network becomes a row:

* ``drawn``: it lies on something drawn, or is a thing of a scene without cars. 1 for at least a
  tenth of its box, 0 for less than a hundredth, or for a rendered car. What lies between, and
  drawings over a vehicle of the bare photograph, is left out;
* ``score``: its score before the chip network.

Fonts and layouts of ``HELD_OUT_LAYOUTS`` are left out, and photographs with an odd checksum of
their name: measure on those. Chips are kept as lossless WebP, larger than the network takes them,
so that training can turn, scale and shift them.
"""

from __future__ import annotations

import argparse
import math
import os
import time
import zlib
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from research.scenes import render_scene
from research.scenes.captions import CAPTIONS
from research.scenes.degraded import degraded
from research.scenes.lettering import Picture, compressed, is_held_out, own_fonts, system_fonts
from research.scenes.look_alikes import ALL_THINGS, render_cars, render_look_alikes
from research.scenes.pages import PAGES, Fonts
from research.scenes.truth import Scene
from vehanchor.analysis.pipeline import analyse_image
from vehanchor.detection import chips, search
from vehanchor.detection.boxes import box_corners, oriented_iou
from vehanchor.detection.chips import ChipNetwork
from vehanchor.detection.detections import Objects
from vehanchor.detection.detector import Detector
from vehanchor.detection.verifier import surroundings
from vehanchor.imagery.raster import Raster
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import resolve_model
from vehanchor.options import ScaleOptions
from vehanchor.storage.atomic import whole_file

Boxes: TypeAlias = NDArray[np.float64]
"""Boxes ``[n, 5]``: x, y, length, width, angle."""

HELD_OUT_LAYOUTS = ("map", "window", "watermark")
CHIP_SIDE_PX = 132
CHIP_LENGTH_PX = 36.0
_DRAWN_SHARE = 0.10
_BARE_SHARE = 0.01
_CHANGED = 12
_SAME_PLACE = 0.6
# Candidates of one picture that are kept, best first.
_MOST_DRAWN = 6
_MOST_BARE = 4
_FIRST_SEED = 100_000
# Layout of a rendered scene without lettering; scenes have these sizes.
_BARE = "bare"
# Layout of cars in the places of things, and the overlap above which a candidate is one of them.
_CARS = "cars"
_FITTING_IOU = 0.5
_SCENE_GSD = (0.03, 0.28)
_SCENE_PX = 512
_EMPTY_SHARE = 0.3
_BYTES_PER_FILE = 15_500_000


class Task(NamedTuple):
    """Picture to draw: its seed, layout, the photograph below it, if any, and its quality."""

    seed: int
    layout: str
    photograph: Path | None = None
    is_degraded: bool = False


class Candidate(NamedTuple):
    """Candidate of the search, with its chip as a WebP file."""

    file: bytes
    drawn: int
    score: float
    logit: float
    layout: str
    seed: int


class Recorder:
    """Stands in for ``with_appearance`` and remembers the candidates."""

    def __init__(self) -> None:
        self._examine = chips.with_appearance
        self.boxes: Boxes = np.zeros((0, 5))
        self.scores: NDArray[np.float64] = np.zeros(0)
        self.logits: NDArray[np.float64] = np.zeros(0)

    def __call__(
        self,
        network: ChipNetwork,
        raster: Raster,
        candidates: Objects,
        **options: Any,
    ) -> chips.Examined:
        """Examine the candidates as the library does; the first call has all of them."""
        examined = self._examine(network, raster, candidates, **options)
        if not len(self.boxes):
            n_examined = len(examined.appearance)
            self.boxes = candidates.boxes[:n_examined]
            self.scores = candidates.scores[:n_examined]
            self.logits = examined.appearance.logits
        return examined


_RECORDER = Recorder()
search.with_appearance = _RECORDER  # type: ignore[attr-defined]


def training_fonts(folder: Path | None) -> Fonts:
    """List the fonts of a folder, or of this machine, without those held out."""
    fonts: Fonts = system_fonts()
    if folder is not None:
        fonts = (*own_fonts(), *sorted(folder.glob("*.[to]tf")))
    return [font for font in fonts if not is_held_out(font)]


def is_for_training(photograph: Path) -> bool:
    """Test whether a photograph may be drawn on: half of them, by their names."""
    return zlib.crc32(photograph.name.encode()) % 2 == 0


@cache
def _detector() -> Detector:
    """Load the bundled detector once in a process."""
    return Detector(resolve_model(None), runtime=Runtime(threads=1))


def searched(picture: Picture) -> tuple[Boxes, NDArray[np.float64], NDArray[np.float64]]:
    """Search a picture; boxes, scores and logits of the candidates for the chip network."""
    _RECORDER.boxes = np.zeros((0, 5))
    _RECORDER.scores = np.zeros(0)
    _RECORDER.logits = np.zeros(0)
    analyse_image(picture, _detector(), ScaleOptions())
    return _RECORDER.boxes, _RECORDER.scores, _RECORDER.logits


def drawn_shares(boxes: Boxes, is_drawn: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Compute the share ``[n]`` of each box that is drawn."""
    shares = np.zeros(len(boxes))
    for k, corners in enumerate(box_corners(boxes)):
        low = np.maximum(np.floor(corners.min(axis=0)).astype(int), 0)
        high = np.ceil(corners.max(axis=0)).astype(int) + 1
        part = is_drawn[low[1] : high[1], low[0] : high[0]]
        inside = np.zeros(part.shape, np.uint8)
        if inside.size == 0:
            continue
        cv2.fillConvexPoly(inside, np.rint(corners - low).astype(np.int32), 1)
        shares[k] = part[inside == 1].mean() if inside.any() else 0.0
    return shares


def candidates(task: Task, fonts: Fonts) -> list[Candidate]:
    """Draw a picture and collect its candidates."""
    rng = np.random.default_rng([task.seed, zlib.crc32(task.layout.encode())])
    if task.layout == _CARS:
        return _candidates_of_cars(task)
    if task.layout in PAGES or task.layout in ALL_THINGS:
        picture = _without_cars(task, rng, fonts)
        boxes, scores, logits = searched(picture)
        drawn = np.ones(len(boxes), np.int8)
        return _kept(task, picture, boxes, drawn, scores, logits)
    bare = _ground(task, rng)
    if task.layout == _BARE:
        boxes, scores, logits = searched(bare)
        return _kept(task, bare, boxes, np.zeros(len(boxes), np.int8), scores, logits)
    cars, car_scores, _ = searched(bare)
    cars = cars[car_scores > 0.5]
    picture = CAPTIONS[task.layout](bare, rng, fonts)
    is_drawn = _changed(bare, picture)
    picture = _recompressed(picture, rng)
    boxes, scores, logits = searched(picture)
    shares = drawn_shares(boxes, is_drawn)
    drawn = np.full(len(boxes), -1, np.int8)
    drawn[shares >= _DRAWN_SHARE] = 1
    drawn[shares < _BARE_SHARE] = 0
    if len(cars) and len(boxes):
        gap = np.linalg.norm(boxes[:, None, :2] - cars[None, :, :2], axis=2)
        on_car = (gap < _SAME_PLACE * cars[None, :, 2]).any(axis=1)
        drawn[on_car & (drawn == 1)] = -1
    return _kept(task, picture, boxes, drawn, scores, logits)


def _without_cars(task: Task, rng: Generator, fonts: Fonts) -> Picture:
    """Draw a page, or render a scene of things."""
    if task.layout in ALL_THINGS:
        return render_look_alikes(task.layout, task.seed).scene.image
    picture = PAGES[task.layout](rng, fonts)
    return degraded(picture, rng) if task.is_degraded else picture


def _candidates_of_cars(task: Task) -> list[Candidate]:
    """Render cars in the places of things, and collect the candidates that fit them."""
    scene = render_cars(task.seed)
    boxes, scores, logits = searched(scene.image)
    drawn = np.full(len(boxes), -1, np.int8)
    if len(boxes) and scene.vehicles:
        overlaps = oriented_iou(boxes, _true_boxes(scene)).max(axis=1)
        drawn[overlaps > _FITTING_IOU] = 0
    return _kept(task, scene.image, boxes, drawn, scores, logits)


def _true_boxes(scene: Scene) -> Boxes:
    """List the boxes of a scene's vehicles."""
    rows = [(v.x_px, v.y_px, v.length_px, v.width_px, v.angle_rad) for v in scene.vehicles]
    return np.array(rows).reshape(-1, 5)


def _ground(task: Task, rng: Generator) -> Picture:
    """Read the photograph of a task, or render a scene."""
    if task.photograph is None:
        gsd = float(np.exp(rng.uniform(*np.log(_SCENE_GSD))))
        n_vehicles = 0 if rng.random() < _EMPTY_SHARE else None
        scene = render_scene(
            gsd,
            width_px=_SCENE_PX,
            height_px=_SCENE_PX,
            seed=task.seed,
            n_vehicles=n_vehicles,
            fleet_kind="mixed",
        )
        return scene.image
    read = np.asarray(cv2.imread(str(task.photograph), cv2.IMREAD_COLOR), np.uint8)
    return np.ascontiguousarray(read[:, :, ::-1])


def _changed(bare: Picture, picture: Picture) -> NDArray[np.bool_]:
    """Mark the pixels ``[h, w]`` that are drawn; a strip below the photograph is drawn."""
    rows = bare.shape[0]
    is_drawn = np.ones(picture.shape[:2], bool)
    difference = np.abs(picture[:rows].astype(int) - bare).max(axis=2)
    is_drawn[:rows] = difference > _CHANGED
    return is_drawn


def _recompressed(picture: Picture, rng: Generator) -> Picture:
    """Compress a picture as ``compressed`` does, in its own size."""
    size = picture.shape
    result = compressed(picture, rng)
    return result if result.shape == size else picture


def _kept(
    task: Task,
    picture: Picture,
    boxes: Boxes,
    drawn: NDArray[np.int8],
    scores: NDArray[np.float64],
    logits: NDArray[np.float64],
) -> list[Candidate]:
    """Cut the chips of the best candidates of each kind."""
    chosen = [
        *np.flatnonzero(drawn == 1)[:_MOST_DRAWN],
        *np.flatnonzero(drawn == 0)[:_MOST_BARE],
    ]
    squares = surroundings(picture, boxes[chosen], CHIP_SIDE_PX, CHIP_LENGTH_PX)
    out = []
    for k, chip in zip(chosen, squares, strict=True):
        _, file = cv2.imencode(".webp", chip, [cv2.IMWRITE_WEBP_QUALITY, 101])
        out.append(
            Candidate(
                file.tobytes(),
                drawn=int(drawn[k]),
                score=float(scores[k]),
                logit=float(logits[k]),
                layout=task.layout,
                seed=task.seed,
            )
        )
    return out


_FONTS: Fonts = ()


def _start(folder: Path | None) -> None:
    """Prepare a process of the pool."""
    global _FONTS
    cv2.setNumThreads(1)
    _FONTS = training_fonts(folder)


def _work(task: Task) -> list[Candidate]:
    return candidates(task, _FONTS)


def tasks_of_things(n_things: int, n_cars: int, n_degraded: int) -> list[Task]:
    """List the scenes of things, those of cars in their places, and degraded pages, in turn."""
    kinds = list(ALL_THINGS)
    pages = [name for name in PAGES if name not in HELD_OUT_LAYOUTS]
    listed = [Task(_FIRST_SEED + k, kinds[k % len(kinds)]) for k in range(n_things)]
    listed += [Task(_FIRST_SEED + k, _CARS) for k in range(n_cars)]
    listed += [
        Task(_FIRST_SEED + k, pages[k % len(pages)], is_degraded=True) for k in range(n_degraded)
    ]
    return listed


def tasks(photographs: Path, n_pages: int, n_captions: int, n_scenes: int) -> list[Task]:
    """List the pictures to draw, kinds in turn."""
    pages = [name for name in PAGES if name not in HELD_OUT_LAYOUTS]
    captions = [name for name in CAPTIONS if name not in HELD_OUT_LAYOUTS]
    files = [path for path in sorted(photographs.rglob("*.jpg")) if is_for_training(path)]
    listed = [Task(_FIRST_SEED + k, pages[k % len(pages)]) for k in range(n_pages)]
    for k in range(n_captions if files else 0):
        photograph = files[(k * 7) % len(files)]
        listed.append(Task(_FIRST_SEED + k, captions[k % len(captions)], photograph))
    for k in range(n_scenes):
        layout = captions[k % len(captions)] if k % 2 else _BARE
        listed.append(Task(_FIRST_SEED + k, layout))
    order = np.random.default_rng(0).permutation(len(listed))
    return [listed[k] for k in order]


def save(found: list[Candidate], out: Path) -> None:
    """Write the candidates, as many files as their size needs."""
    out.mkdir(parents=True, exist_ok=True)
    parts: list[list[Candidate]] = [[]]
    size = 0
    for candidate in found:
        if size + len(candidate.file) > _BYTES_PER_FILE:
            parts.append([])
            size = 0
        parts[-1].append(candidate)
        size += len(candidate.file)
    for k, part in enumerate(parts):
        columns = {name: [getattr(c, name) for c in part] for name in Candidate._fields}
        files = columns.pop("file")
        ends = np.cumsum([len(file) for file in files])
        with whole_file(out / f"letters_{k}.npz") as partial, partial.open("wb") as handle:
            joined = np.frombuffer(b"".join(files), np.uint8)
            np.savez(handle, files=joined, ends=ends, **columns)  # type: ignore[arg-type]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--photographs", type=Path, default=Path("../shared/data/unlabelled"))
    parser.add_argument("--fonts", type=Path, help="folder of fonts instead of this machine's")
    parser.add_argument("--pages", type=int, default=900)
    parser.add_argument("--captions", type=int, default=600)
    parser.add_argument("--bare", type=Path, help="folder of photographs to search as they are")
    parser.add_argument("--scenes", type=int, default=300)
    parser.add_argument("--things", type=int, default=500)
    parser.add_argument("--cars", type=int, default=200)
    parser.add_argument("--degraded", type=int, default=200)
    parser.add_argument("--most", type=int, default=100_000, help="candidates to keep")
    parser.add_argument("--seconds", type=float, default=math.inf, help="when to end")
    options = parser.parse_args()
    listed = tasks(options.photographs, options.pages, options.captions, options.scenes)
    listed += tasks_of_things(options.things, options.cars, options.degraded)
    if options.bare:
        files = sorted(options.bare.rglob("*.jpg"))
        listed += [Task(_FIRST_SEED + k, _BARE, path) for k, path in enumerate(files)]
    found: list[Candidate] = []
    end = time.monotonic() + options.seconds
    with ProcessPoolExecutor(os.cpu_count(), initializer=_start, initargs=(options.fonts,)) as pool:
        for k, part in enumerate(pool.map(_work, listed, chunksize=4)):
            found += part
            if time.monotonic() > end:
                pool.shutdown(cancel_futures=True)
                break
            if k % 50 == 0:
                drawn = sum(candidate.drawn for candidate in found)
                print(k, len(listed), len(found), drawn, flush=True)
    order = np.random.default_rng(1).permutation(len(found))[: options.most]
    save([found[k] for k in order], options.out)


if __name__ == "__main__":
    main()
