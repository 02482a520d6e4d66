"""Run a network on whole images of known scale and keep its answers for calibration and reports.

``python -m research.training.scene_scale.cases MODEL.onnx OUT.npz --on held_out``
(or ``val``, ``train``; ``--sets`` for some).
"""

from __future__ import annotations

import argparse
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from research.training.scene_scale.data import SETS, ScaledImage, load_images, load_val_images
from vehanchor.detection.scene_scale import TILE_PX, read_tile, tile_windows
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.storage.atomic import whole_file

# Random reductions of each image, beside the image itself.
_REDUCED = 2
# Shorter side of the smallest reduced image.
_SMALLEST_PX = 1.25 * TILE_PX


class Case(NamedTuple):
    """Answers of the network for one image at one resolution."""

    set: str
    name: str
    gsd_m_per_px: float
    reduced: bool
    factors: tuple[int, ...]
    log_probs: tuple[NDArray[np.float32], ...]  # of each level [n_tiles, BINS]


def level_log_probs(
    session: onnxruntime.InferenceSession, image: NDArray[np.uint8]
) -> list[tuple[int, NDArray[np.float32]]]:
    """Factor and log-probabilities ``[n_tiles, BINS]`` of an image's levels."""
    with open_raster(image) as raster:
        levels = [
            (factor, np.stack([read_tile(raster, window, factor) for window in windows]))
            for factor, windows in tile_windows(raster.width_px, raster.height_px)
        ]
    return [(factor, session.run(["log_probs"], {"tiles": tiles})[0]) for factor, tiles in levels]


def resolutions(image: ScaledImage, count: int) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """Yield GSD and pixels of an image and of its random reductions, the same every time."""
    yield image.gsd_m_per_px, image.pixels
    rng = np.random.default_rng(zlib.crc32(image.name.encode()))
    most = min(image.pixels.shape[:2]) / _SMALLEST_PX
    for _ in range(count if most > 1.1 else 0):
        factor = float(np.exp(rng.uniform(0, np.log(most))))
        height, width = (round(side / factor) for side in image.pixels.shape[:2])
        pixels = cv2.resize(image.pixels, (width, height), interpolation=cv2.INTER_AREA)
        yield image.gsd_m_per_px * factor, np.asarray(pixels, np.uint8)


def searched_cases(
    session: onnxruntime.InferenceSession, images: Sequence[ScaledImage], reduced: int = _REDUCED
) -> list[Case]:
    """Run the network on images as they are and on ``reduced`` coarser copies of each."""
    out = []
    for image in images:
        for number, (gsd, pixels) in enumerate(resolutions(image, reduced)):
            factors, log_probs = zip(*level_log_probs(session, pixels), strict=True)
            out.append(Case(image.set, image.name, gsd, number > 0, factors, log_probs))
    return out


def save(cases: Sequence[Case], path: Path) -> None:
    """Write cases as one file."""
    levels = [
        (k, factor, len(log_probs))
        for k, c in enumerate(cases)
        for factor, log_probs in zip(c.factors, c.log_probs, strict=True)
    ]
    with whole_file(path) as partial, partial.open("wb") as handle:
        np.savez_compressed(
            handle,
            text=np.array([(c.set, c.name) for c in cases]),
            numbers=np.array([(c.gsd_m_per_px, c.reduced) for c in cases]),
            levels=np.array(levels),
            log_probs=np.concatenate([log_probs for c in cases for log_probs in c.log_probs]),
        )


def load(path: Path) -> list[Case]:
    """Read what ``save`` wrote."""
    with np.load(path) as file:
        text, numbers, levels, log_probs = (
            file[name] for name in ("text", "numbers", "levels", "log_probs")
        )
    parts = np.split(log_probs, np.cumsum(levels[:, 2])[:-1])
    out = []
    for k in range(len(text)):
        set_name, name = text[k]
        gsd, reduced = numbers[k]
        mine = np.flatnonzero(levels[:, 0] == k)
        factors = tuple(int(levels[i, 1]) for i in mine)
        out.append(
            Case(
                str(set_name),
                str(name),
                float(gsd),
                bool(reduced),
                factors,
                tuple(parts[i] for i in mine),
            )
        )
    return out


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--on", choices=("held_out", "train", "val"), default="held_out")
    parser.add_argument("--sets", default="", help=f"some of {', '.join(SETS)}; all by default")
    parser.add_argument("--every", type=int, default=1, help="take one image in so many")
    options = parser.parse_args()
    names = [name for name in options.sets.split(",") if name] or [*SETS, "tilt"]
    without = {*SETS, "tilt"} - set(names)
    if options.on == "val":
        images = load_val_images(options.data, without=without)
    else:
        images = load_images(options.data, held_out=options.on == "held_out", without=without)
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(
        options.model, settings, providers=["CPUExecutionProvider"]
    )
    cases = searched_cases(session, images[:: options.every])
    save(cases, options.out)
    print(f"{options.out}: {len(cases)} cases")


if __name__ == "__main__":
    main()
