"""Render labelled scenes for training.

``python -m research.training.render_scenes detector OUT --count 120``.

``detector``: car parks, streets and yards, a tenth of them without vehicles. ``chips``: mixed
fleets with kei cars, open beds, loads and roof racks, finer; a quarter shows no vehicle, so that
everything found there is a look-alike. ``courts``: sports grounds, with the corners of the courts.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from research.scenes import render_scene
from vehanchor.storage.atomic import whole_file

if TYPE_CHECKING:
    from research.scenes import Scene


class _Choice(NamedTuple):
    """Options of a kind of scene.

    Attributes:
        gsd_m_per_px: range of the scale.
        side_px: side of the image.
        first_seed: first seed; tests and examples use those below 1,000.
        empty_share: share without vehicles.
        length_m: range of the fleet's mean length.
    """

    gsd_m_per_px: tuple[float, float]
    side_px: int
    first_seed: int
    empty_share: float = 0.0
    length_m: tuple[float, float] | None = None


_CHOICES = {
    "detector": _Choice((0.07, 0.28), 640, first_seed=1_000, empty_share=0.1, length_m=(4.1, 5.1)),
    "chips": _Choice((0.03, 0.28), 512, first_seed=50_000, empty_share=0.25, length_m=(3.9, 5.2)),
    "courts": _Choice((0.2, 0.35), 576, 1_000),
}


def rendered(kind: str, seed: int) -> Scene:
    """Render a scene of a kind."""
    choice = _CHOICES[kind]
    rng = np.random.default_rng(seed)
    gsd = float(np.exp(rng.uniform(*np.log(choice.gsd_m_per_px))))
    if choice.length_m is None:
        return render_scene(
            gsd, width_px=choice.side_px, height_px=choice.side_px, seed=seed, layout="sports"
        )
    return render_scene(
        gsd,
        width_px=choice.side_px,
        height_px=choice.side_px,
        seed=seed,
        n_vehicles=0 if rng.random() < choice.empty_share else None,
        mean_vehicle_length_m=rng.uniform(*choice.length_m),
        fleet_kind="mixed" if kind == "chips" else "passenger",
    )


def write(scene: Scene, kind: str, path: Path) -> None:
    """Write a scene and what its labels lack: bodies of vehicles, or corners of courts."""
    if kind == "courts":
        cv2.imwrite(str(path.with_suffix(".png")), scene.image[:, :, ::-1])
        courts = [{"kind": court.kind, "corners": court.corners.tolist()} for court in scene.courts]
        path.with_suffix(".json").write_text(
            json.dumps({"gsd": scene.gsd_m_per_px, "courts": courts})
        )
        return
    scene.write(path)
    if kind == "chips":
        with whole_file(path.with_suffix(".bodies.json")) as partial:
            partial.write_text(json.dumps([vehicle.body for vehicle in scene.vehicles]))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=sorted(_CHOICES))
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=120)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    first = _CHOICES[options.kind].first_seed
    for seed in range(first, first + options.count):
        write(rendered(options.kind, seed), options.kind, options.out / f"scene_{seed}.jpg")


if __name__ == "__main__":
    main()
