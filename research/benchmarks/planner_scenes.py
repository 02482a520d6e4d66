"""Render the twelve scenes that a scripted planner is asked about.

    python -m research.benchmarks.planner_scenes /tmp/scenes && vehanchor evaluate questions /tmp/scenes

Their ground sampling distances lie between 0.07 and 0.2 m/px; all layouts are among them, and a countryside with few
cars, too.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor_scenes import render_scene

if TYPE_CHECKING:
    from vehanchor_scenes.truth import Layout

SCENES: tuple[tuple[float, Layout], ...] = (
    (0.07, "parking"),
    (0.1, "urban"),
    (0.12, "sports"),
    (0.15, "urban"),
    (0.09, "parking"),
    (0.18, "urban"),
    (0.12, "countryside"),
    (0.2, "parking"),
    (0.1, "sports"),
    (0.14, "urban"),
    (0.11, "parking"),
    (0.16, "sports"),
)
FIRST_SEED = 100


def main(folder: Path) -> None:
    """Write the scenes and their truth."""
    folder.mkdir(parents=True, exist_ok=True)
    for number, (gsd, layout) in enumerate(SCENES):
        scene = render_scene(gsd, width_px=1024, height_px=800, seed=FIRST_SEED + number, layout=layout)
        scene.write(folder / f"s{number:02}.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
