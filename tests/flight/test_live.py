from __future__ import annotations

import math
import os
import queue
import shutil
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.flight.ground import ground, photograph_of, write_film
from tests.models import paint_vehicles, write_detector
from vehanchor.detection.detector import load_detector
from vehanchor.errors import ImageNotFoundError
from vehanchor.imagery.raster import Window
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
from vehanchor_flight.records import LiveScale


def _write(path: Path, level: int) -> None:
    cv2.imwrite(str(path), np.full((48, 64, 3), level, np.uint8))


@pytest.fixture
def full_folder(tmp_path: Path) -> Path:
    """Write four images, the last of them the newest, and a text."""
    for number in range(4):
        path = tmp_path / f"{number}.png"
        _write(path, 10 * number)
        os.utime(path, (1000 + number, 1000 + number))
    (tmp_path / "notes.txt").write_text("no image")
    return tmp_path


def test_the_newest_image_of_a_full_folder_is_taken(full_folder: Path) -> None:
    first = next(folder_frames(full_folder, Reading()))
    assert first.name == str(full_folder / "3.png")
    assert first.n_skipped == 3


def test_an_image_that_is_replaced_is_taken_again(full_folder: Path) -> None:
    frames = folder_frames(full_folder, Reading())
    first = next(frames)
    _write(full_folder / "0.png", 200)
    second = next(frames)
    assert second.name == str(full_folder / "0.png")
    assert second.n_skipped == 0
    assert second.image[0, 0, 0] == 200
    assert second.at_s > first.at_s


def test_a_damaged_image_is_reported(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"no image")
    sentences: list[str] = []
    frames = list(folder_frames(tmp_path, Reading(), idle_s=0.3, tell=sentences.append))
    assert not frames
    assert len(sentences) == 1
    assert "a.png" in sentences[0]


