"""Files that people reported, by command line, Python and MCP: one table of right answers.

They lie in ``../shared/cases`` and ``../shared/cases/second`` beside the clone, and are skipped
where these are absent. Rendered twins of each kind are in other tests. MCP offers no choice of
rulers, so there the other rulers of a file answer, too.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import subprocess
import sys
import unicodedata
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
from mcp import Client
from mcp.server import MCPServer
from mcp.types import CallToolResult
from typer.testing import CliRunner

import vehanchor
from tests.conftest import ROOT
from tests.server.conversation import by_path, called, error_of, record_of, text_of
from vehanchor.cli.app import app
from vehanchor.errors import ImageDecodeError, InvalidParameterError, VehAnchorError
from vehanchor.imagery.sources.files import find_images
from vehanchor_flight.verbs import estimate_flight, rescale
from vehanchor_flight.video import sample_video
from vehanchor_server.app import create_server
from vehanchor_server.services import create_services
from vehanchor_server.settings import Settings

FIRST = ROOT.parent / "shared" / "cases"
SECOND = FIRST / "second"
PHOTO = ROOT / "examples" / "scenes" / "safe.jpg"

pytestmark = [
    pytest.mark.anyio,
    pytest.mark.slow,
    pytest.mark.skipif(not SECOND.is_dir(), reason=f"no {SECOND}"),
]

_FLAGS = {
    "rulers": "--rulers",
    "height_m": "--height",
    "height_basis": "--height-basis",
    "focal_35mm": "--focal-35mm",
    "gsd_m_per_px": "--gsd",
}
# Greatest error of an answer that planners may act on.
_OK_TOLERANCE = 0.2
_LOW = ("low_confidence",)
_OK = ("ok",)
_NONE = ("no_scale",)
_CAMERA = {"rulers": "camera"}
_LENS = ("camera_unusable",)


@dataclass(frozen=True, kw_only=True)
class Row:
    """File, how it is called, and its right answer.

    Attributes:
        file: name in one of the folders.
        options: options of the estimate, by their names in Python.
        gsd: right scale, metres per pixel; None if the answer has none.
        tolerance: relative; the error that the kind of evidence allows.
        statuses: right statuses.
        notices: codes that the answer has.
        n_vehicles: right number of vehicles; None if it does not matter.
        error: code of the error; empty for an answer.
    """

    file: str
    options: dict[str, Any] = field(default_factory=dict)
    gsd: float | None = None
    tolerance: float = 0.01
    statuses: tuple[str, ...] = _LOW
    notices: tuple[str, ...] = ()
    n_vehicles: int | None = None
    error: str = ""

    @property
    def path(self) -> Path:
        """Path of the file."""
        return FIRST / self.file if (FIRST / self.file).is_file() else SECOND / self.file


def _camera(file: str, gsd: float | None, **right: Any) -> Row:
    """Make a row about the camera's metadata alone."""
    return Row(file=file, options=_CAMERA, gsd=gsd, **right)


def _cars(file: str, gsd: float, **right: Any) -> Row:
    """Make a row about photographs with enough cars; their length varies by a tenth."""
    return Row(**{"file": file, "gsd": gsd, "tolerance": 0.1, "statuses": _OK, **right})


def _unusable(file: str, options: dict[str, Any]) -> Row:
    """Make a row about metadata that give no scale, and say why."""
    return Row(file=file, options=options, statuses=_NONE, notices=_LENS)


_HEIGHT = {"height_m": 100, "height_basis": "measured"}
_SPHERE = {"rulers": "camera,height", "height_m": 84, "height_basis": "measured"}

