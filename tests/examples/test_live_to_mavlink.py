"""The example sends the JSON lines of a running camera over MAVLink."""

from __future__ import annotations

import json
import socket
import struct
import subprocess
import sys
from collections.abc import Mapping

from tests.conftest import ROOT

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
        command = [sys.executable, str(EXAMPLE), f"127.0.0.1:{station.getsockname()[1]}", "--system", "42"]
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
