"""The notebook, the flight and the small scripts work, and say what is missing."""

from __future__ import annotations

import json
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ROOT
from tests.needs import needed_module
from vehanchor_flight.verbs import estimate_flight

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
    assert "second.png no_scale alone; ok" in printed, (
        "a photograph without cars gets its scale in the flight"
    )
    assert "scale from vehicles in first.png" in printed
    assert "reference length" in printed, "what calibrate printed"


def test_it_is_committed_without_outputs() -> None:
    cells = json.loads(TOUR.read_text(encoding="utf-8"))["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert code
    assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code)
    assert not any(cell["metadata"] for cell in cells)


FLIGHT = ROOT / "examples/flight"
GSDS = {
    "1.jpg": 0.12,
    "2.jpg": 0.122,
    "3.jpg": 0.119,
    "4.jpg": 0.121,
    "5.jpg": 0.12,
    "6.jpg": 0.118,
}


@pytest.mark.slow
def test_all_photographs_of_the_flight_have_a_usable_scale() -> None:
    record = estimate_flight([FLIGHT / name for name in GSDS])
    assert record.status == "ok"
    assert len(record.components) == 1
    for photograph, gsd in zip(record.photographs, GSDS.values(), strict=True):
        assert photograph.gsd_ci95_low_m_per_px is not None
        assert photograph.gsd_ci95_high_m_per_px is not None
        assert photograph.gsd_ci95_low_m_per_px < gsd < photograph.gsd_ci95_high_m_per_px
    last = record.photographs[-1]
    assert last.own is not None
    assert last.own.status == "no_scale"
    assert last.supported_by[0].photograph != last.photograph


def test_the_photographs_are_small() -> None:
    assert sum(path.stat().st_size for path in FLIGHT.iterdir()) < 1_500_000


EXAMPLE = ROOT / "examples/live_to_mavlink.py"
SCALE = {
    "at_s": 1.25,
    "gsd_m_per_px": 0.08,
    "gsd_ci95_low_m_per_px": 0.072,
    "gsd_ci95_high_m_per_px": 0.088,
    "confidence": 0.95,
}
NOTHING = {**dict.fromkeys(SCALE), "at_s": 1.0, "confidence": 0.0}
BY_PYMAVLINK = bytes.fromhex(  # the four messages of SCALE, packed by pymavlink 2.4.50 as MAVLink 1
    "fe12002abffbe20400000ad7a33d5645485f47534400000023f2"
    "fe12012abffbe2040000bc74933d5645485f4753445f4c4ff45d"
    "fe12022abffbe20400005839b43d5645485f4753445f484914b5"
    "fe12032abffbe20400003333733f5645485f434f4e46000094f5"
)


def _sent(*records: Mapping[str, float | None]) -> list[bytes]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        station.settimeout(0.2)
        lines = "".join(json.dumps(record) + "\n" for record in records)
        command = [
            sys.executable,
            str(EXAMPLE),
            f"127.0.0.1:{station.getsockname()[1]}",
            "--system",
            "42",
        ]
        subprocess.run(command, input=lines, text=True, check=True)
        received = []
        try:
            while True:
                received.append(station.recv(2048))
        except TimeoutError:
            return received


def test_each_line_with_a_scale_is_one_datagram_of_four_messages() -> None:
    first, second = _sent(SCALE, NOTHING, {**SCALE, "gsd_m_per_px": 0.09})
    assert first == BY_PYMAVLINK
    messages = [second[start : start + 26] for start in range(0, len(second), 26)]
    assert [message[2] for message in messages] == [4, 5, 6, 7]  # the numbers go on
    assert struct.unpack_from("<f10s", messages[0], 10) == (
        struct.unpack("<f", struct.pack("<f", 0.09))[0],
        b"VEH_GSD".ljust(10, b"\0"),
    )


_EXAMPLES = ROOT / "examples"
_SCRIPTS = [*_EXAMPLES.glob("*.py"), *(_EXAMPLES / "frameworks").glob("*.py")]
_SCRIPTS.remove(_EXAMPLES / "live_to_mavlink.py")  # it needs the standard library alone
_ALONE = """import runpy, sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in sys.stdlib_module_names:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Missing())
runpy.run_path(sys.argv[1], run_name="__main__")"""


@pytest.mark.parametrize("script", _SCRIPTS, ids=[path.name for path in _SCRIPTS])
def test_it_names_the_package_in_one_line(script: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _ALONE, str(script)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("this example needs the package '")
    assert ": pip install " in line
