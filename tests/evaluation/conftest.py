from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.known_scale_data import write_dota_split
from tests.models import write_detector
from vehanchor_evaluation import search


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_detector(tmp_path_factory.mktemp("model") / "detector.onnx")


@pytest.fixture
def dota(tmp_path: Path) -> Path:
    """See ``write_dota_split``."""
    return write_dota_split(tmp_path / "val")


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the images that were really searched."""
    names: list[str] = []
    whole = search._search

    def counting(file: Path, **arguments: Any) -> Any:
        names.append(file.name)
        return whole(file, **arguments)

    monkeypatch.setattr(search, "_search", counting)
    return names
