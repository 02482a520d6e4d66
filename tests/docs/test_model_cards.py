"""The card of the bundled segmenter has its checksum; the other files are in ``SHA256SUMS``."""

from __future__ import annotations

import hashlib

from tests.conftest import ROOT

BUNDLED = ROOT / "skill/vehanchor/models/bundled"


def test_the_card_has_the_checksum_of_both_files_of_the_segmenter() -> None:
    """Records name the segmenter by this checksum."""
    names = ("segmenter-encoder.onnx", "segmenter-decoder.onnx")
    content = b"".join((BUNDLED / name).read_bytes() for name in names)
    card = (BUNDLED / "segmenter.md").read_text(encoding="utf-8")
    assert f"`{hashlib.sha256(content).hexdigest()}`" in card