def test_a_file_counts_only_when_it_is_complete(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "slow.png"
    _write(path, 90)
    content = path.read_bytes()
    parts = [content[start : start + 40] for start in range(0, len(content), 40)]
    path.write_bytes(b"")

    def write_next_part(_: float) -> None:
        if parts:
            path.write_bytes(path.read_bytes() + parts.pop(0))

    # The file grows between two polls.
    monkeypatch.setattr("vehanchor_flight.live.frames.time.sleep", write_next_part)
    sentences: list[str] = []
    frame = next(folder_frames(tmp_path, Reading(), tell=sentences.append))
    assert frame.image[0, 0, 0] == 90
    assert not parts
    assert not sentences


def test_the_end_of_a_folder_is_not_before_its_files_were_seen(tmp_path: Path) -> None:
    _write(tmp_path / "a.png", 1)
    (frame,) = folder_frames(tmp_path, Reading(), idle_s=1e-9)
    assert frame.name.endswith("a.png")


def test_a_folder_that_vanishes_and_returns_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "card"
    folder.mkdir()
    _write(folder / "a.png", 1)
    frames = folder_frames(folder, Reading())
    assert next(frames).name.endswith("a.png")
    shutil.rmtree(folder)
    folder.mkdir()
    _write(folder / "b.png", 2)
    assert next(frames).name.endswith("b.png")


class StagedCamera:
    """Camera that shows what a test gives it: levels of blue, and None for its loss.

    Attributes:
        released: whether it was closed.
    """

    def __init__(self, *levels: int | None) -> None:
        self.released = False
        self._levels: queue.Queue[int | None] = queue.Queue()
        self._has_read = False
        for level in levels:
            self._levels.put(level)

    def give(self, *levels: int | None) -> None:
        """Give further levels, and wait until the reader of the camera has dealt with all."""
        for level in levels:
            self._levels.put(level)
        self._levels.join()

    def read(self) -> tuple[bool, NDArray[np.uint8]]:
        # Who reads again has dealt with the last frame.
        if self._has_read:
            self._levels.task_done()
        self._has_read = True
        level = self._levels.get()
        if level is None:
            self._levels.task_done()
        blue = np.full((24, 32, 3), (level or 0, 0, 0), np.uint8)
        return level is not None, blue

    def release(self) -> None:
        self.released = True


def _level(frame: Frame) -> int:
    """Return the level of a frame: blue in the camera's BGR is the last channel of RGB."""
    return int(frame.image[0, 0, 2])


def test_the_newest_frame_of_a_camera_wins() -> None:
    camera = StagedCamera(1)
    frames = camera_frames(lambda: camera, "camera 0", tell=lambda _: None)
    first = next(frames)
    camera.give(2, 3, 4)
    newest = next(frames)
    frames.close()
    camera.give(None)
    assert (_level(first), first.n_skipped) == (1, 0)
    assert (_level(newest), newest.n_skipped) == (4, 2)


def test_a_lost_camera_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vehanchor_flight.live.frames._RETRY_S", 0.01)
    first = StagedCamera(1)
    second = StagedCamera(2)
    cameras = [first, None, None, second]
    sentences: list[str] = []
    frames = camera_frames(lambda: cameras.pop(0), "camera 0", tell=sentences.append)
    assert _level(next(frames)) == 1
    first.give(None)
    assert _level(next(frames)) == 2
    frames.close()
    second.give(None)
    assert first.released
    assert sentences[:2] == [
        "camera 0 gives no frames: it is tried again every second",
        "camera 0 gives frames again",
    ]


def test_a_camera_that_is_silent_ends_after_the_idle_time() -> None:
    camera = StagedCamera()
    assert not list(camera_frames(lambda: camera, "camera 0", idle_s=0.05, tell=lambda _: None))
    camera.give(None)


def test_a_camera_that_never_gives_a_frame_ends_with_an_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("vehanchor_flight.live.frames._RETRY_S", 0.01)
    frames = camera_frames(lambda: None, "camera 7", tell=lambda _: None)
    with pytest.raises(ImageNotFoundError, match="camera 7 gives no frames: connect it"):
        next(frames)


def test_a_full_folder_says_that_only_the_newest_counts(full_folder: Path) -> None:
    sentences: list[str] = []
    next(folder_frames(full_folder, Reading(), tell=sentences.append))
    assert "'vehanchor flight " in sentences[0]


def test_an_error_of_the_camera_reaches_the_caller() -> None:
    def open_camera() -> StagedCamera:
        raise RuntimeError("the driver failed")

    frames = camera_frames(open_camera, "camera 0", tell=lambda _: None)
    with pytest.raises(RuntimeError, match="the driver failed"):
        next(frames)


def test_a_video_gives_every_interval_in_its_own_time(tmp_path: Path) -> None:
    images = [np.full((48, 64, 3), 5 * level, np.uint8) for level in range(30)]
    path = write_film(tmp_path / "film.avi", images)
    frames = list(open_frames(path, Reading(), every_s=1.0, idle_s=None, tell=print))
    assert [frame.at_s for frame in frames] == [0.0, 1.0, 2.0]
    assert sum(frame.n_skipped for frame in frames) == 0


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
    centres = np.array(cars, np.float64).reshape(-1, 2)
    window = next_window(width, height, factor=factor, turn=turn, cars=centres)
    assert 0 <= window.x_px <= window.x_px + window.width_px <= width // factor
    assert 0 <= window.y_px <= window.y_px + window.height_px <= height // factor
    assert 0 < max(window.width_px, window.height_px) <= WINDOW_PX


@pytest.fixture(scope="module")
def windows() -> list[Window]:
    """Choose windows in turn, for two cars beside each other and one far from them."""
    cars = np.array([[1000.0, 500.0], [1050.0, 520.0], [100.0, 100.0]])
    return [next_window(1280, 720, factor=1, turn=turn, cars=cars) for turn in range(8)]


def test_the_window_with_the_most_cars_is_searched_most_often(windows: list[Window]) -> None:
    n_around_both = 0
    for window in windows:
        right = window.x_px + window.width_px
        if window.x_px <= 1000 and right > 1050 and window.y_px <= 500:
            n_around_both += 1
    assert n_around_both >= 6


def test_other_windows_are_searched_now_and_then(windows: list[Window]) -> None:
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
def test_a_motion_moves_the_scale_by_its_ratio(
    measured: Measurement, motion: Motion, seconds: float
) -> None:
    before = started(measured)
    after = predicted(before, seconds, motion)
    assert after is not None
    assert after.log_gsd == pytest.approx(before.log_gsd + motion.log_ratio)


@given(MEASUREMENTS, MOTIONS, st.floats(0, 1))
def test_a_motion_widens_the_error(measured: Measurement, motion: Motion, seconds: float) -> None:
    before = started(measured)
    after = predicted(before, seconds, motion)
    assert after is not None
    assert after.variance > before.variance


@given(MEASUREMENTS, st.floats(0.1, 1.0))
def test_frames_without_common_features_widen_it_more(
    measured: Measurement, seconds: float
) -> None:
    before = started(measured)
    linked = predicted(before, seconds, Motion(0.0, 0.02, 1.0))
    apart = predicted(before, seconds, None)
    assert linked is not None
    assert apart is None or apart.variance > linked.variance


@given(MEASUREMENTS, MEASUREMENTS, st.floats(0, 1))
def test_a_corrected_scale_lies_between_state_and_measurement(
    first: Measurement, second: Measurement, moved: float
) -> None:
    state = predicted(started(first), 0.2, Motion(0.0, 0.01, moved))
    assert state is not None
    after = corrected(state, second)
    low, high = sorted((state.log_gsd, second.log_gsd))
    assert low - 1e-9 <= after.log_gsd <= high + 1e-9


@given(MEASUREMENTS, MEASUREMENTS, st.floats(0, 1))
def test_a_correction_narrows_the_error(
    first: Measurement, second: Measurement, moved: float
) -> None:
    state = predicted(started(first), 0.2, Motion(0.0, 0.01, moved))
    assert state is not None
    after = corrected(state, second)
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


def _after_frames(n: int, moved: float, measured: Measurement = SURE) -> FilterState:
    """Filter n frames with the same measurement, each of which shows a share of new ground."""
    state = started(measured)
    for _ in range(n):
        state = corrected(predicted(state, 0.2, Motion(0.0, 0.01, moved)), measured)
    return state


def test_hovering_over_the_same_cars_does_not_narrow_the_interval() -> None:
    assert _after_frames(20, moved=0.0).log_sd > 0.85 * started(SURE).log_sd


def test_flying_over_new_cars_narrows_the_interval() -> None:
    flown = _after_frames(20, moved=1.0)
    assert flown.log_sd < 0.85 * started(SURE).log_sd
    assert flown.log_sd > SURE.common_log_sd


def test_more_cars_of_the_same_ground_count_as_if_alone() -> None:
    few = SURE._replace(log_sd=0.2)
    many = SURE._replace(log_sd=0.03)
    state = corrected(started(few), many)
    assert math.sqrt(state.variance) == pytest.approx(0.03, rel=0.05)


CONTRADICTING = SURE._replace(log_gsd=math.log(0.2))


def test_one_contradiction_makes_a_scale_unusable() -> None:
    state = started(SURE)
    assert state.usable
    once = corrected(state, CONTRADICTING)
    assert not once.usable
    assert once.gsd_m_per_px == pytest.approx(0.1)


def test_an_agreeing_measurement_ends_the_contradictions() -> None:
    once = corrected(started(SURE), CONTRADICTING)
    assert corrected(once, SURE).contradictions == 0


def test_three_contradictions_start_the_filter_anew() -> None:
    state = started(SURE)
    for _ in range(3):
        state = corrected(state, CONTRADICTING)
    assert state.gsd_m_per_px == pytest.approx(0.2)
    assert state.contradictions == 0


def test_without_any_link_the_scale_ends_in_seconds() -> None:
    state: FilterState | None = started(SURE)
    seconds = 0.0
    while state is not None:
        state = predicted(state, 0.5, None)
        seconds += 0.5
        assert state is None or seconds < 0.5 or not state.usable
    assert 1 < seconds < 30


@pytest.mark.parametrize("chance", [0.3, 0.7])
def test_doubtful_frames_that_agree_become_sure_only_if_likely(chance: float) -> None:
    measured = SURE._replace(chance=chance)
    assert not started(measured).usable
    assert _after_frames(6, moved=1.0, measured=measured).usable == (chance > 0.5)


FLEET = 30.0 * (1 + 0.06 * np.linspace(-1, 1, 9) ** 3)


def _frame(image: NDArray[np.uint8], at_s: float, *, cars: bool = False) -> Frame:
    if cars:
        places = [(60 + 70 * (k % 6), 80 + 90 * (k // 6)) for k in range(len(FLEET))]
        boxes = [[x, y, length, 12, 0.4] for (x, y), length in zip(places, FLEET, strict=True)]
        paint_vehicles(image, np.array(boxes))
    return Frame(f"at {at_s:.1f} s", image, at_s, arrived_s=0.0, n_skipped=0)


class Climb(NamedTuple):
    """Records of a flight: over cars, after a climb without cars, and after a long time."""

    first: LiveScale
    climbed: LiveScale
    late: LiveScale
    scale: float


@pytest.fixture(scope="module")
def climb(tmp_path_factory: pytest.TempPathFactory) -> Climb:
    """Fly over cars, then climb without any, then wait for longer than the hold."""
    path = write_detector(tmp_path_factory.mktemp("model") / "detector.onnx")
    estimator = LiveEstimator(load_detector(path), ScaleOptions(), hold_s=2.0)
    world = (ground(1000) // 2).astype(np.uint8)
    first = estimator.estimate(_frame(photograph_of(world, 480, 500), 0.0, cars=True))
    estimator.estimate(_frame(photograph_of(world, 480, 500), 0.2))
    for step in range(1, 5):
        scale = math.exp(0.02 * step)
        x = 480 + 8 * step
        image = photograph_of(world, x, 500, scale=scale, turn_deg=3 * step)
        climbed = estimator.estimate(_frame(image, 0.2 + 0.2 * step))
    late = estimator.estimate(_frame(photograph_of(world, 480, 500), 4.0))
    return Climb(first, climbed, late, scale)


def test_the_first_frame_has_a_scale_by_its_cars(climb: Climb) -> None:
    assert climb.first.gsd_m_per_px is not None
    assert climb.first.n_vehicles > 4
    assert not climb.first.linked


def test_the_scale_follows_a_climb_without_cars(climb: Climb) -> None:
    assert climb.first.gsd_m_per_px is not None
    assert climb.climbed.linked
    assert climb.climbed.n_vehicles == 0
    expected = climb.first.gsd_m_per_px * climb.scale
    assert climb.climbed.gsd_m_per_px == pytest.approx(expected, rel=0.02)
    assert climb.climbed.seen_s_ago == pytest.approx(1.0)


def test_the_scale_ends_after_the_hold(climb: Climb) -> None:
    assert climb.late.status == "no_scale"
    assert climb.late.gsd_m_per_px is None
    assert climb.late.confidence == 0.0


def test_a_frame_that_shows_nothing_gives_nothing(tmp_path: Path) -> None:
    detector = load_detector(write_detector(tmp_path / "detector.onnx"))
    empty = LiveEstimator(detector, ScaleOptions())
    grey = np.full((90, 160, 3), 80, np.uint8)
    for number in range(3):
        record = empty.estimate(_frame(grey, 0.2 * number))
        assert record.status == "no_scale"
        assert record.gsd_m_per_px is None
        assert not record.linked
