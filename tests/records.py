"""Stored records of the bundled models on the scenes of ``examples/``, to see changes of results.

``python -m tests.records`` renews them, after new weights or after a change that is meant to change
them. Numbers that differ as little as between two processors stay, so the differences in the file
are those of the change.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from vehanchor import estimate_gsd, measure_area

_ROOT = Path(__file__).parent.parent
KEPT = Path(__file__).with_suffix(".json")
SCENES = sorted((_ROOT / "examples").glob("**/*.jpg"))
QUICK_SCENE = "safe.jpg"
_NUMBER = re.compile(r"[\d.,]+")
_ROUNDING = 1e-3
"""Relative and absolute difference of a number between two processors."""

CASES = [
    pytest.param(scene, id=scene.name)
    if scene.name == QUICK_SCENE
    else pytest.param(scene, id=scene.name, marks=pytest.mark.slow)
    for scene in SCENES
]
"""The scenes as parameters of a test; all but one are slow."""


def records_of(scene: Path) -> dict[str, Any]:
    """Compute the records of a scene: its scale, its scale by the paper's rules, and an area."""
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
    return {name: _stable(record.model_dump(mode="json")) for name, record in records.items()}


def _stable(value: Any) -> Any:
    """Leave out checksums, and the outline, whose corners may change with one pixel."""
    if isinstance(value, dict):
        return {
            key: _stable(item)
            for key, item in value.items()
            if not key.endswith(("sha256", "_id")) and key != "outline"
        }
    if isinstance(value, list):
        return [_stable(item) for item in value]
    return value


def renewed(value: Any, stored: Any, key: str = "") -> Any:
    """Renew a part of a record; what differs by the processor only stays as it is stored.

    Args:
        value: the part as it is now.
        stored: the stored part; None for a new one.
        key: its name in the record.
    """
    if isinstance(value, dict) and isinstance(stored, dict):
        return {name: renewed(item, stored.get(name), name) for name, item in value.items()}
    if isinstance(value, list) and isinstance(stored, list) and len(value) == len(stored):
        return [renewed(item, old, key) for item, old in zip(value, stored, strict=True)]
    if _differs_by_rounding(value, stored, key):
        return stored
    return value


def _differs_by_rounding(value: Any, stored: Any, key: str) -> bool:
    """Test whether two values differ only because processors round the sums of a network."""
    if isinstance(value, float) and isinstance(stored, float):
        return bool(value == pytest.approx(stored, rel=_ROUNDING, abs=_ROUNDING))
    if key == "mask_area_px" and None not in (value, stored):
        return bool(value == pytest.approx(stored, rel=_ROUNDING, abs=3))
    if key == "message" and isinstance(stored, str):
        # A message has rounded numbers, whose last digit may depend on the processor.
        return _NUMBER.sub("", value) == _NUMBER.sub("", stored)
    return False


if __name__ == "__main__":
    before = json.loads(KEPT.read_text(encoding="utf-8"))
    stored = {}
    for scene in SCENES:
        path = scene.relative_to(_ROOT).as_posix()
        stored[path] = renewed(records_of(scene), before.get(path))
    KEPT.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")
