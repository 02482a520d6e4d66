from __future__ import annotations

import json
import re
from dataclasses import replace
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
from tests.models import car_park, write_detector
from vehanchor import analyse_scale
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.cli.app import app
from vehanchor.detection.boxes import box_corners
from vehanchor.detection.detections import Detections
from vehanchor.detection.detector import Detector
from vehanchor.errors import OutputError
from vehanchor.export.geojson import check_geojson_path, write_shapes
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.georeference import PIXELS_WKT
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ScaleOptions
from vehanchor.pictures import scale as scale_picture
from vehanchor.pictures.marks import MARK_RGB, draw_marks
from vehanchor.pictures.measurement import _verdict
from vehanchor.pictures.placement import Cut, Placement
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
    """Select the pixels of about a colour: the edges of lines are smoothed."""
    difference = np.abs(picture.astype(int) - np.array(colour))
    return np.asarray((difference < 30).all(axis=2))


def _count(picture: NDArray[np.uint8], colour: tuple[int, int, int]) -> int:
    return int(_near(picture, colour).sum())


def _grey(width_px: int, height_px: int) -> NDArray[np.uint8]:
    return np.full((height_px, width_px, 3), 100, np.uint8)


def _judged(analysis: ScaleAnalysis, status: str, reason: str | None) -> ScaleAnalysis:
    update = {"status": status, "reason": reason}
    return replace(analysis, estimate=analysis.estimate.model_copy(update=update))


