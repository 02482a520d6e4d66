from __future__ import annotations

import pytest

from tests.models import write_detector
from tests.sam_models import write_sam
from vehanchor.detection.detector import Detector
from vehanchor.segmentation.segmenter import Segmenter

SEARCHING = {"vehanchor.length_range_px": "9,64", "vehanchor.search_scales": "1"}


@pytest.fixture(scope="session")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    """A detector of painted vehicles."""
    return Detector(write_detector(tmp_path_factory.mktemp("detector") / "painted.onnx"))


@pytest.fixture(scope="session")
def searching(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    """A detector of painted vehicles whose file asks for the search over scales."""
    return Detector(
        write_detector(tmp_path_factory.mktemp("searching") / "m.onnx", metadata=SEARCHING)
    )


@pytest.fixture(scope="session")
def segmenter(tmp_path_factory: pytest.TempPathFactory) -> Segmenter:
    """A segmenter of painted objects."""
    return Segmenter(*write_sam(tmp_path_factory.mktemp("segmenter")))
