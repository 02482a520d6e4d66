"""Render places with courts to train on: ``python -m research.training.courts.render_scenes FOLDER [--scenes 80]``."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import cv2
import numpy as np

from research.scenes import render_scene

_SIDE_PX = 576
_FIRST_SEED = 1000
_FINEST_M, _COARSEST_M = 0.2, 0.35


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scenes", type=int, default=80)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    for seed in range(_FIRST_SEED, _FIRST_SEED + options.scenes):
        gsd = math.exp(np.random.default_rng(seed).uniform(math.log(_FINEST_M), math.log(_COARSEST_M)))
        scene = render_scene(gsd, width_px=_SIDE_PX, height_px=_SIDE_PX, seed=seed, layout="sports")
        cv2.imwrite(str(options.folder / f"{seed}.png"), scene.image[:, :, ::-1])
        courts = [{"kind": court.kind, "corners": court.corners.tolist()} for court in scene.courts]
        (options.folder / f"{seed}.json").write_text(json.dumps({"gsd": gsd, "courts": courts}))


if __name__ == "__main__":
    main()
