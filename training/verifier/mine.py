"""Collect candidates: ``python -m training.verifier.mine MODEL.onnx RUN``; writes ``train.npz`` and ``held_out.npz``.

The detector is best one that has not learned from the newer images: of what it was trained on it is surer than it
should be, and its false alarms there are gone.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from training.detector.data import load_train_images
from training.detector.scenery import load_scenery
from training.verifier.data import mined, save
from vehanchor.detection.detector import Detector


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    options = parser.parse_args()
    detector = Detector(options.model, threads=1)
    for held_out, name in ((True, "held_out"), (False, "train")):
        images = load_train_images(options.data / "vehicles", held_out=held_out)
        images += load_scenery(options.data, held_out=held_out)
        found = mined(images, detector)
        save(found, options.run / f"{name}.npz")
        print(f"{name}: {found.car.sum()} cars, {(~found.car).sum()} false alarms in {len(images)} images", flush=True)


if __name__ == "__main__":
    main()
