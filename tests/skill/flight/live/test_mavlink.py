from __future__ import annotations

import socket
import sys
from typing import TYPE_CHECKING, Any

import pytest

from vehanchor.errors import InvalidParameterError, MissingExtraError
from vehanchor.flight.live.mavlink import NAMES, MavlinkSender
from vehanchor.records import LiveScale

if TYPE_CHECKING:
    from collections.abc import Iterator

FACTS: dict[str, Any] = {
    "frame": "a.jpg",
    "status": "ok",
    "n_vehicles": 9,
    "seen_s_ago": 0.0,
    "linked": True,
    "n_skipped": 0,
    "latency_s": 0.1,
    "image_width_px": 1280,
    "image_height_px": 720,
}


def scale_at(at_s: float, gsd: float | None = 0.08, confidence: float = 0.95) -> LiveScale:
    low, high = (None, None) if gsd is None else (0.9 * gsd, 1.1 * gsd)
    return LiveScale(
        **FACTS,
        at_s=at_s,
        gsd_m_per_px=gsd,
        gsd_ci95_low_m_per_px=low,
        gsd_ci95_high_m_per_px=high,
        confidence=confidence,
    )


@pytest.fixture
def station() -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(5)
        yield receiver


def received(station: socket.socket) -> list[Any]:
    """One datagram by a parser of pymavlink's own."""
    common = pytest.importorskip("pymavlink.dialects.v20.common")
    messages = common.MAVLink(None).parse_buffer(station.recv(2048))
    return list(messages or ())


def test_a_real_parser_reads_the_scale_its_interval_and_the_confidence(station: socket.socket) -> None:
    pytest.importorskip("pymavlink")
    with MavlinkSender(f"127.0.0.1:{station.getsockname()[1]}", system=42) as sender:
        assert sender.send(scale_at(1.25))
        messages = received(station)
        assert sender.send(scale_at(1.45, gsd=0.09, confidence=0.4))
        later = received(station)
    assert {each.get_type() for each in (*messages, *later)} == {"NAMED_VALUE_FLOAT"}
    assert tuple(each.name for each in messages) == NAMES
    assert [each.value for each in messages] == pytest.approx([0.08, 0.072, 0.088, 0.95])
    assert [each.value for each in later] == pytest.approx([0.09, 0.081, 0.099, 0.4])
    assert {each.time_boot_ms for each in messages} == {1250}
    assert {(each.get_srcSystem(), each.get_srcComponent()) for each in messages} == {(42, 191)}
    assert [each.get_seq() for each in (*messages, *later)] == list(range(8))


def test_without_a_scale_there_is_silence(station: socket.socket) -> None:
    pytest.importorskip("pymavlink")
    station.settimeout(0.2)
    with MavlinkSender(f"127.0.0.1:{station.getsockname()[1]}") as sender:
        assert not sender.send(scale_at(1.0, gsd=None, confidence=0.0))
        with pytest.raises(TimeoutError):
            station.recv(2048)


def test_every_name_fits_its_field() -> None:
    assert all(len(name) <= 10 for name in NAMES)


def test_a_network_that_takes_nothing_is_told_once_and_tried_again(
    station: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pymavlink")
    told: list[str] = []
    with MavlinkSender(f"127.0.0.1:{station.getsockname()[1]}", told.append) as sender:
        target = sender._target
        monkeypatch.setattr(sender, "_target", ("127.0.0.1", 0))  # the system refuses port 0
        assert [sender.send(scale_at(0.1 * k)) for k in range(3)] == [False] * 3
        monkeypatch.setattr(sender, "_target", target)
        assert sender.send(scale_at(1.0))
    assert len(told) == 1
    assert len(received(station)) == 4


@pytest.mark.parametrize("address", ["", "14550", "host", ":14550", "127.0.0.1:0", "127.0.0.1:99999", "127.0.0.1:x"])
def test_an_address_that_is_none_is_refused(address: str) -> None:
    pytest.importorskip("pymavlink")
    with pytest.raises(InvalidParameterError, match="HOST:PORT"):
        MavlinkSender(address)


def test_without_the_extra_its_name_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20", None)
    with pytest.raises(MissingExtraError, match=r"vehanchor\[mavlink\]"):
        MavlinkSender("127.0.0.1:14550")