ROWS = [
    # The caller repeats a height of the file that the cars contradict: the cars hold.
    _cars(
        "h02_cars_takeoff_from_a_hill.jpg",
        0.12,
        options={"height_m": 25, "height_basis": "measured"},
        notices=("height_repeated", "rulers_disagree"),
    ),
    # The lens is stale, the height is not used, and the cars are right.
    _cars(
        "h01_cars_stale_lens_no_height.jpg",
        0.12,
        options={"height_m": 85.9, "height_basis": "measured"},
        notices=_LENS,
    ),
    # One drone's height gives a scale that is right within 20 % in fewer than 9 of 10 photographs.
    _camera("m00_control.jpg", 0.1096),
    Row(
        file="m00_control.jpg",
        options={"height_m": 100},
        gsd=0.1096,
        notices=("height_repeated",),
    ),
    _cars("h03_cars_right_height.jpg", 0.12),
    _unusable("m10_focal_plane_after_resize.jpg", _CAMERA),
    _unusable("m10_focal_plane_after_resize.jpg", _HEIGHT),
    _camera("m10_focal_plane_original_size.jpg", 0.1431),
    _camera("m12_skydio_struct_x2d.jpg", 0.0491),
    _camera("m12_skydio_flat_x2d.jpg", 0.0491),
    _camera("m01_xmp_utf16le.jpg", 0.1096),
    _camera("m02_xmp_trailing_junk.jpg", 0.1096),
    _camera("m03_xmp_ampersand.jpg", 0.1096),
    _camera("m03_xmp_duplicate_attribute.jpg", 0.1096),
    _camera("m03_xmp_bad_byte.jpg", 0.1096),
    _camera("m04_xmp_two_packets.jpg", 0.1096),
    _camera("m14_png_xmp_only.png", 0.2193),
    Row(
        file="m14_png_xmp_only.png",
        options={"focal_35mm": 24},
        gsd=0.2193,
        statuses=("ok", "low_confidence"),
    ),
    _camera("m04_xmp_extension_first.jpg", 0.1096),
    _camera("m05_xmp_in_exif_directory.jpg", 0.1096),
    _camera("m06_xmp_elements.jpg", 0.1096),
    _camera("m19_height_13_decimals.jpg", 0.1096),
    _camera("m19_height_12_decimals.jpg", 0.1096),
    _camera("m19_pitch_14_decimals.jpg", 0.1361, notices=("camera_tilted",)),
    _camera("m07_height_feet.jpg", 0.1096),
    _camera("m07_height_unit.jpg", 0.1096),
    _camera("m07_decimal_comma.jpg", 0.1107),
    _camera("m07_xmp_rational.jpg", 0.0907),
    _unusable("m07_height_zero.jpg", _CAMERA),
    _unusable("m07_height_negative.jpg", _CAMERA),
    _unusable("m07_height_nan.jpg", _CAMERA),
    _camera("m11_focal_px_12_decimals.jpg", 0.0685),
    _camera("m11_focal_px_no_units.jpg", 0.0685),
    _camera("m11_focal_px_units_pixels.jpg", 0.0685),
    _camera("m11_focal_mm_units.jpg", 0.0685),
    _camera("m13_autel_make_camera_narrow.jpg", 0.0816, notices=("camera_tilted",)),
    _camera("m13_autel_make_autel_narrow.jpg", 0.0816, notices=("camera_tilted",)),
    _camera("m13_autel_make_camera_nadir.jpg", 0.0721),
    _camera("m20_tiff_exif_pointer_type13.tif", 0.2138),
    _camera("m20_tiff_exif_pointer_long.tif", 0.2138),
    Row(file="m21_drone.dng", error="image_unsupported"),
    _camera("m22_thermal_float.tif", 0.1319),
    _cars("a01_alpha_left.tif", 0.12, n_vehicles=23),
    _cars("a01_alpha_left.webp", 0.12, n_vehicles=23),
    _cars("a01_mask_left.tif", 0.12, n_vehicles=23),
    _cars("a00_base.png", 0.12, n_vehicles=74),
    _cars("a02_float_9999_untagged.tif", 0.12, notices=("pixels_stretched",)),
    _cars("a02_uint16_65535_untagged.tif", 0.12, notices=("pixels_stretched",)),
    _cars("a02_float_9999_tagged.tif", 0.12),
    _cars("a02_uint16_65535_tagged.tif", 0.12),
    _cars("a02_uint16_12bit.tif", 0.12),
    _cars("a02_gray_float.tif", 0.12),
    _cars("h04_cars_gimbal_zero_yaw.jpg", 0.12, notices=_LENS),
    _camera("m16_gimbal_zero.jpg", 0.070),
    _camera("m15_roll_180_nadir.jpg", 0.1096),
    _camera("m15_roll_180_past_nadir.jpg", 0.1203, notices=("camera_tilted",)),
    _camera("m17_orientation_6.jpg", 0.1096),
    _unusable("m18_digital_zoom.jpg", _CAMERA),
    # The interval holds 0.0548 and 0.1096.
    _camera("m18_zoom_only_35mm.jpg", 0.0775, tolerance=0.45),
    _camera("m08_focal_0_1.jpg", 0.171),
    _camera("m08_focal_0_0.jpg", 0.171),
    _camera("m08_focal_5_0_f35_0.jpg", 0.171),
    _camera("m09_focal_plane_0.jpg", 0.119),
    _cars("n00_square_utm.tif", 0.1379),
    Row(
        file="c01_two_photographs_2_to_1.jpg",
        gsd=0.2,
        tolerance=1.0,
        notices=("several_pictures",),
    ),
    Row(
        file="p01_dji_sphere.jpg",
        options=_CAMERA,
        statuses=_NONE,
        notices=("camera_unusable", "not_perspective"),
    ),
    Row(
        file="p01_dji_sphere.jpg",
        options=_SPHERE,
        statuses=_NONE,
        notices=("camera_unusable", "not_perspective"),
    ),
    _camera("p00_control.jpg", 0.0877),
    Row(file="g03_two_cars.jpg", gsd=0.1373, tolerance=0.2, n_vehicles=2),
    _cars("s01_external_mask.tif", 0.2, n_vehicles=20),
    _cars("s01_internal_mask.tif", 0.2, n_vehicles=20),
    # The first page is a preview of 128 px; the notice says that the other one is larger.
    Row(
        file="f02_pages_small_first.tif",
        options=_CAMERA,
        statuses=_NONE,
        notices=("pages_unused",),
    ),
    Row(
        file="h01_iphone.heic",
        options={"rulers": "height", "height_m": 85, "height_basis": "measured"},
        gsd=0.24,
        tolerance=0.02,
        statuses=_OK,
    ),
]


