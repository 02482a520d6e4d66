from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.transform import Affine
from rasterio.warp import transform
from typer.testing import CliRunner

from tests.analyses import analyse_found, made_card, make_analysis
from tests.models import blank_image, car_park, write_detector
from vehanchor import analyse_scale
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.cli.app import app
from vehanchor.detection.boxes import box_corners
from vehanchor.detection.detections import Detections
from vehanchor.detection.detector import Detector
from vehanchor.errors import OutputError
from vehanchor.export.geojson import PIXELS_WKT, check_geojson_path, write_shapes
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ScaleOptions
from vehanchor.pictures.marks import MARK_RGB, draw_marks
from vehanchor.pictures.placement import Placement
from vehanchor.pictures.plot import plot_scale, write_plot
from vehanchor.pictures.scale import (
    DROPPED_RGB,
    KEPT_RGB,
    MAX_SIDE_PX,
    MIN_WIDTH_PX,
    draw_overlay,
    read_reduced,
    write_picture,
)
from vehanchor.rulers.camera_tilt import CameraTilt
from vehanchor.scale.defaults import Aggregation
from vehanchor.scale.posterior import Mark


def _near(picture: NDArray[np.uint8], colour: tuple[int, int, int]) -> NDArray[np.bool_]:
    """Pixels of about a colour: the edges of lines are smoothed."""
    return np.asarray((np.abs(picture.astype(int) - np.array(colour)) < 30).all(axis=2))


def _count(picture: NDArray[np.uint8], colour: tuple[int, int, int]) -> int:
    return int(_near(picture, colour).sum())


_grey = partial(blank_image, level=100)


def _judged(analysis: ScaleAnalysis, status: str, reason: str | None) -> ScaleAnalysis:
    update = {"status": status, "reason": reason}
    return replace(analysis, estimate=analysis.estimate.model_copy(update=update))


