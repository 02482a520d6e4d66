from __future__ import annotations

import os
import shutil
import threading
import time
from itertools import islice
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from vehanchor.options import Reading
from vehanchor_flight.live.frames import camera_frames, folder_frames, open_frames

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray


def write(path: Path, level: int) -> None:
    cv2.imwrite(str(path), np.full((48, 64, 3), level, np.uint8))


def test_of_a_full_folder_the_newest_image_is_taken_and_then_each_new_one(tmp_path: Path) -> None:
    for number in range(4):
        write(tmp_path / f"{number}.png", 10 * number)
        os.utime(tmp_path / f"{number}.png", (1000 + number, 1000 + number))
    (tmp_path / "notes.txt").write_text("no image")
    frames = folder_frames(tmp_path, Reading(), idle_s=5)
    first = next(frames)
    assert (first.name, first.n_skipped) == (str(tmp_path / "3.png"), 3)
    write(tmp_path / "0.png", 200)  # replaced
    second = next(frames)
    assert (second.name, second.n_skipped) == (str(tmp_path / "0.png"), 0)
    assert second.image[0, 0, 0] == 200
    assert second.at_s > first.at_s


def test_a_folder_without_news_ends_and_a_damaged_image_is_told(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"no image")
    told: list[str] = []
    assert not list(folder_frames(tmp_path, Reading(), idle_s=0.3, tell=told.append))
    assert len(told) == 1
    assert "a.png" in told[0]


def test_a_file_counts_only_when_it_is_complete(tmp_path: Path) -> None:
    write(tmp_path / "whole.png", 90)
    content = (tmp_path / "whole.png").read_bytes()
    (tmp_path / "whole.png").unlink()

    def fill() -> None:
        with (tmp_path / "slow.png").open("wb") as file:
            for k in range(0, len(content), len(content) // 8):
                file.write(content[k : k + len(content) // 8])
                file.flush()
                time.sleep(0.02)

    thread = threading.Thread(target=fill)
    thread.start()
    told: list[str] = []
    frames = list(folder_frames(tmp_path, Reading(), idle_s=1.0, tell=told.append))
    thread.join()
    assert [each.image[0, 0, 0] for each in frames] == [90]
    assert not told


def test_a_folder_that_vanishes_and_returns_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "card"
    folder.mkdir()
    write(folder / "a.png", 1)
    frames = folder_frames(folder, Reading(), idle_s=5)
    assert next(frames).name.endswith("a.png")
    shutil.rmtree(folder)
    folder.mkdir()
    write(folder / "b.png", 2)
    assert next(frames).name.endswith("b.png")


class Film:
    """A camera of a few frames, which then fails."""

    def __init__(self, levels: list[int], pause_s: float) -> None:
        self.levels, self.pause_s, self.released = levels, pause_s, False

    def read(self) -> tuple[bool, NDArray[np.uint8]]:
        time.sleep(self.pause_s)
        known = bool(self.levels)
        level = self.levels.pop(0) if known else 0
        return known, np.full((24, 32, 3), (level, 0, 0), np.uint8)

    def release(self) -> None:
        self.released = True


def test_the_newest_frame_of_a_camera_wins() -> None:
    film = Film(list(range(1, 41)), 0.01)
    frames = camera_frames(lambda: film, "camera 0", tell=lambda _: None)
    taken = []
    for frame in islice(frames, 3):
        taken.append(int(frame.image[0, 0, 2]))  # RGB of BGR
        time.sleep(0.1)
    frames.close()
    assert taken == sorted(set(taken))
    assert taken[-1] > 10
    assert frame.n_skipped >= 2


def test_a_lost_camera_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vehanchor_flight.live.frames._RETRY_S", 0.05)
    cameras = [Film([1], 0.02), None, None, Film([2], 0.02)]
    kept, told = list(cameras), list[str]()
    frames = camera_frames(lambda: cameras.pop(0) if cameras else None, "camera 0", idle_s=1, tell=told.append)
    assert [int(each.image[0, 0, 2]) for each in frames] == [1, 2]
    assert kept[0] is not None
    assert kept[0].released
    assert told[:2] == [
        "camera 0 gives no frames: it is tried again every second",
        "camera 0 gives frames again",
    ]


def test_a_video_gives_every_interval_in_its_own_time(tmp_path: Path) -> None:
    path = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for level in range(30):
        writer.write(np.full((48, 64, 3), 5 * level, np.uint8))
    writer.release()
    frames = list(open_frames(str(path), Reading(), every_s=1.0, idle_s=None, tell=print))
    assert [each.at_s for each in frames] == [0.0, 1.0, 2.0]
    assert sum(each.n_skipped for each in frames) == 0
