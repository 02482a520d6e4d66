from __future__ import annotations

import math
import os
import shutil
import threading
import time
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.flight.ground import ground, photograph_of, write_film
from tests.models import paint_vehicles, write_detector
from vehanchor.detection.detector import load_detector
from vehanchor.options import Reading, ScaleOptions
from vehanchor_flight.live.estimator import WINDOW_PX, LiveEstimator, next_window, reduction_factor
from vehanchor_flight.live.filter import (
    FilterState,
    Measurement,
    Motion,
    corrected,
    predicted,
    started,
)
from vehanchor_flight.live.frames import Frame, camera_frames, folder_frames, open_frames


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
        self.levels = levels
        self.pause_s = pause_s
        self.released = False

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
    kept = list(cameras)
    told = list[str]()
    frames = camera_frames(
        lambda: cameras.pop(0) if cameras else None, "camera 0", idle_s=0.4, tell=told.append
    )
    assert [int(each.image[0, 0, 2]) for each in frames] == [1, 2]
    assert kept[0] is not None
    assert kept[0].released
    assert told[:2] == [
        "camera 0 gives no frames: it is tried again every second",
        "camera 0 gives frames again",
    ]


def test_a_video_gives_every_interval_in_its_own_time(tmp_path: Path) -> None:
    path = write_film(
        tmp_path / "film.avi", [np.full((48, 64, 3), 5 * level, np.uint8) for level in range(30)]
    )
    frames = list(open_frames(path, Reading(), every_s=1.0, idle_s=None, tell=print))
    assert [each.at_s for each in frames] == [0.0, 1.0, 2.0]
    assert sum(each.n_skipped for each in frames) == 0


SIDES = st.integers(16, 5000)


@given(
    SIDES,
    SIDES,
    st.floats(0.003, 3),
    st.integers(0, 50),
    st.lists(st.tuples(SIDES, SIDES), max_size=9),
)
def test_a_window_lies_in_the_reduced_frame(
    width: int, height: int, gsd: float, turn: int, cars: list[tuple[int, int]]
) -> None:
    factor = reduction_factor(gsd, width, height)
    window = next_window(
        width, height, factor=factor, turn=turn, cars=np.array(cars, np.float64).reshape(-1, 2)
    )
    assert 0 <= window.x_px <= window.x_px + window.width_px <= width // factor
    assert 0 <= window.y_px <= window.y_px + window.height_px <= height // factor
    assert 0 < max(window.width_px, window.height_px) <= WINDOW_PX


def test_the_window_with_the_most_cars_is_searched_and_others_now_and_then() -> None:
    cars = np.array([[1000.0, 500.0], [1050.0, 520.0], [100.0, 100.0]])
    windows = [next_window(1280, 720, factor=1, turn=turn, cars=cars) for turn in range(8)]
    holds = [
        each.x_px <= 1000 and each.x_px + each.width_px > 1050 and each.y_px <= 500
        for each in windows
    ]
    assert sum(holds) >= 6
    assert len(set(windows)) > 1


@pytest.mark.parametrize(("gsd", "factor"), [(None, 1), (0.3, 1), (0.05, 2), (0.03, 4), (0.005, 4)])
def test_the_frame_is_reduced_until_cars_have_a_known_length(
    gsd: float | None, factor: int
) -> None:
    assert reduction_factor(gsd, 1280, 720) == factor


LOGS = st.floats(-5.0, 0.5)
SDS = st.floats(0.01, 0.3)
CHANCES = st.floats(0.05, 0.999)
MEASUREMENTS = st.builds(Measurement, LOGS, SDS, SDS, CHANCES)
MOTIONS = st.builds(Motion, st.floats(-0.5, 0.5), st.floats(0.001, 0.1), st.floats(0.0, 1.0))
SURE = Measurement(math.log(0.1), 0.05, common_log_sd=0.04, chance=0.95)


@given(MEASUREMENTS, MOTIONS, st.floats(0, 1))
def test_a_motion_moves_the_scale_by_its_ratio_and_never_makes_it_surer(
    measured: Measurement, motion: Motion, seconds: float
) -> None:
    before = started(measured)
    after = predicted(before, seconds, motion)
    assert after is not None
    assert after.log_gsd == pytest.approx(before.log_gsd + motion.log_ratio)
    assert after.variance > before.variance


@given(MEASUREMENTS, st.floats(0.1, 1.0))
def test_frames_without_common_features_widen_more_than_any_linked_ones(
    measured: Measurement, seconds: float
) -> None:
    before = started(measured)
    linked = predicted(before, seconds, Motion(0.0, 0.02, 1.0))
    apart = predicted(before, seconds, None)
    assert linked is not None
    assert apart is None or apart.variance > linked.variance


@given(MEASUREMENTS, MEASUREMENTS, st.floats(0, 1))
def test_a_correction_lies_between_state_and_measurement_or_starts_anew(
    first: Measurement, second: Measurement, moved: float
) -> None:
    state = predicted(started(first), 0.2, Motion(0.0, 0.01, moved))
    assert state is not None
    after = corrected(state, second)
    low, high = sorted((state.log_gsd, second.log_gsd))
    assert low - 1e-9 <= after.log_gsd <= high + 1e-9
    assert after.variance <= state.variance + 1e-12
    assert after.log_sd >= after.common_log_sd
    assert 0 <= after.chance <= 1