def _row_name(row: Row) -> str:
    return "-".join([row.file, *map(str, row.options.values())])


@pytest.fixture(scope="module")
def cases_server() -> MCPServer[object]:
    """A server in this process, with the bundled networks, for both folders."""
    settings = Settings(roots=(FIRST,), isolation="in-process", never_ask=True, deadline_s=250)
    return create_server(create_services(settings))


def _run(*arguments: object) -> tuple[int, str, str]:
    """Run ``vehanchor`` in this process; return its status, stdout and stderr."""
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    return result.exit_code, result.stdout, result.stderr


def _arguments(options: dict[str, Any]) -> list[str]:
    """Write options as a command line has them."""
    arguments = []
    for name, value in options.items():
        arguments += [_FLAGS[name], str(value)]
    return arguments


def _check(record: dict[str, Any], row: Row) -> None:
    """Compare a record with the right answer."""
    codes = {notice["code"] for notice in record["warnings"]}
    assert codes >= set(row.notices)
    assert record["status"] in row.statuses
    _check_scale(record, row)
    if row.n_vehicles is not None:
        assert record["n_vehicles"] == row.n_vehicles


def _check_scale(record: dict[str, Any], row: Row) -> None:
    """Compare a scale with the right one; null if it is unknown."""
    gsd = record["gsd_m_per_px"]
    if row.gsd is None:
        assert gsd is None
    else:
        assert gsd == pytest.approx(row.gsd, rel=row.tolerance)


@pytest.mark.parametrize("row", ROWS, ids=_row_name, scope="module")
def test_the_command_line_is_right(row: Row) -> None:
    code, out, err = _run("estimate", row.path, "--json", *_arguments(row.options))
    if row.error:
        assert code == 2
        assert f"error[{row.error}]" in err
        return
    assert code == 0
    _check(json.loads(out), row)


@pytest.mark.parametrize("row", ROWS, ids=_row_name, scope="module")
def test_python_is_right(row: Row) -> None:
    if row.error:
        with pytest.raises(VehAnchorError) as caught:
            vehanchor.estimate_gsd(row.path, **row.options)
        assert caught.value.code == row.error
        return
    record = vehanchor.estimate_gsd(row.path, **row.options)
    _check(record.model_dump(mode="json"), row)


@pytest.mark.parametrize("row", ROWS, ids=_row_name, scope="module")
async def test_mcp_is_right(row: Row, cases_server: MCPServer[object]) -> None:
    options = {name: value for name, value in row.options.items() if name != "rulers"}
    result = await called(cases_server, "estimate_gsd", row.path, **options)
    if row.error:
        assert error_of(result) == row.error
        return
    record = record_of(result)
    if "rulers" not in row.options:
        _check(record, row)
        return
    # The other rulers may add to the answer, but nothing that planners act on may be wrong.
    codes = {notice["code"] for notice in record["warnings"]}
    assert codes >= set(row.notices)
    if record["status"] == "ok":
        assert row.gsd is not None
        assert record["gsd_m_per_px"] == pytest.approx(row.gsd, rel=_OK_TOLERANCE)


