"""Compare exported files by resolution: ``python -m research.training.scene_scale.compare OUT.json A.onnx B.onnx``.

Each file is asked through the library about val images of known scale and about the even numbers of ``chia/``, as they
are. An error is that of the density's median, in log.
"""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from research.training.scene_scale.data import ScaledImage, load_val_images
from vehanchor.detection.scene_scale import SceneScaleNetwork
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.scale.density import GRID
from vehanchor.storage.atomic import whole_file

_BANDS = (0.0, 0.018, 0.03, 0.06, 0.12, 0.2, 0.35, 1.2)  # m/px
_WITHIN = 1.5
_SHARES = (0.025, 0.5, 0.975)
_SKIPPED = ("building", "empty")  # scales within a factor of two known only; nothing that drones fly over


def compared(network: SceneScaleNetwork, images: Sequence[ScaledImage]) -> list[tuple[str, float, float, bool, float]]:
    """Set, true scale, log error, whether the interval holds, and its width in log, of each image."""
    out = []
    for image in images:
        with open_raster(image.pixels) as raster:
            density = network.predict(raster).density
        below = np.cumsum(density) - 0.5 * density
        low, middle, high = np.exp(np.interp(_SHARES, below / density.sum(), GRID))
        truth = image.gsd_m_per_px
        out.append(
            (image.set, truth, float(np.log(middle / truth)), bool(low < truth < high), float(np.log(high / low)))
        )
    return out


def some_of_each(images: Sequence[ScaledImage], most: int) -> list[ScaledImage]:
    """Select at most ``count`` images of each set, evenly spaced."""
    sets: dict[str, list[ScaledImage]] = {}
    for image in images:
        sets.setdefault(image.set, []).append(image)
    return [each[k] for each in sets.values() for k in np.unique(np.linspace(0, len(each) - 1, most).astype(int))]


def summary(rows: Sequence[tuple[str, float, float, bool, float]]) -> dict[str, float]:
    """Median absolute and signed log error, shares within a factor and inside the interval, the median width."""
    errors = np.array([row[2] for row in rows])
    return {
        "images": len(rows),
        "median_abs_log_error": round(float(np.median(np.abs(errors))), 3),
        "median_log_error": round(float(np.median(errors)), 3),
        "within_1.5": round(float(np.mean(np.abs(errors) < np.log(_WITHIN))), 3),
        "interval_holds": round(float(np.mean([row[3] for row in rows])), 3),
        "median_high_over_low": round(float(np.exp(np.median([row[4] for row in rows]))), 2),
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("models", type=Path, nargs="+")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--most", type=int, default=30, help="images of a set, evenly spread")
    options = parser.parse_args()
    images = some_of_each(load_val_images(options.data, without=_SKIPPED), options.most)
    result: dict[str, dict[str, dict[str, float]]] = {}
    for model in options.models:
        rows = compared(SceneScaleNetwork(model, runtime=Runtime(threads=1)), images)
        table = {name: summary([row for row in rows if row[0] == name]) for name in sorted({row[0] for row in rows})}
        for low, high in itertools.pairwise(_BANDS):
            inside = [row for row in rows if low <= row[1] < high]
            if inside:
                table[f"{low:g} to {high:g} m/px"] = summary(inside)
        result[f"{model.parent.name}/{model.name}"] = table
        print(model)
        for name, numbers in table.items():
            print(f"  {name:22s} {numbers}")
    with whole_file(options.out) as partial:
        partial.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
