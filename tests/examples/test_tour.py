"""The notebook runs from top to bottom, shows what it promises, and is committed without what a run leaves in it."""

from __future__ import annotations

import json
import os
from typing import Any

import pytest

from tests.conftest import ROOT
from tests.needs import needed_module

TOUR = ROOT / "examples/tour.ipynb"
LONGEST_CELL_S = 120


@pytest.fixture
def executed(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The notebook after a run in its folder; its own assertions hold its numbers against the truth."""
    nbclient = needed_module("nbclient", "pip install nbclient")
    nbformat = needed_module("nbformat", "pip install nbformat")
    kernelspec = needed_module("jupyter_client.kernelspec", "pip install ipykernel")
    # An empty search path: whatever kernel the machine has, this Python's own is taken.
    monkeypatch.setenv("JUPYTER_PATH", os.fspath(tmp_path_factory.mktemp("kernels")))
    monkeypatch.setenv("IPYTHONDIR", os.fspath(tmp_path_factory.mktemp("ipython")))
    book = nbformat.read(TOUR, as_version=4)
    kernels = kernelspec.KernelSpecManager()
    assert kernels.ensure_native_kernel
    resources = {"metadata": {"path": os.fspath(TOUR.parent)}}
    nbclient.NotebookClient(book, timeout=LONGEST_CELL_S, resources=resources).execute()
    return book


@pytest.mark.slow
def test_it_runs_and_its_numbers_hold(executed: Any) -> None:
    shown = [output for cell in executed.cells for output in cell.get("outputs", [])]
    printed = "".join(output["text"] for output in shown if output["output_type"] == "stream")
    pictures = [output for output in shown if "image/png" in output.get("data", {})]
    assert len(pictures) == 3, "the photograph, the line and the roof show themselves"
    assert any("text/html" in output.get("data", {}) for output in shown), "the record is a table"
    assert "second.png no_scale alone; ok" in printed, "a photograph without cars gets its scale in the flight"
    assert "scale from vehicles in first.png" in printed
    assert "reference length" in printed, "what calibrate printed"


def test_it_is_committed_without_outputs() -> None:
    cells = json.loads(TOUR.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert code
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
    assert not any(cell["metadata"] for cell in cells)
