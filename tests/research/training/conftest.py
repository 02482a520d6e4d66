"""One thread for PyTorch: more wait for each other by spinning, which beside other tests takes six times as long."""

import os
from pathlib import Path

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read when PyTorch is loaded, after this


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out what needs PyTorch where slow tests are left out: all of it is slow, and importing it takes seconds."""
    left_out = "not slow" in config.option.markexpr and collection_path.suffix == ".py"
    return (
        True
        if left_out and 'importorskip("torch")' in collection_path.read_text(encoding="utf-8")
        else None
    )
