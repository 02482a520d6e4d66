"""Records of the bundled models on the scenes of ``examples/``, kept to see what a change of the code does to them.

``python -m tests.records`` writes them anew: after new weights, or after a change that is meant to
move them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from vehanchor import estimate_gsd, measure_area

_ROOT = Path(__file__).parent.parent
KEPT = Path(__file__).with_suffix(".json")
SCENES = sorted((_ROOT / "examples").glob("**/*.jpg"))
CASES = [
    pytest.param(each, marks=[] if each.name == "safe.jpg" else pytest.mark.slow, id=each.name)
    for each in SCENES
]
"""The scenes as a test takes them: one of them quick."""


def records_of(scene: Path) -> dict[str, Any]:
    """The scene's records: its scale, its scale by the paper's rules alone, the area around its middle."""
    estimate = estimate_gsd(scene, threads=2)
    width = estimate.image_width_px
    height = estimate.image_height_px
    box = (0.3 * width, 0.3 * height, 0.6 * width, 0.62 * height)
    records = {
        "estimate": estimate,
        "paper": estimate_gsd(
            scene, threads=2, search_scales=False, aggregation="kde", reference_length_m=5.045
        ),
        "area": measure_area(scene, box=box, threads=2),
    }
    return {name: _kept(record.model_dump(mode="json")) for name, record in records.items()}


def _kept(value: Any) -> Any:
    """All but checksums, and the outline, whose corners may change with one pixel."""
    if isinstance(value, dict):
        return {
            key: _kept(each)
            for key, each in value.items()
            if not key.endswith(("sha256", "_id")) and key != "outline"
        }
    return [_kept(each) for each in value] if isinstance(value, list) else value


if __name__ == "__main__":
    kept = {scene.relative_to(_ROOT).as_posix(): records_of(scene) for scene in SCENES}
    KEPT.write_text(json.dumps(kept, indent=1) + "\n", encoding="utf-8")
