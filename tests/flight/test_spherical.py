"""Films that state that they show all directions."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from tests.flight.ground import write_film
from vehanchor_flight.spherical import stated_projection
from vehanchor_flight.video import sample_video

_VERSION_2 = struct.pack(">I4sI4s", 33, b"sv3d", 13, b"svhd") + bytes(17)
_VERSION_1 = b"<rdf:SphericalVideo><GSpherical:Spherical>true</GSpherical:Spherical>"
_FLAT = b"<rdf:SphericalVideo><GSpherical:Spherical>false</GSpherical:Spherical>"
_MATROSKA = b"\x1a\x45\xdf\xa3" + bytes(99) + b"\x76\x70\x84\x76\x71\x81\x01"


def _mp4(tracks: bytes) -> bytes:
    """Make the boxes of an MP4 without frames."""
    head = struct.pack(">I4s8s", 16, b"ftyp", b"isom\0\0\0\0")
    return head + struct.pack(">I4s", 8 + len(tracks), b"moov") + tracks


@pytest.mark.parametrize("film", [_mp4(_VERSION_2), _mp4(_VERSION_1), _MATROSKA])
def test_a_film_states_that_it_is_spherical(film: bytes, tmp_path: Path) -> None:
    path = tmp_path / "film"
    path.write_bytes(film)
    assert stated_projection(str(path))


@pytest.mark.parametrize(
    "film", [_mp4(_FLAT), _mp4(b"sv3d"), _MATROSKA.replace(b"\x81\x01", b"\x81\0"), b"", b"\1" * 40]
)
def test_other_films_state_nothing(film: bytes, tmp_path: Path) -> None:
    path = tmp_path / "film"
    path.write_bytes(film)
    assert stated_projection(str(path)) == ""


def test_the_frames_of_a_spherical_film_are_not_perspective_views(tmp_path: Path) -> None:
    frames = [np.full((48, 64, 3), 90, np.uint8), np.zeros((48, 64, 3), np.uint8)]
    frames[0][:, :20] = 200
    path = Path(write_film(tmp_path / "film.mp4", frames * 5, codec="mp4v"))
    # The index of the frames moves with the box that holds it; nothing before it changes.
    film = bytearray(path.read_bytes())
    start = film.rindex(b"moov") - 4
    (n_bytes,) = struct.unpack_from(">I", film, start)
    box = struct.pack(">I4s", 8 + len(_VERSION_1), b"uuid") + _VERSION_1
    struct.pack_into(">I", film, start, n_bytes + len(box))
    film[start + n_bytes : start + n_bytes] = box
    path.write_bytes(film)
    photograph = next(sample_video(str(path), 1.0))
    assert photograph.camera is not None
    assert photograph.camera.projection
