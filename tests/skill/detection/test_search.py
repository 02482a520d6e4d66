"""The search over reduced copies of an image, and what keeps it from being sure of the wrong thing."""

from __future__ import annotations

from itertools import pairwise
from statistics import NormalDist
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.analyses import analyse_found
from tests.models import blank_image, paint_vehicles, write_detector
from tests.yards import YARDS, Yard, paint_yard
from vehanchor.detection.detector import MIN_LEVEL_SIDE_PX, Detections, Detector, detect_vehicles, search_levels
from vehanchor.estimate import analyse_scale, estimate_gsd
from vehanchor.imagery.detail import PATCH_PX, resolved_share, ring_spectrum, spectrum_share
from vehanchor.imagery.raster import Raster, Window, open_raster
from vehanchor.imagery.tiles import read_reduced_window
from vehanchor.models.zoo import resolve_model
from vehanchor.options import ScaleOptions
from vehanchor.scale.lengths import dominant_group
from vehanchor_evaluation.gsd import read_table
from vehanchor_scenes import Scene, render_scene

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

_RANGE = {"vehanchor.length_range_px": "9,64"}
_SEARCHING = _RANGE | {"vehanchor.search_scales": "1"}


@pytest.fixture(scope="module")
def searching(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    """A detector of painted vehicles whose file asks for the search."""
    return Detector(write_detector(tmp_path_factory.mktemp("model") / "m.onnx", metadata=_SEARCHING))


@pytest.fixture(scope="module")
def bundled() -> Detector:
    return Detector(resolve_model(), threads=2)


def _painted(
    factor: int, lengths: list[float], columns: int = 6, **kinds: Any
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A picture in which vehicles can be read in the copy reduced by ``factor`` alone, and their boxes.

    Each pixel of a painted picture becomes a block: reduced by as much, the beacons are whole again. In the full
    picture what stands beside a mark is the mark itself, which spells a vehicle of 255 px: too long to count.
    """
    small = blank_image(60 + 70 * columns, 60 + 60 * -(-len(lengths) // columns))
    boxes = [[40 + 70 * (k % columns), 50 + 60 * (k // columns), size, 12, 0.4] for k, size in enumerate(lengths)]
    found = paint_vehicles(small, boxes, **kinds)
    found[:, :4] *= factor
    return np.kron(small, np.ones((factor, factor, 1), np.uint8)), found


def _fleet(mean: float, n: int = 30) -> list[float]:
    """Lengths as a fleet has them: normal, spread by 7 %."""
    return [mean * (1 + 0.07 * NormalDist().inv_cdf((k + 0.5) / n)) for k in range(n)]


# --- Levels ----------------------------------------------------------------------------------------------------------


@given(
    st.integers(16, 9000),
    st.integers(16, 9000),
    st.tuples(st.floats(5, 20), st.floats(40, 200)),
    st.floats(1, 1600),
)
def test_every_length_counts_at_some_level_and_at_two_around_their_border(
    width: int, height: int, length_range: tuple[float, float], length: float
) -> None:
    levels = search_levels(width, height, length_range, search_scales=True)
    assert levels[0].factor == 1
    assert any(level.shortest_px <= length / level.factor <= level.longest_px for level in levels)
    for fine, coarse in pairwise(levels):
        assert coarse.factor == 2 * fine.factor
        assert min(coarse.width_px, coarse.height_px) >= MIN_LEVEL_SIDE_PX
        assert coarse.shortest_px * coarse.factor < 0.81 * fine.longest_px * fine.factor


def test_full_resolution_alone_has_no_limits() -> None:
    (only,) = search_levels(4000, 3000, (9, 64), search_scales=False)
    assert (only.factor, only.shortest_px, only.longest_px) == (1, 0.0, np.inf)
    (small,) = search_levels(180, 4000, (9, 64), search_scales=True)
    assert small == search_levels(180, 4000, (9, 64), search_scales=False)[0]


@pytest.mark.parametrize("factor", [1, 2, 4, 8])
def test_a_reduced_window_is_the_mean_of_blocks_and_is_read_in_small_pieces(
    factor: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    image = np.random.default_rng(0).integers(0, 256, (600, 2300, 3), dtype=np.uint8)
    read: list[Window] = []
    whole = Raster.read

    def spy(self: Raster, window: Window | None = None) -> NDArray[np.uint8]:
        assert window is not None
        read.append(window)
        return whole(self, window)

    monkeypatch.setattr(Raster, "read", spy)
    window = Window(3, 5, 2300 // factor - 7, 600 // factor - 9)
    with open_raster(image) as raster:
        reduced = read_reduced_window(raster, window, factor)
    part = image[: 600 // factor * factor, : 2300 // factor * factor].astype(np.float64)
    mean = part.reshape(600 // factor, factor, 2300 // factor, factor, 3).mean(axis=(1, 3))
    expected = mean[5 : 5 + window.height_px, 3 : 3 + window.width_px]
    assert np.abs(reduced - expected).max() <= 0.75  # rounding to whole grey levels
    if factor > 1:
        assert max(max(w.width_px, w.height_px) for w in read) <= 1024


# --- The search ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("factor", "mean"), [(1, 30.0), (2, 45.0), (4, 45.0), (8, 40.0)])
def test_vehicles_are_found_at_the_level_that_fits_them_in_pixels_of_the_image(
    searching: Detector, factor: int, mean: float
) -> None:
    image, painted = _painted(factor, _fleet(mean, 12), columns=4)
    analysis = analyse_scale(image, detector=searching)
    found, e = analysis.detections, analysis.estimate
    order = np.lexsort((found.boxes[:, 0], np.rint(found.boxes[:, 1] / 10 / factor)))
    np.testing.assert_allclose(found.boxes[order], painted, atol=0.02 * factor)
    assert found.scales is not None
    assert set(found.scales) == {1 / factor}
    assert e.working_scale == 1 / factor
    assert e.mode_length_px == pytest.approx(mean * factor, rel=0.015)
    assert e.status == "ok"
    assert e.warnings == ()


def test_the_search_is_the_models_choice_and_the_callers(tmp_path: Path, searching: Detector) -> None:
    image, painted = _painted(2, _fleet(45.0, 12), columns=4)
    plain = Detector(write_detector(tmp_path / "plain.onnx", metadata=_RANGE))
    found = {
        (name, wanted): estimate_gsd(image, detector=detector, search_scales=wanted)
        for name, detector in (("plain", plain), ("searching", searching))
        for wanted in (None, False, True)
    }
    with_cars = {key for key, e in found.items() if e.mode_length_px == pytest.approx(90, rel=0.015)}
    assert with_cars == {("plain", True), ("searching", None), ("searching", True)}
    assert {e.working_scale for key, e in found.items() if key in with_cars} == {0.5}
    assert estimate_gsd(blank_image(500, 500), detector=searching).working_scale is None
    assert len(painted) == 12


def test_lengths_outside_a_levels_range_do_not_count(searching: Detector) -> None:
    for factor, length in ((2, 20.0), (2, 70.0), (4, 20.0)):
        image, _ = _painted(factor, [length] * 12, columns=4)
        with open_raster(image) as raster:
            assert len(detect_vehicles(raster, searching).boxes) == 0


def test_tiles_of_a_reduced_copy_find_each_vehicle_once_and_none_cut(searching: Detector) -> None:
    image, painted = _painted(2, _fleet(45.0, 42), columns=7)
    with open_raster(image) as raster:
        one = detect_vehicles(raster, searching)
        many = detect_vehicles(raster, searching, tile_px=160, stride_px=96)
    assert many.n_tiles > one.n_tiles
    assert len(one.boxes) == len(many.boxes) == len(painted) == 42
    np.testing.assert_allclose(np.sort(many.boxes[:, 2]), np.sort(painted[:, 2]), atol=0.02)


def test_progress_counts_the_tiles_of_all_levels_and_may_stop_in_any(searching: Detector) -> None:
    image = blank_image(1100, 900)
    seen: list[tuple[int, int]] = []
    with open_raster(image) as raster:
        found = detect_vehicles(raster, searching, progress=lambda done, total: seen.append((done, total)))
    assert found.n_tiles == 2 + 1 + 1 + 1
    assert seen == [(k, 5) for k in range(6)]

    def stop(done: int, total: int) -> None:
        if done == 3:
            raise TimeoutError

    with open_raster(image) as raster, pytest.raises(TimeoutError):
        detect_vehicles(raster, searching, progress=stop)


def test_the_search_costs_about_a_third_more_pixels() -> None:
    levels = search_levels(8000, 6000, (9, 64), search_scales=True)
    pixels = sum(level.width_px * level.height_px for level in levels)
    assert pixels == pytest.approx(8000 * 6000 * 1.33, rel=0.015)


# --- Levels that disagree --------------------------------------------------------------------------------------------


def _analysis(detector: Detector, groups: list[tuple[float, int, float, float]], **options: Any) -> Any:
    """An analysis of groups of (length, number, score, scale), their lengths spread as a fleet's."""
    lengths = np.concatenate([_fleet(length, n) for length, n, _, _ in groups])
    boxes = np.column_stack([np.arange(len(lengths)) * 999, lengths * 0, lengths, lengths / 2.2, lengths * 0])
    scores = np.concatenate([np.full(n, score) for _, n, score, _ in groups])
    scales = np.concatenate([np.full(n, scale) for _, n, _, scale in groups])
    return analyse_found(
        Detections(boxes, scores, scales=scales),
        detector.card,
        ScaleOptions.of(options),
        image_width_px=4000,
        image_height_px=4000,
    ).estimate


@given(
    st.lists(st.tuples(st.floats(5, 900), st.floats(0.01, 1)), min_size=1, max_size=60),
    st.randoms(use_true_random=False),
)
def test_the_dominant_group_is_a_fleet_whatever_the_order(found: list[tuple[float, float]], order: Any) -> None:
    lengths, weights = (np.array(column) for column in zip(*found, strict=True))
    group = dominant_group(lengths, weights)
    chosen = lengths[group.members]
    assert len(chosen) > 0
    assert chosen.max() / chosen.min() <= 1.5**2
    assert group.rival_share >= 0
    assert (group.rival_share == 0) == bool(group.members.all())
    shuffled = list(range(len(lengths)))
    order.shuffle(shuffled)
    again = dominant_group(lengths[shuffled], weights[shuffled])
    assert sorted(lengths[shuffled][again.members]) == sorted(chosen)


def test_the_heavier_of_two_groups_dominates_and_the_rival_is_measured_by_it() -> None:
    lengths = np.array(_fleet(30, 40) + _fleet(100, 10))
    group = dominant_group(lengths, np.r_[np.full(40, 0.5), np.full(10, 0.4)])
    assert group.members.tolist() == [True] * 40 + [False] * 10
    assert group.rival_share == pytest.approx(4 / 20)
    turned = dominant_group(lengths, np.r_[np.full(40, 0.05), np.full(10, 0.4)])
    assert turned.members.tolist() == [False] * 40 + [True] * 10


def test_a_level_with_little_evidence_neither_moves_nor_lowers_the_answer(searching: Detector) -> None:
    alone = _analysis(searching, [(30.0, 40, 0.8, 1.0)])
    beside = _analysis(searching, [(30.0, 40, 0.8, 1.0), (190.0, 6, 0.6, 0.25)])
    assert beside.mode_length_px == pytest.approx(alone.mode_length_px)
    assert beside.n_vehicles == 40
    assert beside.confidence == pytest.approx(alone.confidence)
    assert beside.working_scale == 1.0
    assert beside.warnings == ()


@pytest.mark.parametrize("other", [60.0, 190.0])
def test_two_levels_that_disagree_are_not_averaged_and_never_sure(searching: Detector, other: float) -> None:
    e = _analysis(searching, [(30.0, 30, 0.8, 1.0), (other, 26, 0.8, 0.5 if other < 100 else 0.25)])
    assert e.confidence < 0.5
    assert e.status == "low_confidence"
    assert [w.code for w in e.warnings] == ["lengths_disagree"]
    assert e.mode_length_px == pytest.approx(30.0, rel=0.02)
    assert e.n_vehicles == 30


@pytest.mark.parametrize(("n", "spread", "sure"), [(40, 0.02, False), (40, 0.08, True), (12, 0.02, True)])
def test_a_yard_of_equal_things_is_no_fleet(searching: Detector, n: int, spread: float, sure: bool) -> None:
    lengths = 40.0 * np.exp(np.random.default_rng(1).normal(0, spread, n))
    boxes = np.column_stack([np.arange(n) * 99, lengths * 0, lengths, lengths / 2.2, lengths * 0])

    def estimate(scales: NDArray[np.float64] | None) -> Any:
        found = Detections(boxes, np.full(n, 0.9), scales=scales)
        return analyse_found(found, searching.card, ScaleOptions(), image_width_px=4000, image_height_px=40).estimate

    searched = estimate(np.ones(n))
    assert (searched.confidence >= 0.5) is sure
    assert [w.code for w in searched.warnings] == ([] if sure else ["lengths_alike"])
    assert estimate(None).confidence >= 0.5  # at full resolution their size speaks for them


@pytest.mark.parametrize(
    ("n", "mean", "spread", "doubt"),
    [
        (30, 0.0, 1.2, None),
        (30, 0.5, 0.5, "looks_alike"),
        (12, 0.5, 0.5, None),
        (30, -3.6, 1.2, "looks_unlike_cars"),
        (12, -3.6, 1.2, None),
        (30, 3.6, 1.2, None),
    ],
)
def test_things_that_do_not_look_like_a_fleet_of_cars_are_never_sure(
    searching: Detector, n: int, mean: float, spread: float, doubt: str | None
) -> None:
    odds = mean + spread * np.array([NormalDist().inv_cdf((k + 0.5) / n) for k in range(n)])
    lengths = np.array(_fleet(40.0, n))
    boxes = np.column_stack([np.arange(n) * 99, lengths * 0, lengths, lengths / 2.2, lengths * 0])

    def estimate(scales: NDArray[np.float64] | None) -> Any:
        found = Detections(boxes, np.full(n, 0.9), scales=scales, fleet_log_odds=odds)
        return analyse_found(found, searching.card, ScaleOptions(), image_width_px=4000, image_height_px=40).estimate

    searched = estimate(np.ones(n))
    assert [w.code for w in searched.warnings] == ([doubt] if doubt else [])
    assert (searched.confidence >= 0.5) is (doubt is None)
    assert estimate(None).confidence >= 0.5  # at full resolution their size speaks for them


def test_vehicles_of_which_none_is_clearly_a_car_are_never_sure(tmp_path: Path) -> None:
    strict = Detector(write_detector(tmp_path / "m.onnx", metadata=_SEARCHING | {"vehanchor.clear_score": "0.75"}))
    assert strict.card.clear_score == 0.75
    faint, clear = (_analysis(strict, [(30.0, 34, 0.7, 1.0), (30.0, 6, best, 1.0)]) for best in (0.7, 0.8))
    assert (faint.status, [w.code for w in faint.warnings]) == ("low_confidence", ["scores_unclear"])
    assert (clear.status, clear.warnings) == ("ok", ())


def test_scores_and_not_numbers_alone_decide_which_level_dominates(searching: Detector) -> None:
    e = _analysis(searching, [(30.0, 30, 0.4, 1.0), (190.0, 20, 0.9, 0.25)])
    assert e.working_scale == 0.25
    assert e.mode_length_px == pytest.approx(190.0, rel=0.02)


def test_a_fleet_at_the_border_of_two_levels_is_one_fleet(searching: Detector) -> None:
    e = _analysis(searching, [(55.0, 20, 0.8, 1.0), (60.0, 18, 0.8, 0.5)])
    assert (e.status, e.n_vehicles, e.working_scale) == ("ok", 38, 1.0)
    assert 54 < e.mode_length_px < 61


def test_without_the_search_the_papers_filter_stays_as_it_is(tmp_path: Path) -> None:
    plain = Detector(write_detector(tmp_path / "m.onnx"))
    boxes = np.array([[99.0 * k, 0, 30 if k < 20 else 12, 8, 0] for k in range(36)])
    e = analyse_found(
        Detections(boxes, np.full(36, 0.9)), plain.card, ScaleOptions(), image_width_px=4000, image_height_px=40
    ).estimate
    assert (e.n_vehicles, e.warnings) == (36, ())


# --- Missing detail --------------------------------------------------------------------------------------------------


def _texture(side: int, seed: int = 0) -> NDArray[np.uint8]:
    """A picture with edges at all scales: overlapping rectangles, power falling with the square of the frequency."""
    rng = np.random.default_rng(seed)
    image = np.full((side, side, 3), 120, np.uint8)
    for _ in range(side * 3):
        x, y = rng.integers(0, side, 2)
        w, h = np.exp(rng.uniform(0.5, 4, 2)).astype(int) + 1
        cv2.rectangle(image, (int(x), int(y)), (int(x + w), int(y + h)), rng.integers(0, 256, 3).tolist(), -1)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.4), dtype=np.uint8)


