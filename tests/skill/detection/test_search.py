"""The search of an image: tiles, reduced copies, and what is merged from them."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.models import assert_same_boxes, blank_image, paint_vehicles, write_detector
from vehanchor import analyse_scale, estimate_gsd
from vehanchor.detection.detector import Detector
from vehanchor.detection.levels import MIN_LEVEL_SIDE_PX, level_shares, search_levels
from vehanchor.detection.scene_scale import SceneScalePrior
from vehanchor.detection.scheduler import TileScheduler
from vehanchor.detection.search import ImageSearch
from vehanchor.detection.tile_prior import tile_prior_map
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.tiles import tile_grid
from vehanchor.models.runtime import Runtime
from vehanchor.options import Effort, ScaleOptions, Search
from vehanchor.scale.defaults import CAR_LENGTH_M
from vehanchor.scale.density import GRID, flat, lognormal

_RANGE = {"vehanchor.length_range_px": "9,64"}
_SEARCHING = _RANGE | {"vehanchor.search_scales": "1"}


def _painted(
    factor: int, lengths: list[float], columns: int = 6, **kinds: Any
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A picture in which vehicles can be read in the copy reduced by ``factor`` alone, and their boxes.

    Each pixel of a painted picture becomes a block: reduced by as much, the beacons are whole
    again. In the full picture what stands beside a mark is the mark itself, which spells a vehicle
    of 255 px: too long to count.
    """
    small = blank_image(60 + 70 * columns, 60 + 60 * -(-len(lengths) // columns))
    boxes = [
        [40 + 70 * (k % columns), 50 + 60 * (k // columns), size, 12, 0.4]
        for k, size in enumerate(lengths)
    ]
    found = paint_vehicles(small, boxes, **kinds)
    found[:, :4] *= factor
    return np.kron(small, np.ones((factor, factor, 1), np.uint8)), found


def _fleet(mean: float, n: int = 30) -> list[float]:
    """Lengths as a fleet has them: normal, spread by 7 %."""
    return [mean * (1 + 0.07 * NormalDist().inv_cdf((k + 0.5) / n)) for k in range(n)]


# --- Levels
#
# ----------------------------------------------------------------------------------------------------------


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
    assert any(level.accepts(np.array([length / level.factor])).all() for level in levels)
    for fine, coarse in pairwise(levels):
        assert coarse.factor == 2 * fine.factor
        assert min(coarse.width_px, coarse.height_px) >= MIN_LEVEL_SIDE_PX
        assert coarse.shortest_px * coarse.factor < 0.81 * fine.longest_px * fine.factor


# --- The search
#
# ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("factor", "mean"), [(1, 30.0), (4, 45.0)])
def test_vehicles_are_found_at_the_level_that_fits_them_in_pixels_of_the_image(
    searching: Detector, factor: int, mean: float
) -> None:
    image, painted = _painted(factor, _fleet(mean, 12), columns=4)
    analysis = analyse_scale(image, ScaleOptions.of({"rulers": ("vehicles",)}), detector=searching)
    found = analysis.detections
    e = analysis.estimate
    order = np.lexsort((found.boxes[:, 0], np.rint(found.boxes[:, 1] / 10 / factor)))
    np.testing.assert_allclose(found.boxes[order], painted, atol=0.02 * factor)
    assert found.reductions is not None
    assert set(found.reductions) == {1 / factor}
    assert e.details.working_scale == 1 / factor
    assert e.mode_length_px == pytest.approx(mean * factor, rel=0.015)
    assert e.status == "ok"
    assert e.warnings == ()


def test_the_search_is_the_models_choice_and_the_callers(
    tmp_path: Path, searching: Detector
) -> None:
    image, painted = _painted(2, _fleet(45.0, 12), columns=4)
    plain = Detector(write_detector(tmp_path / "plain.onnx", metadata=_RANGE))
    found = {
        (name, wanted): estimate_gsd(
            image, detector=detector, search_scales=wanted, rulers=("vehicles",)
        )
        for name, detector in (("plain", plain), ("searching", searching))
        for wanted in (None, False, True)
    }
    with_cars = {
        key for key, e in found.items() if e.mode_length_px == pytest.approx(90, rel=0.015)
    }
    assert with_cars == {("plain", True), ("searching", None), ("searching", True)}
    assert {e.details.working_scale for key, e in found.items() if key in with_cars} == {0.5}
    assert estimate_gsd(blank_image(500, 500), detector=searching).details.working_scale is None
    assert len(painted) == 12


def test_progress_counts_the_tiles_of_all_levels_and_may_stop_in_any(searching: Detector) -> None:
    image = blank_image(1100, 900)
    seen: list[tuple[int, int]] = []
    with open_raster(image) as raster:
        found = ImageSearch(
            raster,
            searching.under(Runtime(progress=lambda done, total: seen.append((done, total)))),
        ).searched()
    assert found.n_tiles == 2 + 1 + 1 + 1
    assert seen == [(k, 5) for k in range(6)]

    def stop(done: int, total: int) -> None:
        if done == 3:
            raise TimeoutError

    with open_raster(image) as raster, pytest.raises(TimeoutError):
        ImageSearch(raster, searching.under(Runtime(progress=stop))).searched()


def _ground(gsd: float) -> SceneScalePrior:
    """A ground that is nearly sure of a scale."""
    return SceneScalePrior(0.98 * lognormal(gsd, 0.1) + 0.02 * flat(), 1)


@pytest.mark.parametrize(
    ("gsd", "n_painted", "effort", "tiles"),
    [
        (0.15, 8, "auto", {1}),  # cars of 31 px: at full resolution and nowhere else
        (0.15, 8, "full", {1, 2, 4, 8}),
        (0.15, 3, "auto", {1, 2, 4, 8}),  # too few to rely on the ground
        (0.05, 8, "auto", {1, 2, 4, 8}),  # the painted cars are not where the ground expects them
        (None, 8, "auto", {1, 2, 4, 8}),
    ],
)
def test_resolutions_at_which_no_car_can_be_are_left_out_once_there_are_cars_elsewhere(
    searching: Detector, gsd: float | None, n_painted: int, effort: Effort, tiles: set[int]
) -> None:
    image = blank_image(1000, 900)
    painted = paint_vehicles(image, [[80 + 100 * k, 450, 31, 13, 0.4] for k in range(n_painted)])
    seen: list[tuple[int, int]] = []
    with open_raster(image) as raster:
        ground = None if gsd is None else _ground(gsd)
        told = searching.under(Runtime(progress=lambda *each: seen.append(each)))
        found = ImageSearch(raster, told, Search(effort=effort), prior=ground).searched()
    assert found.n_tiles == len(tiles)
    assert found.n_tiles_total == 4
    assert found.stopped_because == ("all_searched" if len(tiles) == 4 else "converged")
    assert len(found.boxes) == len(painted)
    assert seen == [(k, 4) for k in [*range(len(tiles)), 4]]


@pytest.mark.parametrize(
    ("length_px", "large_px", "left_out"),
    # full resolution accepts up to 64
    [(55.0, 3_000_000, True), (62.0, 3_000_000, False), (55.0, 2_000_000, False)],
)
def test_a_coarser_resolution_is_left_out_once_a_finer_one_shows_all_cars_of_a_photograph(
    searching: Detector,
    monkeypatch: pytest.MonkeyPatch,
    length_px: float,
    large_px: int,
    left_out: bool,
) -> None:
    monkeypatch.setattr("vehanchor.detection.scheduler.ANYTIME_PIXELS", 1_000_000)
    monkeypatch.setattr("vehanchor.detection.search.LARGE_PIXELS", large_px)
    image = blank_image(1600, 1400)
    paint_vehicles(image, [[100 + 130 * k, 120 + 125 * k, length_px, 20, 0.4] for k in range(10)])
    gsd = CAR_LENGTH_M / length_px
    narrow = np.exp(-0.5 * ((GRID - np.log(gsd)) / 0.03) ** 2)
    tiles = {
        level.factor: len(tile_grid(level.width_px, level.height_px, tile_px=256, stride_px=205))
        for level in search_levels(1600, 1400, (9, 64), search_scales=True)
    }
    with open_raster(image) as raster:
        work = ImageSearch(
            raster, searching, options=Search(tile_px=256, stride_px=205), prior=_ground(gsd)
        )
        for _ in work:
            work.leave_out(narrow / narrow.sum())
        found = work.result()
    assert len(found.boxes) == 10
    assert (found.n_tiles < tiles[1] + tiles[2] / 2) == left_out
    assert tiles[1] <= found.n_tiles <= tiles[1] + tiles[2]


# --- Searches that end early
# -----------------------------------------------------------------------------------------


def test_the_order_of_the_visits_does_not_show_in_what_was_found(searching: Detector) -> None:
    image, painted = _painted(2, _fleet(45.0, 42), columns=7)
    with open_raster(image) as raster:
        full = ImageSearch(
            raster, searching, Search(tile_px=160, stride_px=96, effort="full")
        ).searched()
        ordered = ImageSearch(
            raster, searching, Search(tile_px=160, stride_px=96, max_tiles=10_000)
        ).searched()
    # each once, none cut
    np.testing.assert_allclose(np.sort(full.boxes[:, 2]), np.sort(painted[:, 2]), atol=0.02)
    assert full.boxes.tobytes() == ordered.boxes.tobytes()
    assert full.scores.tobytes() == ordered.scores.tobytes()
    assert (ordered.n_tiles, ordered.stopped_because) == (full.n_tiles, "all_searched")


def test_a_search_ends_at_the_limit_of_tiles_or_seconds_and_says_so(searching: Detector) -> None:
    image, _ = _painted(2, _fleet(45.0, 42), columns=7)
    small: dict[str, Any] = {"tile_px": 160, "stride_px": 96}
    with open_raster(image) as raster:
        twice = [
            ImageSearch(raster, searching, Search(**small, max_tiles=12)).searched()
            for _ in range(2)
        ]
        hurried = ImageSearch(raster, searching, Search(**small, max_seconds=1e-9)).searched()
    first, second = twice
    assert first.boxes.tobytes() == second.boxes.tobytes()
    assert 0 < len(first.boxes) < 42
    assert first.n_tiles_total is not None
    assert (first.n_tiles, first.stopped_because) == (12, "max_tiles")
    assert first.n_tiles_total > 30
    assert (hurried.n_tiles, hurried.stopped_because) == (1, "max_seconds")


# --- Tiles
#
# -----------------------------------------------------------------------------------------------------------


def _street(
    width: int, height: int, seed: int = 0
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    rng = np.random.default_rng(seed)
    image = blank_image(width, height)
    grid = np.stack(
        np.meshgrid(np.arange(40, width - 40, 60), np.arange(40, height - 40, 60)), axis=-1
    ).reshape(-1, 2)
    n = len(grid)
    boxes = np.column_stack(
        [
            grid + rng.uniform(-5, 5, grid.shape),
            rng.normal(30, 2, n),
            rng.normal(12, 0.5, n),
            rng.uniform(0, np.pi, n),
        ]
    )
    return image, paint_vehicles(image, boxes)


@pytest.mark.parametrize(("width", "height", "tile"), [(513, 300, 256), (300, 900, 320)])
def test_tiles_find_each_vehicle_once_in_image_coordinates(
    tmp_path: Path, width: int, height: int, tile: int
) -> None:
    image, painted = _street(width, height)
    detector = Detector(write_detector(tmp_path / "m.onnx"))
    with open_raster(image) as raster:
        found = ImageSearch(raster, detector, Search(tile_px=tile)).searched()
    assert_same_boxes(found.boxes, painted)
    assert found.n_tiles > 1


def test_a_model_of_fixed_size_sets_the_tile_and_pads_small_images(tmp_path: Path) -> None:
    image, painted = _street(400, 200)
    detector = Detector(write_detector(tmp_path / "m.onnx", fixed_size=320))
    with open_raster(image) as raster:
        assert_same_boxes(ImageSearch(raster, detector).searched().boxes, painted)
        with pytest.raises(InvalidParameterError, match="fixed"):
            ImageSearch(raster, detector, Search(tile_px=1024)).searched()


# --- Other objects
#
# ---------------------------------------------------------------------------------------------------

_KINDS = {0: "small vehicle", 1: "ship", 2: "tennis court"}


def test_objects_of_other_classes_are_kept_beside_the_vehicles_with_their_class(
    tmp_path: Path,
) -> None:
    image = blank_image(700, 300)
    kinds = [0, 1, 2, 0, 1, 2]
    painted = paint_vehicles(
        image,
        [[60 + 110 * k, 100, 30, 12, 0.3 * k] for k in range(6)],
        scores=[0.9, 0.5, 0.7, 0.8, 0.6, 0.4],
        classes=kinds,
    )
    detector = Detector(write_detector(tmp_path / "m.onnx", names=_KINDS))
    with open_raster(image) as raster:
        for options in (Search(), Search(tile_px=256)):
            found = ImageSearch(raster, detector, options).searched()
            assert_same_boxes(found.boxes, painted[[0, 3]])
            assert_same_boxes(found.others.boxes, painted[[1, 2, 4, 5]])
            # best first
            np.testing.assert_allclose(found.others.scores, [0.7, 0.6, 0.5, 0.4], atol=1 / 255)
            assert found.others.classes.tolist() == [2, 1, 1, 2]
        ships = ImageSearch(
            raster, Detector(detector.path, classes=["ship", "small vehicle"])
        ).searched()
    assert len(ships.boxes) == 4
    assert set(ships.others.classes.tolist()) == {2}


@settings(max_examples=25)
@given(st.integers(16, 500), st.integers(1, 9), st.randoms(use_true_random=False))
def test_every_tile_is_taken_once_whatever_the_others_showed(
    side: int, at_once: int, random: object
) -> None:
    places = [
        (factor, tile)
        for factor in (1, 2, 4)
        for tile in tile_grid(side // factor, side // factor, tile_px=64, stride_px=48)
    ]
    rng = np.random.default_rng(random.randrange(1000))  # type: ignore[attr-defined]
    order = TileScheduler(
        places,
        rng.random(len(places)),
        level_shares({1: (9, 64), 2: (25, 64), 4: (25, np.inf)}, None),
    )
    taken: list[int] = []
    while batch := order.next_tiles(at_once):
        assert len(batch) <= at_once
        taken += batch
        for tile in batch:
            order.report(tile, int(rng.integers(0, 9)))
    assert sorted(taken) == list(range(len(places)))


def test_a_town_promises_more_than_fields_in_every_cell_of_it() -> None:
    image = blank_image(3000, 1100)
    image[:] += np.random.default_rng(0).integers(0, 5, (*image.shape[:2], 1), dtype=np.uint8)
    for x, y, grey in np.random.default_rng(1).integers((1024, 0, 0), (2016, 992, 255), (900, 3)):
        image[y : y + 24, x : x + 32] = grey  # roofs
    with open_raster(image) as raster:
        cells = tile_prior_map(raster)
    assert cells.shape == (3, 6)
    assert cells[:2, 2:4].min() > cells[:, [0, 1, 4, 5]].max() + 0.2
    assert ((cells >= 0) & (cells <= 1)).all()
