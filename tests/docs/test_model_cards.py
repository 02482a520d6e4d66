"""The model cards beside the bundled models have their checksums."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from tests.conftest import ROOT

BUNDLED = ROOT / "skill/vehanchor/models/bundled"
CARDS = "\n".join(card.read_text(encoding="utf-8") for card in sorted(BUNDLED.glob("*.md")))
SEGMENTER = ("segmenter-encoder.onnx", "segmenter-decoder.onnx")
SINGLE = [path for path in sorted(BUNDLED.glob("*.onnx")) if path.name not in SEGMENTER]


@pytest.mark.parametrize("model", SINGLE, ids=lambda path: path.stem)
def test_a_card_has_the_checksum_of_a_bundled_model(model: Path) -> None:
    assert f"`{hashlib.sha256(model.read_bytes()).hexdigest()}`" in CARDS


def test_a_card_has_the_checksum_of_both_files_of_the_segmenter() -> None:
    content = b"".join((BUNDLED / name).read_bytes() for name in SEGMENTER)
    assert f"`{hashlib.sha256(content).hexdigest()}`" in CARDS
