"""Measure how much of a photograph of 8 to 20 megapixels is searched.

``python -m research.benchmarks.photographs make|compare FOLDER``. Prints Markdown; ``--record`` keeps it.

``make`` writes photographs without metadata: mosaics of neighbouring tiles, enlarged drone photographs, and rendered
scenes. ``compare`` estimates each with the efforts ``full`` and ``auto`` in turns, in one thread of this process, and
compares CPU seconds, values and statuses.
"""

from __future__ import annotations

import argparse
import csv
import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np

from research.results.record import add_record_option, header, recording
from research.scenes import render_scene
from vehanchor.engine import Engine
from vehanchor.models.runtime import Runtime

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from research.scenes import Layout
    from vehanchor.records import GsdEstimate

Image: TypeAlias = "NDArray[np.uint8]"
SIZES_PX = ((3264, 2448), (4000, 3000), (4608, 3456), (5120, 3840))  # 8, 12, 16 and 20 megapixels
_JPEG_QUALITY = 92
_CANNES_COLUMNS, _CANNES_PX = 49, 512
_CANNES_VAL_ROWS = range(16, 21)
_MOST_CHANGE = 0.02
_SCENES: tuple[tuple[Layout, float], ...] = (
    ("urban", 0.04),
    ("parking", 0.06),
    ("countryside", 0.1),
    ("urban", 0.15),
    ("parking", 0.12),
    ("sports", 0.08),
)


def _read(path: Path) -> Image:
    found = cv2.imread(str(path))
    if found is None:
        raise FileNotFoundError(path)
    return np.asarray(found, np.uint8)


def _fitted(image: Image, size: tuple[int, int]) -> Image:
    """Enlarge an image to cover a size, and cut its centre."""
    factor = max(size[0] / image.shape[1], size[1] / image.shape[0])
    whole = np.asarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC), np.uint8)
    left, top = (whole.shape[1] - size[0]) // 2, (whole.shape[0] - size[1]) // 2
    return whole[top : top + size[1], left : left + size[0]]


def _files(data: Path, table: str, name: str, split: str) -> list[Path]:
    with (data / "gsd" / table).open() as lines:
        rows = [row for row in csv.DictReader(lines) if (row["set"], row["split"]) == (name, split)]
    return [data / "gsd" / row["file"] for row in rows]


def _chia(data: Path, table: str, split: str) -> list[Path]:
    """List the nadir photographs, or the crops, of a split: odd numbers train, even ones are val."""
    with (data / "chia" / table).open() as lines:
        paths = [data / "chia" / row["file"] for row in csv.DictReader(lines) if row["gsd_m_per_px"]]
    return [path for path in sorted(paths) if (int(path.stem[4:]) % 2 == 1) == (split == "train")]


