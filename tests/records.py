"""Stored records of the bundled models on the scenes of ``examples/``, to see changes of results.

``python -m tests.records`` writes them anew, after new weights or after a change that is meant to
change them. A number that differs only by rounding stays as it is stored.
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
ROUNDING = 1e-3
QUICK_SCENE = "safe.jpg"
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


def is_alike(value: Any, stored: Any, where: str = "") -> bool:
    """Test whether a value of a record is the stored one but for rounding.

    Processors round the sums of a network differently.

    Args:
        value: a value without parts.
        stored: the stored value.
        where: path of the value in the record.
    """
    if isinstance(stored, float):
        return bool(value == pytest.approx(stored, rel=ROUNDING, abs=ROUNDING))
    if where.endswith("mask_area_px"):
        return bool(value == pytest.approx(stored, rel=ROUNDING, abs=3))
    # A message has rounded numbers, whose last digit may depend on the processor.
    return bool(where.endswith("message") or value == stored)


def keep_alike(value: Any, stored: Any, where: str = "") -> Any:
    """Replace each value by the stored one if the two are alike.

    Args:
        value: a record or a part of one.
        stored: the same part of the stored record; None for a new part.
        where: path of the part in the record.
    """
    if isinstance(value, dict):
        old = stored if isinstance(stored, dict) else {}
        return {
            key: keep_alike(item, old.get(key), f"{where}.{key}") for key, item in value.items()
        }
    if isinstance(value, list):
        if not isinstance(stored, list) or len(stored) != len(value):
            return value
        return [keep_alike(item, old, where) for item, old in zip(value, stored, strict=True)]
    if (
        type(value) is type(stored)
        and not where.endswith("message")
        and is_alike(value, stored, where)
    ):
        return stored
    return value


def _main() -> None:
    stored = json.loads(KEPT.read_text(encoding="utf-8"))
    computed = {scene.relative_to(_ROOT).as_posix(): records_of(scene) for scene in SCENES}
    KEPT.write_text(json.dumps(keep_alike(computed, stored), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    _main()