# Lines of which the right length is known, and the reason for the tolerance of the answer.
LINES = [
    # A pixel is 0.0936 m wide and 0.1373 m high.
    ("n01_degrees_47.tif", [(100, 200), (500, 200)], 37.4),
    ("n01_degrees_47.tif", [(250, 100), (250, 400)], 41.2),
    # In the right one of two photographs: the answer is that of the left one, and not usable.
    ("c01_two_photographs_2_to_1.jpg", [(600, 250), (900, 250)], None),
]
Points: TypeAlias = list[tuple[float, float]]


def _check_line(record: dict[str, Any], metres: float | None) -> None:
    if metres is None:
        assert record["status"] == "low_confidence"
        return
    assert record["status"] == "ok"
    assert record["distance_m"] == pytest.approx(metres, rel=_OK_TOLERANCE)
    assert record["distance_ci95_low_m"] < metres < record["distance_ci95_high_m"]


@pytest.mark.parametrize(("file", "points", "metres"), LINES, scope="module")
def test_a_line_is_right_by_command_line(file: str, points: Points, metres: float | None) -> None:
    arguments = []
    for point in points:
        arguments += ["--point", *point]
    code, out, _ = _run("distance", SECOND / file, *arguments, "--json")
    assert code == 0
    _check_line(json.loads(out), metres)


@pytest.mark.parametrize(("file", "points", "metres"), LINES, scope="module")
def test_a_line_is_right_in_python(file: str, points: Points, metres: float | None) -> None:
    record = vehanchor.measure_distance(SECOND / file, points)
    _check_line(record.model_dump(mode="json"), metres)


@pytest.mark.parametrize(("file", "points", "metres"), LINES, scope="module")
async def test_a_line_is_right_over_mcp(
    file: str, points: Points, metres: float | None, cases_server: MCPServer[object]
) -> None:
    line = {"points": [{"x": x, "y": y} for x, y in points]}
    result = await called(cases_server, "measure_distance", SECOND / file, lines=[line])
    _check_line(record_of(result), metres)


def test_control_points_give_map_coordinates(tmp_path: Path) -> None:
    # The table's longitudes and latitudes are 24 m off; the fit of the file's own points, which is
    # exact, is right.
    path = tmp_path / "line.geojson"
    points = ["--point", 100, 100, "--point", 300, 100]
    code, _, _ = _run(
        "distance", SECOND / "f04_gcps_only.tif", *points, "--gsd", 0.2, "--line", path
    )
    assert code == 0
    (feature,) = json.loads(path.read_text())["features"]
    first, last = feature["geometry"]["coordinates"]
    expected = _degrees([(330020, 4824980), (330060, 4824980)])
    assert first == pytest.approx(expected[0], abs=1e-7)
    assert last == pytest.approx(expected[1], abs=1e-7)


def _degrees(eastings: Points) -> Points:
    from rasterio.warp import transform

    longitudes, latitudes = transform("EPSG:32632", "EPSG:4326", *zip(*eastings, strict=True))
    return list(zip(longitudes, latitudes, strict=True))


def test_a_masked_array_has_its_mask() -> None:
    rasterio = pytest.importorskip("rasterio")
    with rasterio.open(SECOND / "s01_internal_mask.tif") as dataset:
        masked = dataset.read(masked=True).transpose(1, 2, 0)
    assert np.ma.is_masked(masked)
    assert vehanchor.estimate_gsd(masked).n_vehicles == 20


# Films of 0.1 m/px, the second one at its displayed size.
@pytest.mark.parametrize("name", ["v00_progressive.mp4", "v01_sar_64_45.mp4"])
def test_a_film_is_right(name: str) -> None:
    code, out, _ = _run("flight", SECOND / name, "--same-scale", "--json")
    assert code == 0
    by_command = json.loads(out)
    in_python = estimate_flight(sample_video(str(SECOND / name), 1.0), same_scale=True)
    for status, gsd in (
        (by_command["status"], by_command["gsd_m_per_px"]),
        (in_python.status, in_python.gsd_m_per_px),
    ):
        assert status == "ok"
        assert gsd == pytest.approx(0.1, rel=_OK_TOLERANCE)


def test_an_interlaced_film_is_refused() -> None:
    name = "v03_interlaced.mp4"
    code, _, err = _run("flight", SECOND / name, "--same-scale")
    assert code == 2
    assert "interlaced" in err
    with pytest.raises(ImageDecodeError, match="interlaced"):
        next(sample_video(str(SECOND / name), 1.0))


