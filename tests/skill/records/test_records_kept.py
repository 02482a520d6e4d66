from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ROOT
from tests.records import CASES, KEPT, records_of

_ROUNDING = 1e-3  # processors round a network's sums differently


def _assert_like(found: Any, kept: Any, where: str) -> None:
    if isinstance(kept, dict):
        assert list(found) == list(kept), where
        for key in kept:
            _assert_like(found[key], kept[key], f"{where}.{key}")
    elif isinstance(kept, list):
        assert len(found) == len(kept), where
        for number, pair in enumerate(zip(found, kept, strict=True)):
            _assert_like(*pair, f"{where}[{number}]")
    elif isinstance(kept, float):
        assert found == pytest.approx(kept, rel=_ROUNDING, abs=_ROUNDING), where
    elif where.endswith("mask_area_px"):
        assert found == pytest.approx(kept, rel=_ROUNDING, abs=3), where
    elif not where.endswith("message"):  # its numbers are rounded, which a processor may tip over
        assert found == kept, where


@pytest.mark.parametrize("scene", CASES)
def test_records_stay_as_they_were_kept(scene: Path) -> None:
    name = scene.relative_to(ROOT).as_posix()
    _assert_like(records_of(scene), json.loads(KEPT.read_text(encoding="utf-8"))[name], name)
