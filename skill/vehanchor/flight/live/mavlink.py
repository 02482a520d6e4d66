"""Live scale as MAVLink messages ``NAMED_VALUE_FLOAT`` over UDP, for displays, logs and companions.

No autopilot fuses these messages into its state: they are advice. Without a scale nothing is sent.
"""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING, Any

from vehanchor.errors import InvalidParameterError, MissingExtraError

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType
    from typing import Self

    from vehanchor.records import LiveScale

NAMES = ("VEH_GSD", "VEH_GSD_LO", "VEH_GSD_HI", "VEH_CONF")
"""Names of the messages, ten characters at most: metres per pixel, the ends of its 95 % interval, confidence."""

_COMPONENT = 191  # MAV_COMP_ID_ONBOARD_COMPUTER
_PORTS = range(1, 65536)


class MavlinkSender:
    """Sends each scale as four messages in one datagram; a context manager.

    Sending never waits: a datagram that the network does not take is lost, and the next frame has a newer scale.

    Args:
        address: ``HOST:PORT`` of a ground station or a MAVLink router, over UDP.
        tell: receives one sentence when sending begins to fail.
        system: MAVLink system of the vehicle, 1 to 255.

    Raises:
        MissingExtraError: pymavlink is not installed.
        InvalidParameterError: the address or the system is invalid.
    """

    def __init__(self, address: str, tell: Callable[[str], None] = print, *, system: int = 1) -> None:
        dialect = _dialect()
        if not 1 <= system <= 255:
            raise InvalidParameterError(f"the MAVLink system is {system}: use 1 to 255")
        self._address, self._tell, self._failing = address, tell, False
        family, self._target = _resolved(address)
        self._packer = dialect.MAVLink(None, srcSystem=system, srcComponent=_COMPONENT)
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def send(self, record: LiveScale) -> bool:
        """Send a record's scale; tell whether it was sent. Without a scale there is nothing to send."""
        values = (
            record.gsd_m_per_px,
            record.gsd_ci95_low_m_per_px,
            record.gsd_ci95_high_m_per_px,
            record.confidence,
        )
        datagram = b""
        for name, value in zip(NAMES, values, strict=True):
            if value is None:
                return False
            message = self._packer.named_value_float_encode(
                round(1000 * record.at_s) % 2**32, name.encode("ascii"), value
            )
            datagram += message.pack(self._packer)
            self._packer.seq = (self._packer.seq + 1) % 256
        try:
            self._socket.sendto(datagram, self._target)
        except OSError as error:  # also of an earlier datagram that nobody received
            if not self._failing:
                self._tell(f"MAVLink to {self._address} is not delivered ({error.strerror}): the next frames try again")
            self._failing = True
            return False
        self._failing = False
        return True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._socket.close()


def _dialect() -> Any:
    try:
        from pymavlink.dialects.v20 import common
    except ImportError as error:
        raise MissingExtraError("--mavlink needs pymavlink: pip install 'vehanchor[mavlink]'") from error
    return common


def _resolved(address: str) -> tuple[socket.AddressFamily, Any]:
    """Resolve ``HOST:PORT`` to the family and the address of a socket."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) not in _PORTS:
        raise InvalidParameterError(f"the MAVLink address is {address!r}: use HOST:PORT, such as 127.0.0.1:14550")
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:
        raise InvalidParameterError(f"the MAVLink host {host!r} is not found: {error}") from error
    family, _, _, _, target = found[0]
    return family, target