@pytest.mark.parametrize(
    "name", ["r01_colmap_upside_down", "r01_colmap_upside_down_control", "r02_colmap_portrait"]
)
def test_a_turned_photograph_gives_the_size_of_its_model(name: str) -> None:
    code, out, _ = _run("flight", "rescale", SECOND / name, "--json")
    assert code == 0
    for record in (json.loads(out), rescale(SECOND / name).model_dump(mode="json")):
        assert record["status"] == "ok"
        assert record["factor_ci95_low"] < 12.5 < record["factor_ci95_high"]


HEAD = SECOND / "g01_wide_zoom_thermal"


async def test_a_camera_head_has_no_common_scale(cases_server: MCPServer[object]) -> None:
    code, _, err = _run("flight", HEAD, "--same-scale")
    assert code == 2
    assert "do not have one scale" in err
    with pytest.raises(InvalidParameterError, match="do not have one scale"):
        estimate_flight(find_images([str(HEAD)]), same_scale=True)
    first, *others = sorted(HEAD.glob("*_Z.JPG")) + sorted(HEAD.glob("*_[WT].JPG"))
    more = [by_path(path)["image"] for path in others]
    result = await called(cases_server, "estimate_gsd", first, more_images=more, same_scale=True)
    assert result.is_error
    assert "do not have one scale" in text_of(result)


def test_linked_pictures_of_a_camera_head_have_their_own_scales() -> None:
    truth = {"W": 0.1, "Z": 0.0333, "T": 0.2}
    record = estimate_flight(find_images([str(HEAD)]))
    for photograph in record.photographs:
        kind = Path(photograph.photograph).stem[-1]
        assert photograph.gsd_m_per_px == pytest.approx(truth[kind], rel=0.1)


@pytest.mark.parametrize("options", [[], ["--same-scale"]], ids=["linked", "same scale"])
def test_five_copies_are_one_photograph(tmp_path: Path, options: list[str]) -> None:
    for name in ("", " (1)", " (2)", " (3)", " - Copy"):
        shutil.copy(SECOND / "g03_two_cars.jpg", tmp_path / f"IMG_0042{name}.jpg")
    code, out, _ = _run("flight", tmp_path, *options, "--json")
    assert code == 0
    in_python = estimate_flight(find_images([str(tmp_path)]), same_scale=bool(options))
    alone = vehanchor.estimate_gsd(SECOND / "g03_two_cars.jpg")
    for record in (json.loads(out), in_python.model_dump(mode="json")):
        assert record["status"] == "low_confidence"
        assert record["confidence"] == pytest.approx(alone.confidence, abs=0.02)
        assert record["n_vehicles"] == 2


def test_thumbnails_in_a_folder_are_left_out(tmp_path: Path) -> None:
    folder = tmp_path / "f01"
    script = FIRST / "f01_folder_with_thumbnails.py"
    subprocess.run([sys.executable, script, folder], check=True)
    record = estimate_flight(find_images([str(folder)]), same_scale=True)
    assert len(record.photographs) == 1
    assert record.n_vehicles == 74
    assert record.gsd_m_per_px == pytest.approx(0.12, rel=0.1)
    table = tmp_path / "f01.csv"
    code, _, _ = _run("batch", folder, "-o", table)
    assert code == 0
    with table.open() as file:
        assert len(list(csv.DictReader(file))) == 1


def test_a_table_with_semicolons_is_read(tmp_path: Path) -> None:
    shutil.copy(PHOTO, tmp_path / "safe.jpg")
    table = shutil.copy(SECOND / "lines_semicolon.csv", tmp_path)
    out = tmp_path / "o.csv"
    code, _, _ = _run("batch", tmp_path / "safe.jpg", "-o", out, "--known-lengths", table)
    assert code == 0
    with out.open() as file:
        (row,) = csv.DictReader(file)
    # 36.5 m are 300 px.
    assert float(row["gsd_m_per_px"]) == pytest.approx(36.5 / 300, rel=0.02)


def _script(name: str, *arguments: object) -> str:
    """Run a script of the second folder with this environment's commands; return its output."""
    commands = Path(sys.executable).parent
    path = os.pathsep.join([str(commands), os.environ["PATH"]])
    finished = subprocess.run(
        ["bash", SECOND / name, *map(str, arguments)],
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
        errors="replace",
        check=False,
    )
    return finished.stdout


