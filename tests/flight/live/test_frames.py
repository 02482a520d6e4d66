from __future__ import annotations

import os
import shutil
import threading
import time
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.options import Reading
from vehanchor_flight.live.frames import folder_frames

if TYPE_CHECKING:
    from pathlib import Path


def write(path: Path, level: int) -> None:
    cv2.imwrite(str(path), np.full((48, 64, 3), level, np.uint8))


def test_of_a_full_folder_the_newest_image_is_taken_and_then_each_new_one(tmp_path: Path) -> None:
    for number in range(4):
        write(tmp_path / f"{number}.png", 10 * number)
        os.utime(tmp_path / f"{number}.png", (1000 + number, 1000 + number))
    (tmp_path / "notes.txt").write_text("no image")
    frames = folder_frames(tmp_path, Reading(), idle_s=5, tell=print)
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
    frames = folder_frames(folder, Reading(), idle_s=5, tell=print)
    assert next(frames).name.endswith("a.png")
    shutil.rmtree(folder)
    folder.mkdir()
    write(folder / "b.png", 2)
    assert next(frames).name.endswith("b.png")
