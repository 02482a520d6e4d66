from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.flight.ground import ground, write_film
from vehanchor.errors import (
    ImageDecodeError,
    ImageNotFoundError,
    ImageTooLargeError,
    InvalidParameterError,
)
from vehanchor.options import ImageLimits
from vehanchor_flight.video import is_video, sample_video, sharpness


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four seconds of ten frames, all blurred but frames 4 and 28."""
    world = ground(500)
    frames = [world[number : number + 240, 2 * number : 2 * number + 320] for number in range(40)]
    blurred = [np.asarray(cv2.GaussianBlur(frame, (0, 0), 3), dtype=np.uint8) for frame in frames]
    blurred[4], blurred[28] = frames[4], frames[28]
    return Path(write_film(tmp_path_factory.mktemp("film") / "film.avi", blurred))


def test_of_each_stretch_the_sharpest_frame_is_taken(film: Path) -> None:
    taken = list(sample_video(str(film), 2.0))
    assert [each.name for each in taken] == [f"{film} at 0.40 s", f"{film} at 2.80 s"]
    image = taken[0].image
    assert isinstance(image, np.ndarray)
    assert image.shape == (240, 320, 3)
    assert sharpness(image) > 3 * sharpness(
        np.asarray(cv2.GaussianBlur(image, (0, 0), 3), dtype=np.uint8)
    )


def test_what_is_no_video_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"no video at all")
    with pytest.raises(ImageDecodeError, match="cannot be read"):
        list(sample_video(str(tmp_path / "a.mp4"), 1.0))
    with pytest.raises(ImageNotFoundError):
        list(sample_video(str(tmp_path / "b.mp4"), 1.0))
    with pytest.raises(InvalidParameterError, match="every"):
        list(sample_video(str(tmp_path / "a.mp4"), 0.0))
    assert is_video("flight.MP4")
    assert not is_video("flight.jpg")


@pytest.mark.parametrize("suffix", [".mp4", ".mov", ".mkv", ".avi"])
def test_every_offered_container_is_read(tmp_path: Path, suffix: str) -> None:
    codec = "MJPG" if suffix in (".avi", ".mkv") else "mp4v"
    path = write_film(
        tmp_path / f"film{suffix}", [np.full((48, 64, 3), 90, np.uint8)] * 10, codec=codec
    )
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
def test_the_signature_chooses_the_demuxer_and_not_ffmpeg(film: Path, tmp_path: Path) -> None:
    disguised = tmp_path / "a.mp4"
    disguised.write_bytes(
        b"ffco" + b"ftyp" + b"ncat version 1.0\nfile film.avi\n" + film.read_bytes()
    )
    with pytest.raises(ImageDecodeError, match="cannot be read"):
        list(sample_video(str(disguised), 1.0))


def test_frames_obey_the_limits_of_images(film: Path) -> None:
    with pytest.raises(ImageTooLargeError, match="320 x 240 px, the limit is 76799 pixels"):
        list(sample_video(str(film), 1.0, ImageLimits(max_pixels=320 * 240 - 1)))
    assert list(sample_video(str(film), 1.0, ImageLimits(max_pixels=320 * 240)))
