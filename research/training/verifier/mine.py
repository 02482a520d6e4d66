"""Collect candidates.

``python -m research.training.verifier.mine MODEL.onnx RUN``; writes ``train.npz`` and
``held_out.npz``.

The detector is best one that has not learned from the newer images: of what it was trained on it is
surer than it should be, and its false alarms there are gone. ``--without estonia`` leaves sets out,
as that of ``research.training.detector.train`` does.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from research.training.detector.data import (
    TrainImage,
    distracted,
    draw_crop,
    load_scenes,
    load_train_images,
)
from research.training.detector.scenery import load_scenery
from research.training.verifier.data import mined, save
from vehanchor.detection.detector import Detector
from vehanchor.models.runtime import Runtime

_DISTRACTED_CROPS = 400
# Length of a car in a crop without cars.
_CAR_PX = 22.0


def distracted_crops(images: Sequence[TrainImage], count: int, seed: int = 0) -> list[TrainImage]:
    """Draw striped and gridded objects over a part of crops of train images."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        image = images[int(rng.integers(len(images)))]
        crop = distracted(rng, draw_crop(rng, image))
        out.append(
            TrainImage(
                "distracted",
                crop.image,
                boxes=crop.boxes,
                ignore=crop.ignore,
                clutter=np.zeros((0, 2)),
                car_px=_CAR_PX,
            )
        )
    return out


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--scenes", type=Path, help="folder of `render_scenes detector`")
    parser.add_argument("--without", default="", help="sets to leave out, comma between")
    options = parser.parse_args()
    detector = Detector(options.model, runtime=Runtime(threads=1))
    for held_out, name in ((True, "held_out"), (False, "train")):
        images = load_train_images(options.data / "vehicles", held_out=held_out)
        images += load_scenery(options.data, held_out=held_out)
        images = [image for image in images if image.set not in options.without.split(",")]
        if not held_out:
            images += distracted_crops(images, _DISTRACTED_CROPS)
            images += load_scenes(options.scenes) if options.scenes else []
        candidates = mined(images, detector)
        save(candidates, options.run / f"{name}.npz")
        print(
            f"{name}: {candidates.car.sum()} cars, {(~candidates.car).sum()} false alarms in "
            f"{len(images)} images",
            flush=True,
        )


if __name__ == "__main__":
    main()