def _fleet(n: int, length_px: float = 30.0) -> NDArray[np.float64]:
    """Make the boxes of vehicles in rows of ten."""
    boxes = [
        [60.0 + 50 * (i % 10), 60.0 + 50 * (i // 10), length_px, 12.0, 0.4 * i] for i in range(n)
    ]
    return np.array(boxes).reshape(-1, 5)


def _drawn(boxes: NDArray[np.float64], width: int, height: int) -> NDArray[np.uint8]:
    return draw_overlay(_grey(width, height), make_analysis(boxes, width, height))


@pytest.mark.parametrize(
    ("width", "height", "drawn_width"),
    [(256, 200, MIN_WIDTH_PX), (1000, 800, 1000), (4096, 3000, MAX_SIDE_PX)],
)
def test_a_picture_has_a_display_size(width: int, height: int, drawn_width: int) -> None:
    assert _drawn(_fleet(1), width, height).shape[1] == drawn_width


def test_numbers_do_not_hide_vehicles() -> None:
    boxes = _fleet(30)
    picture = _drawn(boxes, 800, 600)[:600]
    inside = np.zeros(picture.shape[:2], np.uint8)
    smaller = boxes.copy()
    smaller[:, 2:4] -= 6  # within the lines
    for corners in box_corners(smaller):
        cv2.fillConvexPoly(inside, np.rint(corners).astype(np.int32), 1)
    is_white = picture.min(axis=2) > 240
    assert is_white.sum() > 500, "there are numbers"
    assert is_white[inside > 0].mean() < 0.02


@pytest.mark.parametrize(
    ("status", "reason", "first_words"),
    [("ok", None, "safe to use"), ("low_confidence", "too_few", "do not use: ")],
)
def test_a_caption_begins_with_the_status(
    monkeypatch: pytest.MonkeyPatch, status: str, reason: str | None, first_words: str
) -> None:
    captions: list[list[Any]] = []
    panel = scale_picture.caption_panel

    def watched(width_px: int, lines: list[Any]) -> NDArray[np.uint8]:
        captions.append(lines)
        return panel(width_px, lines)

    monkeypatch.setattr(scale_picture, "caption_panel", watched)
    analysis = _judged(make_analysis(_fleet(12), 800, 600), status, reason)
    draw_overlay(_grey(800, 600), analysis)
    (caption,) = captions
    _, text = caption[0][0]
    assert text.startswith(first_words)


@pytest.mark.parametrize("width_px", [300, 768])
def test_a_long_line_of_a_caption_is_broken_instead_of_cut(width_px: int) -> None:
    sentence = "give the height, or draw a line over something of known size, " * 4
    panel = scale_picture.caption_panel(width_px, [[(None, sentence)]])
    margin = panel[:, -6:]
    assert (margin == panel[0, 0]).all()
    short = scale_picture.caption_panel(width_px, [[(None, "safe to use")]])
    assert panel.shape[0] > short.shape[0]


@pytest.mark.parametrize(
    ("statuses", "verdict"),
    [
        (["ok"], "safe to use"),
        (["low_confidence"], "do not use: check the outline"),
        (["ok", "low_confidence"], "safe to use, but not 2: check the outline"),
        (["no_scale"], "do not use: no"),
    ],
)
def test_a_measurement_begins_with_its_status(statuses: list[Any], verdict: str) -> None:
    assert _verdict("", statuses).startswith(verdict)


@pytest.mark.parametrize(("side_px", "drawn_px"), [(50, 512), (100, 512), (200, 800)])
def test_a_small_part_is_enlarged_until_it_is_legible(side_px: int, drawn_px: int) -> None:
    part = Window(0, 0, width_px=side_px, height_px=side_px)
    assert Cut(part, 1000).sized(_grey(side_px, side_px)).shape[1] == drawn_px


def test_kept_vehicles_have_their_colour() -> None:
    picture = _drawn(_fleet(12), 800, 600)[:600]
    assert _count(picture, KEPT_RGB) > 500
    assert _count(picture, DROPPED_RGB) == 0


def test_dropped_vehicles_have_their_colour() -> None:
    boxes = _fleet(12)
    # Beyond 1.5 medians.
    boxes[5, 2] = 90.0
    assert _count(_drawn(boxes, 800, 600)[:600], DROPPED_RGB) > 100


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_boxes_lie_on_their_vehicles_at_any_enlargement(factor: float) -> None:
    size = round(1000 * factor)
    box = np.array([[300.5, 420.25, 160.0, 60.0, 0.0]]) * [factor, factor, factor, factor, 1.0]
    picture = _drawn(box, size, size)
    side = min(MAX_SIDE_PX, max(size, MIN_WIDTH_PX))
    ys, xs = np.nonzero(_near(picture[:side], KEPT_RGB))
    middle = np.array([xs.min() + xs.max(), ys.min() + ys.max()]) / 2 + 0.5
    assert middle == pytest.approx(np.array([300.5, 420.25]) * side / 1000, abs=1.0)
    assert xs.max() - xs.min() == pytest.approx(160 * side / 1000, abs=4)


def _bar(gsd: float) -> tuple[int, float]:
    """Measure the scale bar of a picture: its pixels, and the scale of the picture."""
    # A vehicle away from the picture's lower left, where the bar is.
    boxes = np.array([[900.0, 100.0, 5.045 / gsd, 2.0 / gsd, 0.0]])
    analysis = make_analysis(boxes, 1000, 700, reference_length_m=5.045)
    picture = draw_overlay(_grey(1000, 700), _judged(analysis, "ok", None))
    is_white = (picture[690 - 14 : 690, :600] >= 250).all(axis=2)
    estimated_gsd = analysis.estimate.gsd_m_per_px
    assert estimated_gsd is not None
    return int(is_white.sum(axis=1).max()), estimated_gsd


_GSDS = [0.02, 0.1, 0.1682, 0.29, 0.7]


@pytest.mark.parametrize("gsd", _GSDS)
def test_the_scale_bar_has_a_round_length(gsd: float) -> None:
    bar_px, estimated_gsd = _bar(gsd)
    metres = (bar_px - 1) * estimated_gsd
    round_lengths = np.array([m * 10.0**k for m in (1, 2, 5) for k in range(-2, 4)])
    nearest = round_lengths[np.argmin(np.abs(round_lengths - metres))]
    assert metres == pytest.approx(nearest, abs=2 * gsd)


@pytest.mark.parametrize("gsd", _GSDS)
def test_the_scale_bar_is_about_a_fifth_of_the_width(gsd: float) -> None:
    bar_px, _ = _bar(gsd)
    assert 120 <= bar_px <= 330


def test_without_a_scale_there_is_a_caption_but_no_bar() -> None:
    picture = _drawn(np.zeros((0, 5)), 900, 700)
    assert (picture[:700] == 100).all()
    assert picture.shape[0] > 700


def test_a_read_only_image_is_not_drawn_into() -> None:
    image = _grey(900, 700)
    image.flags.writeable = False
    picture = draw_overlay(image, make_analysis(_fleet(6), 900, 700))
    assert (image == 100).all()
    assert _count(picture, KEPT_RGB)


def test_a_reduced_copy_makes_the_same_picture() -> None:
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
    difference = np.abs(reduced[:, :, 0].astype(int) - expected)
    assert float(difference.mean()) < 3.0
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
def test_a_picture_that_cannot_be_written_is_an_output_error(tmp_path: Path, name: str) -> None:
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(OutputError, match=r"cannot write"):
        write_picture(tmp_path / name, np.zeros((10, 10, 3), np.uint8))


def _analysed(boxes: NDArray[np.float64], **options: Any) -> ScaleAnalysis:
    detections = Detections(boxes, np.full(len(boxes), 0.8))
    return analyse_found(
        detections, made_card(), ScaleOptions.of(options), image_width_px=1000, image_height_px=800
    )


@pytest.fixture(scope="module")
def with_line() -> NDArray[np.uint8]:
    """Picture with a known length of 84 m, from (200, 400) to (700, 400)."""
    return draw_overlay(
        _grey(1000, 800), _analysed(_fleet(4), known_lengths=[(200, 400, 700, 400, 84)])
    )


@pytest.fixture(scope="module")
def without_line() -> NDArray[np.uint8]:
    return draw_overlay(_grey(1000, 800), _analysed(_fleet(4)))


def test_a_known_length_is_drawn_in_its_place(
    with_line: NDArray[np.uint8], without_line: NDArray[np.uint8]
) -> None:
    assert not _near(without_line, MARK_RGB).any()
    rows, columns = np.nonzero(_near(with_line[:800], MARK_RGB))
    assert columns.min() == pytest.approx(200, abs=4)
    assert columns.max() == pytest.approx(700, abs=4)
    assert np.median(rows) == pytest.approx(400, abs=2)


def test_a_known_length_has_its_metres_above_its_middle(
    with_line: NDArray[np.uint8], without_line: NDArray[np.uint8]
) -> None:
    is_white = (with_line[:800] == 255).all(axis=2)
    was_white = (without_line[:800] == 255).all(axis=2)
    letters = is_white & ~was_white
    assert letters[370:400, 450:540].sum() > 60


def test_labels_at_the_edge_do_not_enlarge_the_picture() -> None:
    lines = [(990, 0, 1000, 6, 1), (0, 800, 9, 791, 1)]
    picture = draw_overlay(_grey(1000, 800), _analysed(_fleet(0), known_lengths=lines))
    assert picture.shape[1] == 1000


def test_a_mark_that_leaves_the_picture_is_not_an_error() -> None:
    mark = Mark(((-50.0, -50.0), (90.0, 4.0), (3.0, 99.0)), "m", True)
    picture = np.zeros((20, 20, 3), np.uint8)
    draw_marks(picture, [mark], Placement(np.ones(2), np.zeros(2)))


def _beside_empty_corner(**changes: Any) -> NDArray[np.uint8]:
    """Draw a usable scale; the lower left of the image is empty."""
    box = np.array([[900.0, 100.0, 50.0, 20.0, 0.0]])
    analysis = _judged(make_analysis(box, 1000, 700), "ok", None)
    estimate = analysis.estimate.model_copy(update=changes)
    return draw_overlay(_grey(1000, 700), replace(analysis, estimate=estimate))


def test_a_tilted_photograph_has_no_scale_bar() -> None:
    tilt = CameraTilt(35.0, 0.0, focal_length_px=800.0, source="metadata")
    tilted = _beside_empty_corner(tilt=tilt.record(ImageFacts(1000, 700), 0.1))
    assert (tilted[600:700, :600] == 100).all()
    # Its caption has one line more.
    assert tilted.shape[0] > _beside_empty_corner().shape[0]


pytest.importorskip("matplotlib")


def _boxes(lengths: NDArray[np.float64] | list[float]) -> NDArray[np.float64]:
    return np.array([[50.0, 50.0, length, 10.0, 0.0] for length in lengths]).reshape(-1, 5)


def _labels(figure: object) -> str:
    legend = figure.legends[0]  # type: ignore[attr-defined]
    return "\n".join(text.get_text() for text in legend.get_texts())


@pytest.fixture(scope="module")
def with_outliers() -> ScaleAnalysis:
    """Analysis of 60 cars and two lorries."""
    lengths = [*np.random.default_rng(0).normal(30, 2, 60), 80.0, 300.0]
    return make_analysis(_boxes(lengths), 800, 600)


def test_the_legend_explains_the_plot(with_outliers: ScaleAnalysis) -> None:
    text = _labels(plot_scale(with_outliers))
    mode = with_outliers.estimate.mode_length_px
    assert mode is not None
    assert re.search(rf"{mode:.1f} px \(KDE\) = 5\.0[45] m", text)
    assert "resolution guard 16.8 px" in text
    assert "95 % interval" in text
    assert "60 vehicles kept" in text
    assert re.search(r"2 outliers dropped \([12] beyond the axis\)", text)


def test_the_guard_is_visible_beside_a_lorry(with_outliers: ScaleAnalysis) -> None:
    left, right = plot_scale(with_outliers).axes[0].get_xlim()
    assert left < 5.045 / 0.3
    # One lorry does not make the cars narrow.
    assert 5.045 / 0.3 < right < 120


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
def test_any_aggregation_of_any_vehicles_can_be_drawn(
    tmp_path: Path, lengths: list[float], aggregation: Aggregation, rule: str
) -> None:
    figure = plot_scale(make_analysis(_boxes(lengths), 800, 600, aggregation=aggregation))
    assert f"({rule})" in _labels(figure)
    write_plot(tmp_path / "plot.png", figure)


def _beside_a_line(n: int, metres: float) -> ScaleAnalysis:
    boxes = _boxes(np.random.default_rng(1).normal(30, 2, n))
    return _analysed(boxes, known_lengths=[(0, 0, 500, 0, metres, "measured")])


@pytest.fixture(scope="module", params=[0, 30])
def beside_line(request: pytest.FixtureRequest) -> tuple[int, ScaleAnalysis]:
    """Number of vehicles beside a known length, and the analysis."""
    return request.param, _beside_a_line(request.param, 84.0)


def _ruler_axes(figure: Any) -> Any:
    # Below the lengths, if there are any.
    return figure.axes[1] if len(figure.axes) > 1 else figure.axes[0]


def test_the_rulers_share_one_axis(beside_line: tuple[int, ScaleAnalysis]) -> None:
    n, analysis = beside_line
    legend = _ruler_axes(plot_scale(analysis)).get_legend()
    assert legend is not None
    names = [text.get_text().partition(" (")[0] for text in legend.get_texts()]
    assert names[-3:] == [
        "known length 0.168",
        "together 0.168",
        "95 % interval\nif at least one ruler is right",
    ]
    assert [name.split()[0] for name in names[:-3]] == (["vehicles"] if n else [])


def test_the_axis_contains_the_interval(beside_line: tuple[int, ScaleAnalysis]) -> None:
    _, analysis = beside_line
    low, high = _ruler_axes(plot_scale(analysis)).get_xlim()
    estimate = analysis.estimate
    assert estimate.gsd_ci95_low_m_per_px is not None
    assert estimate.gsd_ci95_high_m_per_px is not None
    assert low < estimate.gsd_ci95_low_m_per_px < estimate.gsd_ci95_high_m_per_px < high


def test_the_posterior_has_its_maximum_at_the_scale(
    beside_line: tuple[int, ScaleAnalysis],
) -> None:
    _, analysis = beside_line
    lines = _ruler_axes(plot_scale(analysis)).lines
    together = next(line for line in lines if str(line.get_label()).startswith("together 0.168"))
    scales = np.asarray(together.get_xdata())
    curve = np.asarray(together.get_ydata())
    assert scales[curve.argmax()] == pytest.approx(analysis.estimate.gsd_m_per_px, rel=0.01)


def test_the_plot_of_rulers_can_be_written(
    beside_line: tuple[int, ScaleAnalysis], tmp_path: Path
) -> None:
    path = write_plot(tmp_path / "plot.png", plot_scale(beside_line[1]))
    assert path.stat().st_size > 10_000


def test_without_a_scale_the_plot_states_it(tmp_path: Path) -> None:
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
    """Compute the corners of all boxes in metres of the file's system."""
    corners = box_corners(analysis.detections.boxes)
    eastings = 500_000 + 0.15 * corners[..., 0]
    northings = 5_000_000 - 0.15 * corners[..., 1]
    return np.stack([eastings, northings], axis=-1)


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


@pytest.fixture
def photograph(cars: np.ndarray, tmp_path: Path) -> Path:
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), cars[:, :, ::-1])
    return path


