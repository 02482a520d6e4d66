from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.skill.flight.ground import ground
from vehanchor.errors import ImageDecodeError, ImageNotFoundError, InvalidParameterError
from vehanchor.flight.video import _taken, is_video, sample_video, sharpness


@pytest.fixture(scope="module")
def film(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four seconds of ten frames, all blurred but frames 4 and 28."""
    path = tmp_path_factory.mktemp("film") / "film.avi"
    world = ground(500)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (320, 240))
    for number in range(40):
        frame = world[number : number + 240, 2 * number : 2 * number + 320]
        writer.write(frame if number in (4, 28) else cv2.GaussianBlur(frame, (0, 0), 3))
    writer.release()
    return path


def test_of_each_stretch_the_sharpest_frame_is_taken(film: Path) -> None:
    taken = list(sample_video(str(film), 2.0))
    assert [each.name for each in taken] == [f"{film} at 0.40 s", f"{film} at 2.80 s"]
    image = taken[0].image
    assert isinstance(image, np.ndarray)
    assert image.shape == (240, 320, 3)
    assert sharpness(image) > 3 * sharpness(np.asarray(cv2.GaussianBlur(image, (0, 0), 3), dtype=np.uint8))


@pytest.mark.parametrize("rate", [0.5, 10.0, 29.97, 120.0, 1000.0])
def test_no_two_frames_have_one_name(rate: float) -> None:
    frame = np.zeros((2, 2, 3), np.uint8)
    names = [_taken("a.mp4", (1.0, number, frame), rate).name for number in range(200)]
    assert len(set(names)) == len(names)


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