def _share(image: NDArray[np.uint8]) -> float:
    step = PATCH_PX // 2
    return spectrum_share(
        ring_spectrum(
            image[y : y + PATCH_PX, x : x + PATCH_PX]
            for y in range(0, image.shape[0] - PATCH_PX, step)
            for x in range(0, image.shape[1] - PATCH_PX, step)
        )
    )


@pytest.mark.parametrize("way", [cv2.INTER_LINEAR, cv2.INTER_CUBIC, cv2.INTER_LANCZOS4])
@pytest.mark.parametrize("factor", [2, 3, 4])
def test_an_enlarged_image_has_the_detail_of_its_original(factor: int, way: int) -> None:
    original = _texture(128)
    assert _share(original) == 1.0
    enlarged = np.asarray(cv2.resize(original, None, fx=factor, fy=factor, interpolation=way), dtype=np.uint8)
    assert _share(enlarged) == pytest.approx(1 / factor, rel=0.75)
    assert _share(enlarged) < 0.8


def test_compression_and_a_flat_image_are_no_missing_detail() -> None:
    _, coded = cv2.imencode(".jpg", _texture(256), [cv2.IMWRITE_JPEG_QUALITY, 60])
    assert _share(np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), dtype=np.uint8)) == 1.0
    assert _share(blank_image(200, 200)) == 1.0
    with open_raster(blank_image(40, 40)) as raster:
        assert resolved_share(raster, np.array([[20.0, 20.0]])) == 1.0
    with open_raster(_texture(128)) as raster:
        assert resolved_share(raster, np.zeros((0, 2))) == 1.0


