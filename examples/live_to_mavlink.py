"""Send the scale of a running camera over MAVLink, from the JSON lines of ``vehanchor flight live``.

    vehanchor flight live 0 | python examples/live_to_mavlink.py 127.0.0.1:14550

Each line with a scale becomes one UDP datagram with four messages NAMED_VALUE_FLOAT: VEH_GSD
(metres per pixel), VEH_GSD_LO and VEH_GSD_HI (its 95 % interval), and VEH_CONF (confidence; below
0.9 it is not to be used). Autopilots log and forward them, and fuse none of them. Without a scale
nothing is sent. The messages are not signed.
"""

from __future__ import annotations

import argparse
import json
import socket
import struct
import sys

FIELDS = {
    b"VEH_GSD": "gsd_m_per_px",
    b"VEH_GSD_LO": "gsd_ci95_low_m_per_px",
    b"VEH_GSD_HI": "gsd_ci95_high_m_per_px",
    b"VEH_CONF": "confidence",
}
# number and checksum seed of the message, common.xml
NAMED_VALUE_FLOAT = 251
SEED = 170
ONBOARD_COMPUTER = 191  # MAV_COMP_ID_ONBOARD_COMPUTER


def checksum(data: bytes) -> int:
    """Compute CRC-16/MCRF4XX."""
    crc = 0xFFFF
    for byte in data:
        low = byte ^ (crc & 0xFF)
        low = (low ^ (low << 4)) & 0xFF
        crc = (crc >> 8) ^ (low << 8) ^ (low << 3) ^ (low >> 4)
    return crc


def packed(number: int, system: int, time_ms: int, name: bytes, value: float) -> bytes:
    """Pack one message in the frame of MAVLink 1, which every receiver reads."""
    payload = struct.pack("<If10s", time_ms % 2**32, value, name)
    body = (
        bytes([len(payload), number % 256, system, ONBOARD_COMPUTER, NAMED_VALUE_FLOAT]) + payload
    )
    return b"\xfe" + body + struct.pack("<H", checksum(body + bytes([SEED])))


def main() -> None:
    """Send each line of the standard input."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("address", help="HOST:PORT of a ground station or a MAVLink router")
    parser.add_argument(
        "--system", type=int, choices=range(1, 256), metavar="ID", default=1, help="of the vehicle"
    )
    chosen = parser.parse_args()
    host, _, port = chosen.address.rpartition(":")
    family, kind, _, _, target = socket.getaddrinfo(
        host.strip("[]"), int(port), type=socket.SOCK_DGRAM
    )[0]
    number = 0
    with socket.socket(family, kind) as sender:
        for line in sys.stdin:
            record = json.loads(line)
            if record["gsd_m_per_px"] is None:
                continue
            time_ms = round(1000 * record["at_s"])
            datagram = b""
            for name, field in FIELDS.items():
                datagram += packed(number, chosen.system, time_ms, name, record[field])
                number += 1
            sender.sendto(datagram, target)


if __name__ == "__main__":
    main()