def _fleet(n: int, length_px: float = 30.0) -> NDArray[np.float64]:
    return np.array(
        [[60.0 + 50 * (i % 10), 60.0 + 50 * (i // 10), length_px, 12.0, 0.4 * i] for i in range(n)]
    ).reshape(-1, 5)


def test_small_images_are_enlarged_and_large_ones_reduced() -> None:
    assert (
        draw_overlay(_grey(256, 200), make_analysis(_fleet(1), 256, 200)).shape[1] == MIN_WIDTH_PX
    )
    assert draw_overlay(_grey(1000, 800), make_analysis(_fleet(1), 1000, 800)).shape[1] == 1000
    assert (
        draw_overlay(_grey(4096, 3000), make_analysis(_fleet(1), 4096, 3000)).shape[1]
        == MAX_SIDE_PX
    )


def test_kept_and_dropped_vehicles_have_their_colours() -> None:
    boxes = _fleet(12)
    plain = draw_overlay(_grey(800, 600), make_analysis(boxes, 800, 600))[:600]
    assert _count(plain, KEPT_RGB) > 500
    assert _count(plain, DROPPED_RGB) == 0
    boxes[5, 2] = 90.0  # beyond 1.5 medians
    with_outlier = draw_overlay(_grey(800, 600), make_analysis(boxes, 800, 600))[:600]
    assert _count(with_outlier, DROPPED_RGB) > 100


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_boxes_lie_where_the_vehicles_are_at_any_enlargement(factor: float) -> None:
    size = round(1000 * factor)
    box = np.array([[300.5, 420.25, 160.0, 60.0, 0.0]]) * [factor, factor, factor, factor, 1.0]
    picture = draw_overlay(_grey(size, size), make_analysis(box, size, size))
    side = min(MAX_SIDE_PX, max(size, MIN_WIDTH_PX))
    ys, xs = np.nonzero(_near(picture[:side], KEPT_RGB))
    drawn = np.array([xs.min() + xs.max(), ys.min() + ys.max()]) / 2 + 0.5
    assert drawn == pytest.approx(np.array([300.5, 420.25]) * side / 1000, abs=1.0)
    assert xs.max() - xs.min() == pytest.approx(160 * side / 1000, abs=4)


@pytest.mark.parametrize("gsd", [0.02, 0.1, 0.1682, 0.29, 0.7])
def test_the_scale_bar_is_about_a_fifth_of_the_width_and_true(gsd: float) -> None:
    # a vehicle off the picture's lower left, where the bar is
    boxes = np.array([[900.0, 100.0, 5.045 / gsd, 2.0 / gsd, 0.0]])
    analysis = make_analysis(boxes, 1000, 700, reference_length_m=5.045)
    picture = draw_overlay(_grey(1000, 700), _judged(analysis, "ok", None))
    white = (picture[690 - 14 : 690, :600] >= 250).all(axis=2)
    bar_px = int(white.sum(axis=1).max())
    assert analysis.estimate.gsd_m_per_px is not None
    metres = (bar_px - 1) * analysis.estimate.gsd_m_per_px
    nearest = min(
        (m * 10.0**k for m in (1, 2, 5) for k in range(-2, 4)),
        key=lambda length: abs(length - metres),
    )
    assert metres == pytest.approx(nearest, abs=2 * gsd)
    assert 120 <= bar_px <= 330


def test_without_an_anchor_there_is_no_scale_bar() -> None:
    picture = draw_overlay(_grey(900, 700), make_analysis(np.zeros((0, 5)), 900, 700))
    assert (picture[:700] == 100).all()
    assert picture.shape[0] > 700  # and a caption says so


def test_the_image_itself_is_not_drawn_into_and_may_be_read_only() -> None:
    image = _grey(900, 700)
    image.flags.writeable = False
    picture = draw_overlay(image, make_analysis(_fleet(6), 900, 700))
    assert (image == 100).all()
    assert _count(picture, KEPT_RGB)


def test_a_reduced_copy_gives_the_boxes_the_same_places() -> None:
    analysis = make_analysis(_fleet(6, 60.0) * [8, 8, 4, 4, 1], 8000, 5000)
    whole = draw_overlay(_grey(8000, 5000), analysis)
    reduced = draw_overlay(_grey(4000, 2500), analysis)
    assert whole.shape == reduced.shape
    assert (whole == reduced).all()


@pytest.mark.parametrize("shape", [(300, 400), (5000, 4100), (20, 9001), (9001, 20), (4097, 16)])
def test_read_reduced_shows_the_whole_image(shape: tuple[int, int]) -> None:
    ramp = np.linspace(0, 255, shape[0] * shape[1]).reshape(shape).astype(np.uint8)
    with open_raster(ramp) as raster:
        reduced = read_reduced(raster)
    assert max(reduced.shape) <= 2 * MAX_SIDE_PX
    expected = cv2.resize(ramp, reduced.shape[1::-1], interpolation=cv2.INTER_AREA)
    assert float(np.abs(reduced[:, :, 0].astype(int) - expected).mean()) < 3.0
    assert reduced[-1, -1, 0] > reduced[0, 0, 0]


@pytest.mark.parametrize("name", ["a.png", "b.jpg", "c.JPEG", "übersicht 1.png"])
def test_pictures_are_written_as_rgb(tmp_path: Path, name: str) -> None:
    picture = np.zeros((40, 60, 3), np.uint8)
    picture[:, :, 0] = 200
    path = write_picture(tmp_path / name, picture)
    stored = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    assert stored is not None
    assert stored.shape == (40, 60, 3)
    assert abs(int(stored[20, 30, 2]) - 200) < 5
    assert stored[20, 30, 0] < 5


@pytest.mark.parametrize("name", ["a.gif", "a", "missing/a.png", "folder.png"])
def test_pictures_that_cannot_be_written_say_why(tmp_path: Path, name: str) -> None:
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(OutputError, match=r"cannot write"):
        write_picture(tmp_path / name, np.zeros((10, 10, 3), np.uint8))


def _analysed(boxes: NDArray[np.float64], **options: Any) -> ScaleAnalysis:
    found = Detections(boxes, np.full(len(boxes), 0.8))
    return analyse_found(
        found, made_card(), ScaleOptions.of(options), image_width_px=1000, image_height_px=800
    )


def test_a_line_of_known_length_is_drawn_where_it_lies_with_its_metres_beside_it() -> None:
    with_line = draw_overlay(
        _grey(1000, 800), _analysed(_fleet(4), known_lengths=[(200, 400, 700, 400, 84)])
    )
    without = draw_overlay(_grey(1000, 800), _analysed(_fleet(4)))
    green = _near(with_line[:800], MARK_RGB)
    assert not _near(without, MARK_RGB).any()
    rows, columns = np.nonzero(green)
    assert (columns.min(), columns.max()) == (pytest.approx(200, abs=4), pytest.approx(700, abs=4))
    assert np.median(rows) == pytest.approx(400, abs=2)
    letters = (with_line[:800] == 255).all(axis=2) & ~(without[:800] == 255).all(axis=2)
    assert letters[370:400, 450:540].sum() > 60  # "84 m", above and right of the middle


def test_a_label_stays_inside_the_picture_and_a_line_beside_its_edge_is_no_error() -> None:
    lines = [(990, 0, 1000, 6, 1), (0, 800, 9, 791, 1)]
    corner = draw_overlay(_grey(1000, 800), _analysed(_fleet(0), known_lengths=lines))
    assert corner.shape[1] == 1000
    draw_marks(
        np.zeros((20, 20, 3), np.uint8),
        [Mark(((-50.0, -50.0), (90.0, 4.0), (3.0, 99.0)), "m", True)],
        Placement(np.ones(2), np.zeros(2)),
    )


def test_a_picture_that_was_taken_aside_has_no_scale_bar() -> None:
    level = _judged(
        make_analysis(np.array([[900.0, 100.0, 50.0, 20.0, 0.0]]), 1000, 700), "ok", None
    )
    tilt = CameraTilt(35.0, 0.0, focal_length_px=800.0, source="metadata").record(
        ImageFacts(1000, 700), 0.1
    )
    aside = replace(level, estimate=level.estimate.model_copy(update={"tilt": tilt}))
    corner = (slice(600, 700), slice(0, 600))
    assert (draw_overlay(_grey(1000, 700), aside)[corner] == 100).all()
    assert (
        draw_overlay(_grey(1000, 700), aside).shape[0]
        > draw_overlay(_grey(1000, 700), level).shape[0]
    )


pytest.importorskip("matplotlib")


def _boxes(lengths: NDArray[np.float64] | list[float]) -> NDArray[np.float64]:
    return np.array([[50.0, 50.0, length, 10.0, 0.0] for length in lengths]).reshape(-1, 5)


def _labels(figure: object) -> str:
    legend = figure.legends[0]  # type: ignore[attr-defined]
    return "\n".join(text.get_text() for text in legend.get_texts())


def test_the_plot_shows_mode_guard_interval_and_both_kinds_of_vehicles() -> None:
    lengths = [*np.random.default_rng(0).normal(30, 2, 60), 80.0, 300.0]
    analysis = make_analysis(_boxes(lengths), 800, 600)
    figure = plot_scale(analysis)
    text = _labels(figure)
    mode = analysis.estimate.mode_length_px
    assert mode is not None
    assert f"{mode:.1f} px (KDE) = 5.04 m" in text or f"{mode:.1f} px (KDE) = 5.05 m" in text
    assert "resolution guard 16.8 px" in text
    assert "95 % interval" in text
    assert "60 vehicles kept" in text
    assert (
        "2 outliers dropped (1 beyond the axis)" in text
        or "2 outliers dropped (2 beyond the axis)" in text
    )
    left, right = figure.axes[0].get_xlim()
    # the guard is visible, one lorry does not squeeze the cars
    assert left < 5.045 / 0.3 < right < 120


@pytest.mark.parametrize(
    ("lengths", "aggregation", "rule"),
    [
        ([30.0], "kde", "median"),
        ([30.0, 31.0, 32.0], "weighted_kde", "median"),
        ([30.0] * 9, "kde", "KDE"),
        ([30.0, 31, 32, 33, 34, 35], "weighted_kde", "weighted KDE"),
        ([30.0, 31, 32, 33, 34, 35], "mean", "mean"),
        ([3.0, 3.01, 3.02, 3.0, 3.0, 3.1], "median", "median"),
        (list(np.linspace(900, 1000, 40)), "kde", "KDE"),
    ],
)
def test_every_aggregation_and_any_number_of_vehicles_can_be_drawn(
    tmp_path: Path, lengths: list[float], aggregation: Aggregation, rule: str
) -> None:
    figure = plot_scale(make_analysis(_boxes(lengths), 800, 600, aggregation=aggregation))
    assert f"({rule})" in _labels(figure)
    write_plot(tmp_path / "plot.png", figure)


def _beside_a_line(n: int, metres: float) -> ScaleAnalysis:
    boxes = _boxes(np.random.default_rng(1).normal(30, 2, n))
    return _analysed(boxes, known_lengths=[(0, 0, 500, 0, metres, "measured")])


@pytest.mark.parametrize("n", [0, 30])
def test_the_densities_of_all_rulers_and_of_all_together_share_one_axis(
    n: int, tmp_path: Path
) -> None:
    analysis = _beside_a_line(n, 84.0)
    figure = plot_scale(analysis)
    axes = figure.axes[-1] if n == 0 else figure.axes[1]
    legend = axes.get_legend()
    assert legend is not None
    names = [text.get_text().partition(" (")[0] for text in legend.get_texts()]
    assert names[-3:] == ["known length 0.168", "together 0.168", "95 % interval"]
    assert [name.split()[0] for name in names[:-3]] == ["vehicles"] * (n > 0)
    low, high = axes.get_xlim()
    estimate = analysis.estimate
    assert estimate.gsd_ci95_low_m_per_px is not None
    assert estimate.gsd_ci95_high_m_per_px is not None
    assert low < estimate.gsd_ci95_low_m_per_px < estimate.gsd_ci95_high_m_per_px < high
    together = next(
        line for line in axes.lines if str(line.get_label()).startswith("together 0.168")
    )
    at = np.asarray(together.get_xdata())
    curve = np.asarray(together.get_ydata())
    assert at[curve.argmax()] == pytest.approx(estimate.gsd_m_per_px, rel=0.01)
    assert write_plot(tmp_path / "plot.png", figure).stat().st_size > 10_000


def test_without_an_anchor_the_plot_says_so(tmp_path: Path) -> None:
    figure = plot_scale(make_analysis(np.zeros((0, 5)), 800, 600))
    assert "no scale" in figure.axes[0].texts[0].get_text()
    write_plot(tmp_path / "plot.jpg", figure)


AFFINE = Affine(0.15, 0, 500_000, 0, -0.15, 5_000_000)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_detector(tmp_path_factory.mktemp("models") / "m.onnx", fixed_size=256)


@pytest.fixture(scope="module")
def cars() -> np.ndarray:
    return car_park(30.0 + np.arange(12) % 3, 400, 300)


@pytest.fixture(scope="module")
def on_ground(
    cars: np.ndarray, model: Path, tmp_path_factory: pytest.TempPathFactory
) -> ScaleAnalysis:
    path = tmp_path_factory.mktemp("geo") / "a.tif"
    profile = {
        "driver": "GTiff",
        "width": 400,
        "height": 300,
        "count": 3,
        "dtype": "uint8",
        "photometric": "RGB",
    }
    with rasterio.open(path, "w", **profile, crs="EPSG:32633", transform=AFFINE) as dataset:
        dataset.write(cars.transpose(2, 0, 1))
    return analyse_scale(path, detector=Detector(model))


def expected_corners(analysis: ScaleAnalysis) -> np.ndarray:
    """Of all boxes, metres of the file's system."""
    corners = box_corners(analysis.detections.boxes)
    return np.stack([500_000 + 0.15 * corners[..., 0], 5_000_000 - 0.15 * corners[..., 1]], axis=-1)


def test_geojson_of_a_georeferenced_file_is_in_degrees(
    on_ground: ScaleAnalysis, tmp_path: Path
) -> None:
    write_shapes(tmp_path / "a.geojson", on_ground)
    collection = json.loads((tmp_path / "a.geojson").read_text())
    assert len(collection["features"]) == 12
    for feature, corners in zip(collection["features"], expected_corners(on_ground), strict=True):
        (ring,) = feature["geometry"]["coordinates"]
        expected = np.transpose(transform("EPSG:32633", "EPSG:4326", *corners.T.tolist()))
        np.testing.assert_allclose(ring[:4], expected, atol=1e-9)


def test_geojson_of_a_plain_image_is_in_its_pixels(
    cars: np.ndarray, model: Path, tmp_path: Path
) -> None:
    analysis = analyse_scale(cars, detector=Detector(model))
    write_shapes(tmp_path / "a.geojson", analysis)
    written = json.loads((tmp_path / "a.geojson").read_text())
    assert written.pop("crs") == {"type": "name", "properties": {"name": PIXELS_WKT}}
    assert written == json.loads(json.dumps(analysis.__geo_interface__))


def test_the_command_writes_them_and_refuses_before_the_work(
    cars: np.ndarray, model: Path, tmp_path: Path
) -> None:
    image = tmp_path / "photo.png"
    cv2.imwrite(str(image), cars[:, :, ::-1])
    words = ["estimate", str(image), "--detector", str(model), "--boxes"]
    assert CliRunner().invoke(app, [*words, str(tmp_path / "{stem}.geojson")]).exit_code == 0
    assert len(json.loads((tmp_path / "photo.geojson").read_text())["features"]) == 12
    refused = CliRunner().invoke(app, [*words, str(tmp_path / "boxes.gpkg")])
    assert (refused.exit_code, "use the suffix .geojson" in refused.stderr) == (2, True)
    with pytest.raises(OutputError, match="there is no folder"):
        check_geojson_path(tmp_path / "none" / "a.geojson")


def _run(*arguments: object) -> None:
    result = CliRunner().invoke(app, list(map(str, arguments)))
    assert result.exit_code == 0, result.output


def test_a_measured_line_is_written_where_it_lies_with_its_metres(
    on_ground: ScaleAnalysis, tmp_path: Path
) -> None:
    points = ("--point", 10, 20, "--point", 110, 20, "--gsd", 0.15)
    _run("distance", on_ground.image, *points, "--line", tmp_path / "line.geojson")
    (feature,) = json.loads((tmp_path / "line.geojson").read_text())["features"]
    expected = np.transpose(
        transform("EPSG:32633", "EPSG:4326", [500_001.5, 500_016.5], [4_999_997] * 2)
    )
    np.testing.assert_allclose(feature["geometry"]["coordinates"], expected, atol=1e-9)
    facts = feature["properties"]
    assert (facts["status"], facts["distance_m"], facts["gsd_m_per_px"]) == (
        "ok",
        pytest.approx(15),
        0.15,
    )


def test_a_measured_outline_is_written_with_its_size(tmp_path: Path) -> None:
    image = np.full((200, 300, 3), 90, np.uint8)
    cv2.rectangle(image, (80, 60), (219, 139), (230, 230, 230), -1)  # 140 x 80 px
    cv2.imwrite(str(tmp_path / "roof.png"), image)
    target = ("--box", 75, 55, 225, 145, "--gsd", 0.1)
    _run("measure", tmp_path / "roof.png", *target, "--outline", tmp_path / "roof.geojson")
    (feature,) = json.loads((tmp_path / "roof.geojson").read_text())["features"]
    assert feature["geometry"]["type"] == "MultiPolygon"
    assert feature["properties"]["area_m2"] == pytest.approx(112, rel=0.05)
    places = np.array(feature["geometry"]["coordinates"][0][0], float)
    np.testing.assert_allclose(
        [places.min(axis=0), places.max(axis=0)], [(80, 60), (220, 140)], atol=3
    )
