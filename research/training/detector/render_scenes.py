"""Render labelled scenes to train on: ``python -m research.training.detector.render_scenes OUT --count 120``."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from research.scenes import render_scene

_GSD_RANGE_M_PER_PX = (0.07, 0.28)
_SIDE_PX = 640


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=120)
    parser.add_argument("--seed", type=int, default=1_000, help="first scene seed; tests and examples use those below")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for seed in range(options.seed, options.seed + options.count):
        path = options.out / f"scene_{seed}.jpg"
        if path.exists():
            continue
        rng = np.random.default_rng(seed)
        gsd = float(np.exp(rng.uniform(*np.log(_GSD_RANGE_M_PER_PX))))
        vehicles = 0 if rng.random() < 0.1 else None
        scene = render_scene(
            gsd,
            width_px=_SIDE_PX,
            height_px=_SIDE_PX,
            seed=seed,
            n_vehicles=vehicles,
            mean_vehicle_length_m=float(rng.uniform(4.1, 5.1)),
        )
        scene.write(path)


if __name__ == "__main__":
    main()
