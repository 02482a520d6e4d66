"""PyTorch with one thread: several wait for each other, which takes six times as long here."""

import os
from pathlib import Path

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read when PyTorch is loaded, after this


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Skip files that need PyTorch where slow tests are left out: all of them are slow."""
    left_out = "not slow" in config.option.markexpr and collection_path.suffix == ".py"
    return (
        True
        if left_out and 'importorskip("torch")' in collection_path.read_text(encoding="utf-8")
        else None
    )
