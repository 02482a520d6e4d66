"""Render scenes of mixed fleets: ``python -m research.training.car_verifier.render_scenes OUT --count 150``.

Kei cars, pickups with open beds and loads, work vehicles and roof racks, at 0.03 to 0.28 m/px; a quarter of the scenes
holds no vehicle, so that everything found there is a look-alike. Vehicles' bodies are written beside each picture.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from research.scenes import render_scene
from vehanchor.storage.atomic import whole_file

_GSD_RANGE_M_PER_PX = (0.03, 0.28)
_SIDE_PX = 512
_EMPTY_SHARE = 0.25


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=150)
    parser.add_argument("--seed", type=int, default=50_000, help="first scene seed")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for seed in range(options.seed, options.seed + options.count):
        path = options.out / f"scene_{seed}.jpg"
        if path.with_suffix(".bodies.json").exists():
            continue
        rng = np.random.default_rng(seed)
        scene = render_scene(
            float(np.exp(rng.uniform(*np.log(_GSD_RANGE_M_PER_PX)))),
            width_px=_SIDE_PX,
            height_px=_SIDE_PX,
            seed=seed,
            n_vehicles=0 if rng.random() < _EMPTY_SHARE else None,
            mean_vehicle_length_m=float(rng.uniform(3.9, 5.2)),
            fleet_kind="mixed",
        )
        scene.write(path)
        with whole_file(path.with_suffix(".bodies.json")) as partial:
            partial.write_text(json.dumps([vehicle.body for vehicle in scene.vehicles]))


if __name__ == "__main__":
    main()