@given(st.lists(st.tuples(MEASUREMENTS, st.none() | MOTIONS), max_size=30))
def test_whatever_comes_the_state_is_sound(steps: list[tuple[Measurement, Motion | None]]) -> None:
    state: FilterState | None = None
    for measured, motion in steps:
        if state is not None:
            state = predicted(state, 0.2, motion)
        state = corrected(state, measured)
        assert all(map(math.isfinite, state))
        assert state.variance > 0
        low, high = state.interval
        assert low < state.gsd_m_per_px < high
        assert 0 <= state.chance < 0.99


def test_hovering_over_the_same_cars_does_not_narrow_the_interval() -> None:
    state = hovering = started(SURE)
    flown = started(SURE)
    for _ in range(20):
        hovering = corrected(predicted(hovering, 0.2, Motion(0.0, 0.01, 0.0)), SURE)
        flown = corrected(predicted(flown, 0.2, Motion(0.0, 0.01, 1.0)), SURE)
    assert hovering.log_sd > 0.85 * state.log_sd
    assert flown.log_sd < 0.85 * state.log_sd
    assert flown.log_sd > SURE.common_log_sd


def test_more_cars_over_the_same_ground_narrow_it_as_if_seen_at_once() -> None:
    few = SURE._replace(log_sd=0.2)
    many = SURE._replace(log_sd=0.03)
    state = corrected(started(few), many)
    assert math.sqrt(state.variance) == pytest.approx(0.03, rel=0.05)


def test_one_contradiction_takes_the_ok_away_and_three_start_anew() -> None:
    state = started(SURE)
    assert state.usable
    other = SURE._replace(log_gsd=math.log(0.2))
    once = corrected(state, other)
    assert not once.usable
    assert once.gsd_m_per_px == pytest.approx(0.1)
    assert corrected(once, SURE).contradictions == 0
    anew = corrected(corrected(once, other), other)
    assert anew.gsd_m_per_px == pytest.approx(0.2)
    assert anew.contradictions == 0


def test_without_any_link_the_scale_ends_in_seconds() -> None:
    state: FilterState | None = started(SURE)
    seconds = 0.0
    while state is not None:
        state = predicted(state, 0.5, None)
        seconds = seconds + 0.5
        assert state is None or seconds < 0.5 or not state.usable
    assert 1 < seconds < 30


@pytest.mark.parametrize("chance", [0.3, 0.7])
def test_doubtful_frames_of_new_ground_that_agree_become_sure_only_if_likely(chance: float) -> None:
    measured = SURE._replace(chance=chance)
    state = started(measured)
    assert not state.usable
    for _ in range(6):
        state = corrected(predicted(state, 0.2, Motion(0.0, 0.01, 1.0)), measured)
    assert state.usable == (chance > 0.5)


FLEET = 30.0 * (1 + 0.06 * np.linspace(-1, 1, 9) ** 3)


@pytest.fixture(scope="module")
def estimator(tmp_path_factory: pytest.TempPathFactory) -> LiveEstimator:
    path = write_detector(tmp_path_factory.mktemp("model") / "detector.onnx")
    return LiveEstimator(load_detector(path), ScaleOptions(), hold_s=2.0)


@pytest.fixture(scope="module")
def world() -> NDArray[np.uint8]:
    return (ground(1000) // 2).astype(np.uint8)


def frame_of(image: NDArray[np.uint8], at_s: float, *, cars: bool) -> Frame:
    if cars:
        boxes = [
            [60 + 70 * (k % 6), 80 + 90 * (k // 6), length, 12, 0.4]
            for k, length in enumerate(FLEET)
        ]
        paint_vehicles(image, np.reshape(boxes, (-1, 5)))
    return Frame(f"at {at_s:.1f} s", image, at_s, 0.0, 0)


def test_the_scale_follows_a_climb_without_cars_and_ends_after_the_hold(
    estimator: LiveEstimator, world: NDArray[np.uint8]
) -> None:
    seen = estimator.estimate(frame_of(photograph_of(world, 480, 500), 0.0, cars=True))
    assert seen.gsd_m_per_px is not None
    assert seen.n_vehicles > 4
    assert not seen.linked
    estimator.estimate(frame_of(photograph_of(world, 480, 500), 0.2, cars=False))
    scale = 1.0
    for step in range(1, 5):
        scale = math.exp(0.02 * step)
        climbed = estimator.estimate(
            frame_of(
                photograph_of(world, 480 + 8 * step, 500, scale=scale, turn_deg=3 * step),
                0.2 + 0.2 * step,
                cars=False,
            )
        )
    assert climbed.linked
    assert climbed.n_vehicles == 0
    assert climbed.gsd_m_per_px == pytest.approx(seen.gsd_m_per_px * scale, rel=0.02)
    assert climbed.seen_s_ago == pytest.approx(1.0)
    late = estimator.estimate(frame_of(photograph_of(world, 480, 500), 4.0, cars=False))
    assert (late.status, late.gsd_m_per_px, late.confidence) == ("no_scale", None, 0.0)


def test_a_frame_that_shows_nothing_gives_nothing(tmp_path: Path) -> None:
    detector = load_detector(write_detector(tmp_path / "detector.onnx"))
    empty = LiveEstimator(detector, ScaleOptions())
    for number in range(3):
        record = empty.estimate(
            Frame("grey", np.full((90, 160, 3), 80, np.uint8), 0.2 * number, 0.0, 0)
        )
        assert (record.status, record.gsd_m_per_px, record.linked) == ("no_scale", None, False)
