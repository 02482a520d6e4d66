from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.flight.ground import ground, write_film
from vehanchor.errors import (
    ImageDecodeError,
    ImageNotFoundError,
    ImageTooLargeError,
    InvalidParameterError,
)
from vehanchor.options import ImageLimits
from vehanchor_flight.interlaced import _allows_interlaced, _have_content
from vehanchor_flight.video import is_video, sample_video, sharpness


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write four seconds of ten frames, of which only frames 4 and 28 are sharp."""
    world = ground(500)
    frames = []
    for number in range(40):
        sharp = world[number : number + 240, 2 * number : 2 * number + 320]
        frames.append(sharp if number in (4, 28) else _blurred(sharp))
    return Path(write_film(tmp_path_factory.mktemp("film") / "film.avi", frames))


def _blurred(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 3), dtype=np.uint8)


def test_the_sharpest_frame_of_each_interval_is_taken(film: Path) -> None:
    photographs = list(sample_video(str(film), 2.0))
    names = [photograph.name for photograph in photographs]
    assert names == [f"{film} at 0.40 s", f"{film} at 2.80 s"]
    image = photographs[0].image
    assert isinstance(image, np.ndarray)
    assert image.shape == (240, 320, 3)
    assert sharpness(image) > 3 * sharpness(_blurred(image))


def test_a_file_that_is_not_a_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no video at all")
    with pytest.raises(ImageDecodeError, match="cannot be read"):
        list(sample_video(str(tmp_path / "a.mp4"), 1.0))


def test_a_missing_video_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ImageNotFoundError):
        list(sample_video(str(tmp_path / "b.mp4"), 1.0))


def test_an_interval_of_no_seconds_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no video at all")
    with pytest.raises(InvalidParameterError, match="every"):
        list(sample_video(str(tmp_path / "a.mp4"), 0.0))


def test_the_suffix_names_a_video() -> None:
    assert is_video("flight.MP4")
    assert is_video("flight.m2ts")
    assert not is_video("flight.jpg")


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv", ".avi"])
def test_every_offered_container_is_read(tmp_path: Path, suffix: str) -> None:
    codec = "MJPG" if suffix in (".avi", ".mkv") else "mp4v"
    frames = [np.full((48, 64, 3), 90, np.uint8)] * 10
    path = write_film(tmp_path / f"film{suffix}", frames, codec=codec)
    (only,) = sample_video(path, 2.0)
    assert isinstance(only.image, np.ndarray)
    assert only.image.shape == (48, 64, 3)


@pytest.mark.promise("video")
@pytest.mark.parametrize("before", [None, "threads;1"])
def test_a_playlist_opens_no_other_file(
    film: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str | None
) -> None:
    monkeypatch.delenv("OPENCV_FFMPEG_CAPTURE_OPTIONS", raising=False)
    if before:
        monkeypatch.setenv("OPENCV_FFMPEG_CAPTURE_OPTIONS", before)
    (tmp_path / "film.avi").write_bytes(film.read_bytes())
    playlist = tmp_path / "list.mp4"
    playlist.write_text("ffconcat version 1.0\nfile film.avi\n")
    capture = cv2.VideoCapture(str(playlist), cv2.CAP_FFMPEG)
    assert capture.grab(), "FFmpeg follows the playlist if it may"
    capture.release()
    with pytest.raises(ImageDecodeError, match="cannot be read"):
        list(sample_video(str(playlist), 1.0))
    assert os.environ.get("OPENCV_FFMPEG_CAPTURE_OPTIONS") == before


@pytest.mark.promise("video")
def test_the_signature_chooses_the_demuxer(film: Path, tmp_path: Path) -> None:
    disguised = tmp_path / "a.mp4"
    playlist = b"ffco" + b"ftyp" + b"ncat version 1.0\nfile film.avi\n"
    disguised.write_bytes(playlist + film.read_bytes())
    with pytest.raises(ImageDecodeError, match="cannot be read"):
        list(sample_video(str(disguised), 1.0))


def test_frames_obey_the_limits_of_images(film: Path) -> None:
    frame_pixels = 320 * 240
    with pytest.raises(ImageTooLargeError, match="320 x 240 px, the limit is 76799 pixels"):
        list(sample_video(str(film), 1.0, ImageLimits(max_pixels=frame_pixels - 1)))
    assert list(sample_video(str(film), 1.0, ImageLimits(max_pixels=frame_pixels)))


# The codec's parameters of one film each, as FFmpeg's x264 wrote them.
INTERLACED = bytes.fromhex("01640016ffe1001867640016acd940a07b42000003000200000300083e2853")
PROGRESSIVE = bytes.fromhex("01640016ffe1001867640016acd940a03da1000003000100000300040f162d")


def test_the_parameters_of_a_film_say_whether_it_may_be_interlaced() -> None:
    assert _allows_interlaced(INTERLACED)
    assert _allows_interlaced(b"\0\0\0\1" + INTERLACED[8:])
    assert not _allows_interlaced(PROGRESSIVE)


@pytest.mark.parametrize("damaged", [b"", b"\1", INTERLACED[:12], b"\0\0\1\x67" + bytes(40)])
def test_damaged_parameters_of_a_film_prove_nothing(damaged: bytes) -> None:
    assert not _allows_interlaced(damaged)


@pytest.mark.parametrize(
    ("packets", "have_content"),
    [
        ([bytes(9000), b"1" * 2000, b"2" * 90], True),
        # Nothing moves: only the first frame holds much, or each is coded by itself.
        ([bytes(9000), b"1" * 90, b"2" * 90], False),
        ([bytes(9000), bytes(9000), bytes(9000)], False),
        ([bytes(9000)], False),
    ],
)
def test_coded_frames_show_whether_the_picture_changes(
    packets: list[bytes], have_content: bool
) -> None:
    assert _have_content(packets) == have_content


def test_a_film_of_frames_of_one_colour_is_refused(tmp_path: Path) -> None:
    black = np.zeros((240, 320, 3), np.uint8)
    film = write_film(tmp_path / "black.avi", [black] * 6)
    with pytest.raises(ImageDecodeError, match="of one colour"):
        list(sample_video(str(film), 0.2))