def test_detail_is_looked_for_in_the_copy_in_which_the_vehicles_were_found() -> None:
    original = _texture(256)
    enlarged = cv2.resize(original, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)
    centres = np.random.default_rng(0).uniform(100, 900, (20, 2))
    with open_raster(np.asarray(enlarged, dtype=np.uint8)) as raster:
        assert resolved_share(raster, centres, 1.0) < 0.5
        assert resolved_share(raster, centres, 0.25) == 1.0


@pytest.mark.parametrize(("resolved", "guarded"), [(1.0, False), (0.6, False), (0.4, True)])
def test_vehicles_without_the_detail_of_their_pixels_are_guarded(
    searching: Detector, resolved: float, guarded: bool
) -> None:
    lengths = np.array(_fleet(30.0, 40))
    boxes = np.column_stack([np.arange(40) * 99, lengths * 0, lengths, lengths / 2, lengths * 0])
    e = analyse_found(
        Detections(boxes, np.full(40, 0.9)),
        searching.card,
        ScaleOptions(),
        image_width_px=4000,
        image_height_px=40,
        resolved=resolved,
    ).estimate  # the guard asks for 16.8 px
    assert e.resolution_guard is guarded
    assert [w.code for w in e.warnings] == (["detail_missing"] if guarded else [])
    assert e.confidence == (0.3 if guarded else pytest.approx(0.95, abs=0.03))