@pytest.mark.skipif(shutil.which("gcc") is None, reason="gcc makes the mount without locks")
@pytest.mark.parametrize("number", [37, 38])
def test_files_are_written_without_locks(number: int) -> None:
    words = _script("no_locks.sh", number, PHOTO).split()
    assert words.count("exit") == words.count("0") == 2
    assert {"flight.json", "scales.csv"} <= set(words)


@pytest.mark.parametrize(("letter", "count"), [("a", 245), ("空", 80)])
def test_files_with_long_names_are_written(letter: str, count: int) -> None:
    assert _script("long_names.sh", letter, count, PHOTO).count("exit 0") == 4


def test_a_name_that_stdout_cannot_encode_is_escaped(tmp_path: Path) -> None:
    shutil.copy(PHOTO, tmp_path / "日本.jpg")
    finished = subprocess.run(
        [sys.executable, "-m", "vehanchor", "estimate", "日本.jpg"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONIOENCODING": "cp1252"},
        capture_output=True,
        check=True,
    )
    assert b"\\u65e5\\u672c.jpg" in finished.stdout


async def _requested(server: MCPServer[object], file: Path) -> list[CallToolResult]:
    """Send the calls of a JSON file."""
    results = []
    async with Client(server) as client:
        for call in json.loads(file.read_text(encoding="utf-8")):
            results.append(await client.call_tool(call["name"], call["arguments"]))
    return results


def _server_of(root: Path) -> MCPServer[object]:
    settings = Settings(roots=(root,), isolation="in-process", never_ask=True)
    return create_server(create_services(settings))


async def test_numbers_as_texts_are_numbers(cases_server: MCPServer[object]) -> None:
    results = await _requested(cases_server, FIRST / "p01_metres_as_text.json")
    assert not any(result.is_error for result in results)


async def test_a_picture_has_no_structure_beside_it(cases_server: MCPServer[object]) -> None:
    request = FIRST / "p02_picture_beside_structured_content.json"
    picture, _ = await _requested(cases_server, request)
    assert [content.type for content in picture.content] == ["text", "image"]
    assert picture.structured_content is None


async def test_a_name_in_another_unicode_form_is_opened(tmp_path: Path) -> None:
    shutil.copy(FIRST / "a00_base.png", tmp_path / unicodedata.normalize("NFD", "café.png"))
    results = await _requested(_server_of(tmp_path), FIRST / "p04_nfc_name.json")
    assert not any(result.is_error for result in results)


async def test_an_example_in_an_error_names_the_photograph_of_the_call() -> None:
    (result,) = await _requested(_server_of(SECOND), SECOND / "box_as_list.json")
    assert result.is_error
    _, _, example = text_of(result).partition("Example: ")
    assert "s01_internal_mask.tif" in example


def test_a_lone_surrogate_is_answered(tmp_path: Path) -> None:
    shutil.copy(PHOTO, tmp_path)
    finished = subprocess.run(
        [sys.executable, SECOND / "mcp_lines.py", tmp_path, SECOND / "lone_surrogate_path.txt"],
        env={
            **os.environ,
            "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
        },
        capture_output=True,
        text=True,
        check=True,
    )
    assert "image_not_found" in finished.stdout
    assert "NO ANSWER" not in finished.stdout


# Rows of the tables whose tests are not in ROWS.
OTHERS = {
    "(command)",
    "box_as_list.json",
    "f01_folder_with_thumbnails.py",
    "f04_gcps_only.tif",
    "g01_wide_zoom_thermal",
    "lines_semicolon.csv",
    "lone_surrogate_path.txt",
    "long_names.sh",
    "n01_degrees_47.tif",
    "no_locks.sh",
    "p01_metres_as_text.json",
    "p02_picture_beside_structured_content.json",
    "p04_nfc_name.json",
    "r01_colmap_upside_down",
    "r01_colmap_upside_down_control",
    "r02_colmap_portrait",
    "v00_progressive.mp4",
    "v01_sar_64_45.mp4",
    "v03_interlaced.mp4",
}


@pytest.mark.parametrize("folder", [FIRST, SECOND], ids=["first", "second"])
def test_every_row_has_a_right_answer_here(folder: Path) -> None:
    with (folder / "cases.csv").open(encoding="utf-8") as file:
        files = {row["file"] for row in csv.DictReader(file)}
    assert files <= {row.file for row in ROWS} | OTHERS
