"""Send the scale of a running camera over MAVLink, from the lines of ``vehanchor flight live``.

    vehanchor flight live 0 | python examples/live_to_mavlink.py 127.0.0.1:14550

Each line with a scale becomes one UDP datagram with four messages NAMED_VALUE_FLOAT: VEH_GSD
(metres per pixel), VEH_GSD_LO and VEH_GSD_HI (its 95 % interval), and VEH_CONF (confidence; do not
use the scale below 0.9). Autopilots log and forward the messages, but do not fuse them. A line
without a scale sends nothing. The messages are not signed.
"""

from __future__ import annotations

import argparse
import json
import socket
import struct
import sys

# Name of a message, and the field of the record that it carries.
FIELDS = {
    b"VEH_GSD": "gsd_m_per_px",
    b"VEH_GSD_LO": "gsd_ci95_low_m_per_px",
    b"VEH_GSD_HI": "gsd_ci95_high_m_per_px",
    b"VEH_CONF": "confidence",
}
# Number and checksum seed of NAMED_VALUE_FLOAT, from MAVLink's common.xml.
NAMED_VALUE_FLOAT = 251
CHECKSUM_SEED = 170
# MAV_COMP_ID_ONBOARD_COMPUTER.
ONBOARD_COMPUTER = 191
START_OF_FRAME = b"\xfe"


def checksum(data: bytes) -> int:
    """Compute CRC-16/MCRF4XX."""
    crc = 0xFFFF
    for byte in data:
        low = byte ^ (crc & 0xFF)
        low = (low ^ (low << 4)) & 0xFF
        crc = (crc >> 8) ^ (low << 8) ^ (low << 3) ^ (low >> 4)
    return crc


def pack_message(number: int, *, system: int, time_ms: int, name: bytes, value: float) -> bytes:
    """Pack one message in the frame of MAVLink 1, which every receiver reads."""
    payload = struct.pack("<If10s", time_ms % 2**32, value, name)
    header = bytes([len(payload), number % 256, system, ONBOARD_COMPUTER, NAMED_VALUE_FLOAT])
    body = header + payload
    crc = checksum(body + bytes([CHECKSUM_SEED]))
    return START_OF_FRAME + body + struct.pack("<H", crc)


def main() -> None:
    """Send each line of the standard input."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("address", help="HOST:PORT of a ground station or a MAVLink router")
    parser.add_argument(
        "--system",
        type=int,
        choices=range(1, 256),
        metavar="ID",
        default=1,
        help="MAVLink system id of the vehicle",
    )
    options = parser.parse_args()
    host, _, port = options.address.rpartition(":")
    # Brackets surround an IPv6 address.
    addresses = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)
    family, kind, _, _, target = addresses[0]
    number = 0
    with socket.socket(family, kind) as sender:
        for line in sys.stdin:
            record = json.loads(line)
            if record["gsd_m_per_px"] is None:
                continue
            time_ms = round(1000 * record["at_s"])
            datagram = b""
            for name, field in FIELDS.items():
                datagram += pack_message(
                    number,
                    system=options.system,
                    time_ms=time_ms,
                    name=name,
                    value=record[field],
                )
                number += 1
            sender.sendto(datagram, target)


if __name__ == "__main__":
    main()