# --- The bundled model -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def close_view() -> Scene:
    """Cars of about 115 px, twice what the bundled model was trained on."""
    return render_scene(0.04, width_px=1500, height_px=1500, seed=11, layout="parking", mean_vehicle_length_m=4.6)


@pytest.mark.slow
def test_cars_longer_than_any_in_training_give_the_scale(bundled: Detector, close_view: Scene) -> None:
    e = estimate_gsd(close_view.image, detector=bundled, search_scales=True, reference_length_m=4.6)
    assert e.gsd_m_per_px == pytest.approx(0.04, rel=0.10)
    assert e.working_scale in (0.25, 0.5)
    assert e.confidence >= 0.5
    alone = estimate_gsd(close_view.image, detector=bundled, search_scales=False, reference_length_m=4.6)
    assert alone.confidence < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("yard", YARDS)
@pytest.mark.parametrize("length_px", [30, 60, 120])
def test_a_yard_of_things_shaped_like_cars_is_never_a_confident_scale(
    bundled: Detector, yard: Yard, length_px: int
) -> None:
    image = paint_yard(yard, YARDS[yard][0] / length_px, max(500, 8 * length_px), seed=1)
    e = estimate_gsd(image, detector=bundled, search_scales=True)
    assert e.confidence < 0.5, e


