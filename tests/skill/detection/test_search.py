"""The search of an image: tiles, reduced copies, and what is merged from them."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from statistics import NormalDist
from typing import Any, TypeAlias

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tests.models import assert_same_boxes, blank_image, paint_vehicles, write_detector
from vehanchor import analyse_scale, estimate_gsd
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.detection.detections import Detections
from vehanchor.detection.detector import Detector
from vehanchor.detection.detector_errors import TilePriorOdds
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

Painted: TypeAlias = tuple[NDArray[np.uint8], NDArray[np.float64]]
"""A picture, and the boxes of its vehicles."""

_RANGE = {"vehanchor.length_range_px": "9,64"}
_SEARCHING = _RANGE | {"vehanchor.search_scales": "1"}


def _painted(factor: int, lengths: list[float], columns: int = 6, **kinds: Any) -> Painted:
    """Paint vehicles that can be read only in the copy reduced by ``factor``; return their boxes.

    Each pixel of a painted picture becomes a block: reduced by as much, the beacons are whole
    again. In the full picture, the pixels beside a mark are the mark itself, which spells a vehicle
    of 255 px: too long to count.
    """
    rows = -(-len(lengths) // columns)
    small = blank_image(60 + 70 * columns, 60 + 60 * rows)
    boxes = []
    for k, length in enumerate(lengths):
        row, column = divmod(k, columns)
        boxes.append([40 + 70 * column, 50 + 60 * row, length, 12, 0.4])
    bare = small.copy()
    painted = paint_vehicles(small, boxes, **kinds)
    painted[:, :4] *= factor
    block = np.ones((factor, factor, 1), np.uint8)
    image = np.kron(small, block)
    # The ground has a photograph's noise in its own resolution.
    is_ground = np.kron((small == bare).all(axis=2, keepdims=True), block) == 1
    noisy = blank_image(image.shape[1], image.shape[0])
    return np.where(is_ground, noisy, image), painted


def _fleet(mean: float, n: int = 30) -> list[float]:
    """Lengths of a fleet: normal, spread by 7 %."""
    quantiles = [NormalDist().inv_cdf((k + 0.5) / n) for k in range(n)]
    return [mean * (1 + 0.07 * quantile) for quantile in quantiles]


def _searched(
    image: NDArray[np.uint8],
    detector: Detector,
    options: Search | None = None,
    prior: SceneScalePrior | None = None,
) -> Detections:
    with open_raster(image) as raster:
        return ImageSearch(raster, detector, options, prior=prior).searched()


# --- Levels


@given(
    st.integers(16, 9000),
    st.integers(16, 9000),
    st.tuples(st.floats(5, 20), st.floats(40, 200)),
    st.floats(1, 1600),
)
def test_every_length_is_accepted_at_some_level(
    width: int, height: int, length_range: tuple[float, float], length: float
) -> None:
    levels = search_levels(width, height, length_range, search_scales=True)
    assert levels[0].factor == 1
    assert any(level.accepts(np.array([length / level.factor])).all() for level in levels)


@given(
    st.integers(16, 9000),
    st.integers(16, 9000),
    st.tuples(st.floats(5, 20), st.floats(40, 200)),
)
def test_neighbouring_levels_overlap(
    width: int, height: int, length_range: tuple[float, float]
) -> None:
    levels = search_levels(width, height, length_range, search_scales=True)
    for fine, coarse in pairwise(levels):
        assert coarse.factor == 2 * fine.factor
        assert min(coarse.width_px, coarse.height_px) >= MIN_LEVEL_SIDE_PX
        assert coarse.shortest_px * coarse.factor < 0.81 * fine.longest_px * fine.factor


# --- The search


@pytest.fixture(params=[(1, 30.0), (4, 45.0)], ids=["full resolution", "a quarter"])
def at_one_level(
    request: pytest.FixtureRequest, searching: Detector
) -> tuple[int, float, NDArray[np.float64], ScaleAnalysis]:
    """Factor, mean length, painted boxes and analysis of a fleet that one level shows."""
    factor, mean = request.param
    image, painted = _painted(factor, _fleet(mean, 12), columns=4)
    options = ScaleOptions.of({"rulers": ("vehicles",)})
    return factor, mean, painted, analyse_scale(image, options, detector=searching)


def test_boxes_are_in_pixels_of_the_image(
    at_one_level: tuple[int, float, NDArray[np.float64], ScaleAnalysis],
) -> None:
    factor, _, painted, analysis = at_one_level
    boxes = analysis.detections.boxes
    rows = np.rint(boxes[:, 1] / 10 / factor)
    order = np.lexsort((boxes[:, 0], rows))
    np.testing.assert_allclose(boxes[order], painted, atol=0.02 * factor)


def test_vehicles_are_found_at_the_level_that_fits_them(
    at_one_level: tuple[int, float, NDArray[np.float64], ScaleAnalysis],
) -> None:
    factor, _, _, analysis = at_one_level
    assert analysis.detections.reductions is not None
    assert set(analysis.detections.reductions) == {1 / factor}
    assert analysis.estimate.details.working_scale == 1 / factor


def test_a_scale_comes_from_any_level(
    at_one_level: tuple[int, float, NDArray[np.float64], ScaleAnalysis],
) -> None:
    factor, mean, _, analysis = at_one_level
    estimate = analysis.estimate
    assert estimate.mode_length_px == pytest.approx(mean * factor, rel=0.015)
    assert estimate.status == "ok"
    assert estimate.warnings == ()


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    """A detector that by itself searches full resolution only."""
    path = tmp_path_factory.mktemp("model") / "plain.onnx"
    return Detector(write_detector(path, metadata=_RANGE))


@pytest.mark.parametrize("search_scales", [None, False, True])
@pytest.mark.parametrize("own_choice", [False, True])
def test_levels_are_searched_if_the_caller_or_else_the_model_wants_it(
    plain: Detector, searching: Detector, own_choice: bool, search_scales: bool | None
) -> None:
    image, painted = _painted(2, _fleet(45.0, 12), columns=4)
    assert len(painted) == 12
    estimate = estimate_gsd(
        image,
        detector=searching if own_choice else plain,
        search_scales=search_scales,
        rulers=("vehicles",),
    )
    are_searched = own_choice if search_scales is None else search_scales
    has_cars = estimate.mode_length_px == pytest.approx(90, rel=0.015)
    assert has_cars == are_searched
    if has_cars:
        assert estimate.details.working_scale == 0.5


def test_an_image_without_vehicles_has_no_working_scale(searching: Detector) -> None:
    estimate = estimate_gsd(blank_image(500, 500), detector=searching)
    assert estimate.details.working_scale is None


def test_progress_counts_the_tiles_of_all_levels(searching: Detector) -> None:
    calls: list[tuple[int, int]] = []
    runtime = Runtime(progress=lambda done, total: calls.append((done, total)))
    detections = _searched(blank_image(1100, 900), searching.under(runtime))
    assert detections.n_tiles == 2 + 1 + 1 + 1
    assert calls == [(k, 5) for k in range(6)]


def test_progress_may_stop_the_search_at_any_level(searching: Detector) -> None:
    def stop(done: int, total: int) -> None:
        if done == 3:
            raise TimeoutError

    with pytest.raises(TimeoutError):
        _searched(blank_image(1100, 900), searching.under(Runtime(progress=stop)))


def _nearly_certain_prior(gsd: float) -> SceneScalePrior:
    return SceneScalePrior(0.98 * lognormal(gsd, 0.1) + 0.02 * flat(), 1)


@pytest.mark.parametrize(
    ("gsd", "n_painted", "effort", "n_tiles"),
    [
        # Cars of 31 px are at full resolution and nowhere else.
        (0.15, 8, "auto", 1),
        (0.15, 8, "full", 4),
        # There are too few cars to rely on the prior.
        (0.15, 3, "auto", 4),
        # The painted cars are not at the level where the prior expects them.
        (0.05, 8, "auto", 4),
        (None, 8, "auto", 4),
    ],
)
def test_levels_without_cars_are_left_out_if_others_show_enough(
    searching: Detector, gsd: float | None, n_painted: int, effort: Effort, n_tiles: int
) -> None:
    image = blank_image(1000, 900)
    painted = paint_vehicles(image, [[80 + 100 * k, 450, 31, 13, 0.4] for k in range(n_painted)])
    prior = None if gsd is None else _nearly_certain_prior(gsd)
    calls: list[tuple[int, int]] = []
    runtime = Runtime(progress=lambda done, total: calls.append((done, total)))
    detections = _searched(image, searching.under(runtime), Search(effort=effort), prior)
    assert detections.n_tiles == n_tiles
    assert detections.n_tiles_total == 4
    assert detections.stopped_because == ("all_searched" if n_tiles == 4 else "converged")
    assert len(detections.boxes) == len(painted)
    assert calls == [(k, 4) for k in [*range(n_tiles), 4]]


@pytest.mark.parametrize(
    ("length_px", "large_px", "left_out"),
    # Full resolution accepts up to 64 px.
    [(55.0, 3_000_000, True), (62.0, 3_000_000, False), (55.0, 2_000_000, False)],
)
def test_a_level_is_left_out_if_a_finer_one_shows_all_cars_of_a_photograph(
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
    density = np.exp(-0.5 * ((GRID - np.log(gsd)) / 0.03) ** 2)
    density /= density.sum()
    n_tiles = {}
    for level in search_levels(1600, 1400, (9, 64), search_scales=True):
        windows = tile_grid(level.width_px, level.height_px, tile_px=256, stride_px=205)
        n_tiles[level.factor] = len(windows)
    with open_raster(image) as raster:
        options = Search(tile_px=256, stride_px=205)
        search = ImageSearch(raster, searching, options, prior=_nearly_certain_prior(gsd))
        for _ in search:
            search.leave_out(density)
        detections = search.result()
    assert len(detections.boxes) == 10
    assert (detections.n_tiles < n_tiles[1] + n_tiles[2] / 2) == left_out
    assert n_tiles[1] <= detections.n_tiles <= n_tiles[1] + n_tiles[2]


# --- Searches that end early


_SMALL_TILES: dict[str, Any] = {"tile_px": 160, "stride_px": 96}


@pytest.fixture(scope="module")
def town() -> Painted:
    """A picture of 42 vehicles for searches with small tiles, and their boxes."""
    return _painted(2, _fleet(45.0, 42), columns=7)


def test_the_result_does_not_depend_on_the_order_of_the_visits(
    searching: Detector, town: Painted
) -> None:
    image, painted = town
    full = _searched(image, searching, Search(**_SMALL_TILES, effort="full"))
    ordered = _searched(image, searching, Search(**_SMALL_TILES, max_tiles=10_000))
    # Each vehicle is found once, and none is cut.
    np.testing.assert_allclose(np.sort(full.boxes[:, 2]), np.sort(painted[:, 2]), atol=0.02)
    assert full.boxes.tobytes() == ordered.boxes.tobytes()
    assert full.scores.tobytes() == ordered.scores.tobytes()
    assert (ordered.n_tiles, ordered.stopped_because) == (full.n_tiles, "all_searched")


def test_a_search_ends_at_the_limit_of_tiles(searching: Detector, town: Painted) -> None:
    detections = _searched(town[0], searching, Search(**_SMALL_TILES, max_tiles=12))
    assert 0 < len(detections.boxes) < 42
    assert (detections.n_tiles, detections.stopped_because) == (12, "max_tiles")
    assert detections.n_tiles_total is not None
    assert detections.n_tiles_total > 30


def test_a_search_at_the_limit_of_tiles_has_not_converged(
    searching: Detector, town: Painted
) -> None:
    # The prior excludes the full resolution, and the other levels have more tiles than the limit.
    prior = _nearly_certain_prior(CAR_LENGTH_M / 90)
    options = Search(**_SMALL_TILES, max_tiles=12)
    detections = _searched(town[0], searching, options, prior)
    assert len(detections.boxes) >= 5
    assert (detections.n_tiles, detections.stopped_because) == (12, "max_tiles")


def test_a_limited_search_is_deterministic(searching: Detector, town: Painted) -> None:
    first, second = (
        _searched(town[0], searching, Search(**_SMALL_TILES, max_tiles=12)) for _ in range(2)
    )
    assert first.boxes.tobytes() == second.boxes.tobytes()


def test_a_search_ends_at_the_limit_of_seconds(searching: Detector, town: Painted) -> None:
    detections = _searched(town[0], searching, Search(**_SMALL_TILES, max_seconds=1e-9))
    assert (detections.n_tiles, detections.stopped_because) == (1, "max_seconds")


# --- Tiles


def _street(width: int, height: int, seed: int = 0) -> Painted:
    """A picture full of vehicles in all directions, and their boxes."""
    rng = np.random.default_rng(seed)
    image = blank_image(width, height)
    columns, rows = np.meshgrid(np.arange(40, width - 40, 60), np.arange(40, height - 40, 60))
    grid = np.stack([columns, rows], axis=-1).reshape(-1, 2)
    n = len(grid)
    centres = grid + rng.uniform(-5, 5, grid.shape)
    lengths = rng.normal(30, 2, n)
    widths = rng.normal(12, 0.5, n)
    angles = rng.uniform(0, np.pi, n)
    return image, paint_vehicles(image, np.column_stack([centres, lengths, widths, angles]))


@pytest.mark.parametrize(("width", "height", "tile"), [(513, 300, 256), (300, 900, 320)])
def test_tiles_find_each_vehicle_once_in_image_coordinates(
    tmp_path: Path, width: int, height: int, tile: int
) -> None:
    image, painted = _street(width, height)
    detector = Detector(write_detector(tmp_path / "m.onnx"))
    detections = _searched(image, detector, Search(tile_px=tile))
    assert_same_boxes(detections.boxes, painted)
    assert detections.n_tiles > 1


@pytest.fixture
def of_fixed_size(tmp_path: Path) -> Detector:
    return Detector(write_detector(tmp_path / "m.onnx", fixed_size=320))


def test_a_model_of_fixed_size_pads_small_images(of_fixed_size: Detector) -> None:
    image, painted = _street(400, 200)
    assert_same_boxes(_searched(image, of_fixed_size).boxes, painted)


def test_a_tile_beyond_a_fixed_size_is_refused(of_fixed_size: Detector) -> None:
    with pytest.raises(InvalidParameterError, match="fixed"):
        _searched(blank_image(400, 200), of_fixed_size, Search(tile_px=1024))


# --- Other objects

_KINDS = {0: "small vehicle", 1: "ship", 2: "tennis court"}


@pytest.fixture
def harbour() -> Painted:
    """A picture with two objects of each of three kinds, and their boxes."""
    image = blank_image(700, 300)
    painted = paint_vehicles(
        image,
        [[60 + 110 * k, 100, 30, 12, 0.3 * k] for k in range(6)],
        scores=[0.9, 0.5, 0.7, 0.8, 0.6, 0.4],
        classes=[0, 1, 2, 0, 1, 2],
    )
    return image, painted


@pytest.mark.parametrize("options", [Search(), Search(tile_px=256)], ids=["one tile", "tiles"])
def test_objects_of_other_classes_are_kept_beside_the_vehicles(
    tmp_path: Path, harbour: Painted, options: Search
) -> None:
    image, painted = harbour
    detector = Detector(write_detector(tmp_path / "m.onnx", names=_KINDS))
    detections = _searched(image, detector, options)
    assert_same_boxes(detections.boxes, painted[[0, 3]])
    assert_same_boxes(detections.others.boxes, painted[[1, 2, 4, 5]])
    # The best come first.
    np.testing.assert_allclose(detections.others.scores, [0.7, 0.6, 0.5, 0.4], atol=1 / 255)
    assert detections.others.classes.tolist() == [2, 1, 1, 2]


def test_the_caller_chooses_which_classes_are_others(tmp_path: Path, harbour: Painted) -> None:
    path = write_detector(tmp_path / "m.onnx", names=_KINDS)
    detector = Detector(path, classes=["ship", "small vehicle"])
    detections = _searched(harbour[0], detector)
    assert len(detections.boxes) == 4
    assert set(detections.others.classes.tolist()) == {2}


# --- Order of the visits


@settings(max_examples=25)
@given(st.integers(16, 500), st.integers(1, 9), st.integers(0, 999))
def test_every_tile_is_taken_once_whatever_the_others_showed(
    side: int, at_once: int, seed: int
) -> None:
    tiles = [
        (factor, window)
        for factor in (1, 2, 4)
        for window in tile_grid(side // factor, side // factor, tile_px=64, stride_px=48)
    ]
    rng = np.random.default_rng(seed)
    shares = level_shares({1: (9, 64), 2: (25, 64), 4: (25, np.inf)}, None)
    scheduler = TileScheduler(tiles, rng.random(len(tiles)), shares)
    taken: list[int] = []
    while batch := scheduler.next_tiles(at_once):
        assert len(batch) <= at_once
        taken += batch
        for tile in batch:
            scheduler.report(tile, int(rng.integers(0, 9)))
    assert sorted(taken) == list(range(len(tiles)))


def test_every_cell_of_a_town_has_a_higher_tile_prior_than_fields() -> None:
    image = blank_image(3000, 1100)
    noise = np.random.default_rng(0).integers(0, 5, (1100, 3000, 1), dtype=np.uint8)
    image += noise
    roofs = np.random.default_rng(1).integers((1024, 0, 0), (2016, 992, 255), (900, 3))
    for x, y, grey in roofs:
        image[y : y + 24, x : x + 32] = grey
    with open_raster(image) as raster:
        cells = tile_prior_map(raster, TilePriorOdds())
    assert cells.shape == (3, 6)
    town = cells[:2, 2:4]
    fields = cells[:, [0, 1, 4, 5]]
    assert town.min() > fields.max() + 0.2
    assert cells.min() >= 0
    assert cells.max() <= 1
