"""The notebook, the flight and the small scripts work, and name a missing package."""

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
from vehanchor_flight.records import FlightEstimate
from vehanchor_flight.verbs import estimate_flight

TOUR = ROOT / "examples/tour.ipynb"
MAX_CELL_S = 120


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> list[Any]:
    """Run the notebook in its folder; return the outputs of its cells.

    The notebook itself asserts its numbers.
    """
    nbclient = needed_module("nbclient", "pip install nbclient")
    nbformat = needed_module("nbformat", "pip install nbformat")
    kernelspec = needed_module("jupyter_client.kernelspec", "pip install ipykernel")
    with pytest.MonkeyPatch.context() as patch:
        # An empty search path: this Python's own kernel is used, whatever kernels are installed.
        patch.setenv("JUPYTER_PATH", os.fspath(tmp_path_factory.mktemp("kernels")))
        patch.setenv("IPYTHONDIR", os.fspath(tmp_path_factory.mktemp("ipython")))
        book = nbformat.read(TOUR, as_version=4)
        kernels = kernelspec.KernelSpecManager()
        assert kernels.ensure_native_kernel
        resources = {"metadata": {"path": os.fspath(TOUR.parent)}}
        nbclient.NotebookClient(book, timeout=MAX_CELL_S, resources=resources).execute()
    return [output for cell in book.cells for output in cell.get("outputs", [])]


@pytest.fixture(scope="module")
def printed(outputs: list[Any]) -> str:
    return "".join(output["text"] for output in outputs if output["output_type"] == "stream")


def _count_outputs(outputs: list[Any], kind: str) -> int:
    return sum(kind in output.get("data", {}) for output in outputs)


@pytest.mark.slow
def test_the_notebook_shows_three_pictures(outputs: list[Any]) -> None:
    assert _count_outputs(outputs, "image/png") == 3, "the photograph, the line and the roof"


@pytest.mark.slow
def test_the_notebook_shows_the_record_as_a_table(outputs: list[Any]) -> None:
    assert _count_outputs(outputs, "text/html") > 0


@pytest.mark.slow
def test_the_flight_of_the_notebook_scales_a_photograph_without_cars(printed: str) -> None:
    assert "second.png no_scale alone; ok" in printed
    assert "scale from vehicles in first.png" in printed


@pytest.mark.slow
def test_the_notebook_prints_the_calibration(printed: str) -> None:
    assert "reference length" in printed


def test_the_notebook_is_committed_without_outputs() -> None:
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


@pytest.fixture(scope="module")
def flight() -> FlightEstimate:
    return estimate_flight([FLIGHT / name for name in GSDS])


@pytest.mark.slow
def test_the_flight_has_one_usable_scale(flight: FlightEstimate) -> None:
    assert flight.status == "ok"
    assert len(flight.components) == 1


@pytest.mark.slow
def test_the_interval_of_every_photograph_contains_its_true_scale(flight: FlightEstimate) -> None:
    for photograph, gsd in zip(flight.photographs, GSDS.values(), strict=True):
        assert photograph.gsd_ci95_low_m_per_px is not None
        assert photograph.gsd_ci95_high_m_per_px is not None
        assert photograph.gsd_ci95_low_m_per_px < gsd < photograph.gsd_ci95_high_m_per_px


@pytest.mark.slow
def test_a_photograph_without_a_scale_gets_it_from_another(flight: FlightEstimate) -> None:
    last = flight.photographs[-1]
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
# The four messages of SCALE, packed by pymavlink 2.4.50 as MAVLink 1.
BY_PYMAVLINK = bytes.fromhex(
    "fe12002abffbe20400000ad7a33d5645485f47534400000023f2"
    "fe12012abffbe2040000bc74933d5645485f4753445f4c4ff45d"
    "fe12022abffbe20400005839b43d5645485f4753445f484914b5"
    "fe12032abffbe20400003333733f5645485f434f4e46000094f5"
)


def _sent(*records: Mapping[str, float | None]) -> list[bytes]:
    """Return the datagrams that the example sends for records."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station:
        station.bind(("127.0.0.1", 0))
        station.settimeout(0.2)
        address = f"127.0.0.1:{station.getsockname()[1]}"
        command = [sys.executable, str(EXAMPLE), address, "--system", "42"]
        lines = "".join(json.dumps(record) + "\n" for record in records)
        subprocess.run(command, input=lines, text=True, check=True)
        received = []
        try:
            while True:
                received.append(station.recv(2048))
        except TimeoutError:
            return received


@pytest.fixture(scope="module")
def datagrams() -> list[bytes]:
    """Datagrams for a scale, nothing, and another scale."""
    return _sent(SCALE, NOTHING, {**SCALE, "gsd_m_per_px": 0.09})


def test_each_line_with_a_scale_is_one_datagram(datagrams: list[bytes]) -> None:
    assert len(datagrams) == 2


def test_a_datagram_has_the_bytes_of_pymavlink(datagrams: list[bytes]) -> None:
    assert datagrams[0] == BY_PYMAVLINK


def _messages(datagram: bytes) -> list[bytes]:
    return [datagram[start : start + 26] for start in range(0, len(datagram), 26)]


def test_the_numbers_of_messages_continue(datagrams: list[bytes]) -> None:
    assert [message[2] for message in _messages(datagrams[1])] == [4, 5, 6, 7]


def test_a_message_has_a_name_with_its_value(datagrams: list[bytes]) -> None:
    value, name = struct.unpack_from("<f10s", _messages(datagrams[1])[0], 10)
    # As a float of four bytes.
    assert value == struct.unpack("<f", struct.pack("<f", 0.09))[0]
    assert name == b"VEH_GSD".ljust(10, b"\0")


_EXAMPLES = ROOT / "examples"
_SCRIPTS = [*_EXAMPLES.glob("*.py"), *(_EXAMPLES / "frameworks").glob("*.py")]
# It needs only the standard library.
_SCRIPTS.remove(_EXAMPLES / "live_to_mavlink.py")
# Runs a script as if no package were installed.
_ALONE = """import runpy, sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in sys.stdlib_module_names:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
sys.meta_path.insert(0, Missing())
runpy.run_path(sys.argv[1], run_name="__main__")"""


@pytest.mark.parametrize("script", _SCRIPTS, ids=[path.name for path in _SCRIPTS])
def test_a_script_names_a_missing_package_in_one_line(script: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _ALONE, str(script)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("this example needs the package '")
    assert ": pip install " in line