@pytest.mark.data
def test_searching_photographs_without_vehicles_finds_next_to_nothing(real_data: Path, bundled: Detector) -> None:
    images = [i for i in read_table(real_data / "gsd" / "table.csv") if i.set == "empty" and i.split == "val"]
    assert len(images) == 30
    estimates = [estimate_gsd(image.path, detector=bundled, search_scales=True) for image in images]
    assert sum(e.n_detections > 0 for e in estimates) <= 4
    assert all(e.confidence < 0.5 for e in estimates)


@pytest.mark.data
@pytest.mark.parametrize("way", [cv2.INTER_LINEAR, cv2.INTER_CUBIC, cv2.INTER_LANCZOS4])
def test_photographs_too_coarse_to_measure_are_not_trusted_after_enlarging(
    real_data: Path, bundled: Detector, way: int
) -> None:
    rows = [i for i in read_table(real_data / "gsd" / "table.csv") if i.set == "ucm" and i.split == "val"]
    densest = sorted(rows, key=lambda image: -(image.labelled_vehicles or 0))[:8]
    for image in densest:
        photograph = cv2.imread(str(image.path))
        assert photograph is not None
        coarse = cv2.resize(photograph, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)  # 0.61 m/px
        enlarged = cv2.resize(coarse, None, fx=4, fy=4, interpolation=way)
        e = estimate_gsd(np.ascontiguousarray(enlarged[:, :, ::-1]), detector=bundled, search_scales=True)
        assert e.confidence < 0.5