def test_the_command_writes_the_boxes(photograph: Path, model: Path) -> None:
    boxes = photograph.with_name("{stem}.geojson")
    _run("estimate", photograph, "--detector", model, "--boxes", boxes)
    written = json.loads(photograph.with_name("photo.geojson").read_text())
    assert len(written["features"]) == 12


def test_the_command_refuses_another_format(photograph: Path, model: Path) -> None:
    boxes = photograph.with_name("boxes.gpkg")
    words = ["estimate", str(photograph), "--detector", str(model), "--boxes", str(boxes)]
    refused = CliRunner().invoke(app, words)
    assert refused.exit_code == 2
    assert "use the suffix .geojson" in refused.stderr


def test_a_missing_folder_is_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="there is no folder"):
        check_geojson_path(tmp_path / "none" / "a.geojson")


def _run(*arguments: object) -> None:
    result = CliRunner().invoke(app, list(map(str, arguments)))
    assert result.exit_code == 0, result.output


def test_a_measured_line_is_written_in_degrees_with_its_metres(
    on_ground: ScaleAnalysis, tmp_path: Path
) -> None:
    points = ("--point", 10, 20, "--point", 110, 20, "--gsd", 0.15)
    _run("distance", on_ground.image, *points, "--line", tmp_path / "line.geojson")
    (feature,) = json.loads((tmp_path / "line.geojson").read_text())["features"]
    expected = np.transpose(
        transform("EPSG:32633", "EPSG:4326", [500_001.5, 500_016.5], [4_999_997] * 2)
    )
    np.testing.assert_allclose(feature["geometry"]["coordinates"], expected, atol=1e-9)
    properties = feature["properties"]
    assert (properties["status"], properties["gsd_m_per_px"]) == ("ok", 0.15)
    assert properties["distance_m"] == pytest.approx(15)


def test_a_measured_outline_is_written_with_its_size(tmp_path: Path) -> None:
    image = np.full((200, 300, 3), 90, np.uint8)
    # A roof of 140 x 80 px.
    cv2.rectangle(image, (80, 60), (219, 139), (230, 230, 230), -1)
    cv2.imwrite(str(tmp_path / "roof.png"), image)
    target = ("--box", 75, 55, 225, 145, "--gsd", 0.1)
    _run("measure", tmp_path / "roof.png", *target, "--outline", tmp_path / "roof.geojson")
    (feature,) = json.loads((tmp_path / "roof.geojson").read_text())["features"]
    assert feature["geometry"]["type"] == "MultiPolygon"
    assert feature["properties"]["area_m2"] == pytest.approx(112, rel=0.05)
    points = np.array(feature["geometry"]["coordinates"][0][0], float)
    bounds = [points.min(axis=0), points.max(axis=0)]
    np.testing.assert_allclose(bounds, [(80, 60), (220, 140)], atol=3)