def _cannes(data: Path, split: str, size: tuple[int, int], rng: np.random.Generator, enlarged: int = 1) -> Image:
    """Lay out neighbours at 0.2 m/px; tiles that the set lacks are replaced by others of the split."""
    tiles = {int(path.stem.rpartition("_")[2]): path for path in _files(data, "table.csv", "cannes", split)}
    columns, rows = (-(-side // (_CANNES_PX * enlarged)) for side in size)
    lines = _CANNES_VAL_ROWS if split == "val" else range(_CANNES_VAL_ROWS.start)
    top = int(rng.integers(lines.start, max(lines.stop - rows, lines.start) + 1))
    left, others = int(rng.integers(0, _CANNES_COLUMNS - columns)), sorted(tiles)

    def tile(row: int, column: int) -> Image:
        image = _read(tiles.get(row * _CANNES_COLUMNS + column) or tiles[others[int(rng.integers(len(others)))]])
        return np.pad(image, ((0, 0), (0, _CANNES_PX - image.shape[1]), (0, 0)), "symmetric")

    mosaic = np.vstack([np.hstack([tile(top + y, left + x) for x in range(columns)]) for y in range(rows)])
    if enlarged > 1:
        mosaic = np.asarray(cv2.resize(mosaic, None, fx=enlarged, fy=enlarged, interpolation=cv2.INTER_CUBIC), np.uint8)
    return mosaic[: size[1], : size[0]]


def _mosaic(files: list[Path], size: tuple[int, int], rng: np.random.Generator) -> Image:
    """Lay out images of one set in any order."""
    images = [_read(files[int(k)]) for k in rng.permutation(len(files))]
    side = min(min(image.shape[:2]) for image in images)
    columns, rows = (-(-extent // side) for extent in size)
    chosen = [images[k % len(images)][:side, :side] for k in range(columns * rows)]
    mosaic = np.vstack([np.hstack(chosen[row * columns : (row + 1) * columns]) for row in range(rows)])
    return mosaic[: size[1], : size[0]]


class Recipe(NamedTuple):
    """How to make one photograph.

    Attributes:
        data: folder of the images.
        split: train or val.
        number: of the photograph, from 0.
        of: number of photographs of a kind.
        size: width and height, pixels.
        rng: random numbers.
    """

    data: Path
    split: str
    number: int
    of: int
    size: tuple[int, int]
    rng: np.random.Generator

    def chosen(self, paths: list[Path]) -> Path:
        """Choose one of some files, evenly."""
        return paths[self.number * len(paths) // self.of]

    def scene(self, layout: Layout, gsd_m_per_px: float) -> Image:
        """Render a scene."""
        seed = self.number + (1000 if self.split == "val" else 0)
        width, height = self.size
        scene = render_scene(
            gsd_m_per_px, width_px=width, height_px=height, seed=seed, layout=layout, fleet_kind="mixed"
        )
        return np.asarray(scene.image[:, :, ::-1])


def _garfield(to: Recipe) -> Image:
    return _fitted(_read(to.chosen(sorted((to.data / "flights" / "garfield").glob("*.jpg")))), to.size)


_KINDS: dict[str, Callable[[Recipe], Image]] = {
    "cannes": lambda to: _cannes(to.data, to.split, to.size, to.rng),
    "cannes-enlarged": lambda to: _cannes(to.data, to.split, to.size, to.rng, 2),
    "saopaulo": lambda to: _mosaic(_files(to.data, "table.csv", "saopaulo", to.split), to.size, to.rng),
    "estonia": lambda to: _mosaic(_files(to.data, "upright.csv", "estonia", to.split), to.size, to.rng),
    "chia": lambda to: _fitted(_read(to.chosen(_chia(to.data, "table.csv", to.split))), to.size),
    "chia-crop": lambda to: _fitted(_read(to.chosen(_chia(to.data, "crops.csv", to.split))), to.size),
}


def photographs(data: Path, each: int) -> Iterator[tuple[str, Image]]:
    """Make the photographs as names and BGR pixels: ``each`` of every kind, of dense scenes a third."""
    scenes: dict[str, Callable[[Recipe], Image]] = {
        f"{layout}-{gsd:g}": lambda to, layout=layout, gsd=gsd: to.scene(layout, gsd)  # type: ignore[misc]
        for layout, gsd in _SCENES
    }
    kinds = [(split, *kind) for split in ("train", "val") for kind in (_KINDS | scenes).items()]
    for number, (split, kind, made) in enumerate([*kinds, ("val", "garfield", _garfield)]):
        few_cars = kind not in scenes or kind.startswith("countryside")
        for k in range(each if few_cars else max(1, each // 3)):
            size = SIZES_PX[(number + k) % len(SIZES_PX)]
            yield f"{kind}_{split}_{k}", made(Recipe(data, split, k, each, size, np.random.default_rng((number, k))))


def make(data: Path, folder: Path, each: int) -> None:
    """Write the photographs as JPEG files; those that exist stay."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in photographs(data, each):
        cv2.imwrite(str(folder / f"{name}.jpg"), image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        print(name, image.shape, flush=True, file=sys.stderr)


class Pair(NamedTuple):
    """One photograph with the efforts ``full`` and ``auto``.

    Attributes:
        kind: of the photograph.
        full: record of the full search.
        auto: record of the search that may end early.
        full_s: CPU seconds of the full search.
        auto_s: CPU seconds of the other.
    """

    kind: str
    full: GsdEstimate
    auto: GsdEstimate
    full_s: float
    auto_s: float

    @property
    def change(self) -> float:
        """Relative difference of the values; inf if one of them has none, 0 if both."""
        full, auto = self.full.gsd_m_per_px, self.auto.gsd_m_per_px
        if full is None or auto is None:
            return 0.0 if full == auto else math.inf
        return abs(auto / full - 1)


def pair(path: Path, engine: Engine, rounds: int) -> Pair:
    """Estimate a photograph with both efforts in turns; CPU seconds are medians of the rounds."""
    seconds: dict[str, list[float]] = {"full": [], "auto": []}
    records = {}
    for _ in range(rounds):
        for effort, spent in seconds.items():
            started = time.process_time()
            records[effort] = engine.estimate(str(path), effort="full" if effort == "full" else "auto")
            spent.append(time.process_time() - started)
    kind = path.stem.rpartition("_")[0]
    return Pair(kind, records["full"], records["auto"], *(statistics.median(each) for each in seconds.values()))


def row(name: str, pairs: list[Pair]) -> str:
    """One line of the table."""
    cpu = statistics.median(each.auto_s / each.full_s for each in pairs)
    tiles = statistics.median(each.auto.tiles_searched / each.full.tiles_searched for each in pairs)
    usable = [each for each in pairs if each.full.status == "ok"]
    within = f"{sum(each.change <= _MOST_CHANGE for each in usable)} of {len(usable)}" if usable else "-"
    most = f"{max(each.change for each in usable):.1%}" if usable else "-"
    same = sum(each.full.status == each.auto.status for each in pairs)
    early = sum(each.auto.tiles_searched < each.full.tiles_searched for each in pairs)
    seconds = statistics.median(each.full_s for each in pairs)
    return (
        f"| {name} | {len(pairs)} | {seconds:.1f} | {cpu:.2f} | {tiles:.2f} | {early} | {within} | {most} | "
        f"{same} of {len(pairs)} |"
    )


def main() -> None:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    making = commands.add_parser("make")
    making.add_argument("folder", type=Path)
    making.add_argument("--data", type=Path, required=True)
    making.add_argument("--each", type=int, default=6, help="photographs of a kind")
    comparing = commands.add_parser("compare")
    comparing.add_argument("folder", type=Path)
    comparing.add_argument("--split", choices=["train", "val"], default="val")
    comparing.add_argument("--rounds", type=int, default=1)
    add_record_option(comparing)
    chosen = parser.parse_args()
    if chosen.command == "make":
        make(chosen.data, chosen.folder, chosen.each)
        return
    engine = Engine(runtime=Runtime(threads=1))
    files = sorted(chosen.folder.glob(f"*_{chosen.split}_*.jpg"))
    engine.estimate(str(files[0]))  # loads the models
    pairs = []
    for path in files:
        pairs.append(pair(path, engine, chosen.rounds))
        found = pairs[-1]
        print(
            f"{path.stem} {found.full_s:.2f} {found.auto_s:.2f} s, {found.full.tiles_searched} "
            f"{found.auto.tiles_searched} tiles, {found.full.status} {found.auto.status} {found.change:.2%} "
            f"{found.full.n_vehicles} {found.auto.n_vehicles} {found.full.reason} {found.auto.reason}",
            file=sys.stderr,
            flush=True,
        )
    with recording("speed", ["photographs"], chosen.record):
        columns = ("photographs", "n", "full, CPU s", "CPU time / full", "tiles / full", "ended early")
        print(header(*columns, "ok values within 2 %", "largest difference", "equal statuses"))
        for kind in dict.fromkeys(each.kind for each in pairs):
            print(row(kind.rpartition("_")[0], [each for each in pairs if each.kind == kind]))
        print(row("all", pairs))


if __name__ == "__main__":
    main()
