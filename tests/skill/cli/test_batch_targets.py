"""``vehanchor batch --measure``: from a table of boxes, points and lines to a table or a map."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import NamedTuple

import cv2
import pytest
import rasterio
from affine import Affine
from typer.testing import CliRunner, Result

from tests.models import pool_among_cars, write_detector
from vehanchor.cli.app import app

_HEADER = "file,kind,x1,y1,x2,y2,name\n"
_TARGETS = """photos/cars.png,box,96,196,204,254,=pool
photos/cars.png,point,150,220,,,middle
photos/cars.png,line,100,100,500,100,road
photos/cars.png,box,900,0,990,50,outside
photos/bare.png,,96,196,204,254,pool without cars
"""


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of photographs, with a table of targets in them and a detector."""
    folder = tmp_path_factory.mktemp("targets")
    (folder / "photos").mkdir()
    for name, n_cars in (("cars", 24), ("bare", 0)):
        image = pool_among_cars(n_cars, (100, 200, 200, 250))
        assert cv2.imwrite(str(folder / f"photos/{name}.png"), image[:, :, ::-1])
    (folder / "targets.csv").write_text(_HEADER + _TARGETS)
    write_detector(folder / "painted.onnx")
    return folder


def _batch(place: Path, output: Path, *options: object, table: str = "targets.csv") -> Result:
    arguments: list[object] = ["batch", place / "photos", "--measure", place / table]
    arguments += ["-o", output, "--detector", place / "painted.onnx"]
    # The scene-scale prior does not know painted pictures.
    arguments += ["--rulers", "vehicles", *options]
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


# --- A table of measurements


class Measured(NamedTuple):
    """Finished command and its table, with the rows by the names of their targets."""

    result: Result
    table: Path
    rows: dict[str, dict[str, str]]


@pytest.fixture(scope="module")
def measured(place: Path) -> Measured:
    table = place / "out.csv"
    result = _batch(place, table)
    with table.open(newline="") as file:
        rows = {row["name"]: row for row in csv.DictReader(file)}
    return Measured(result, table, rows)


def test_the_summary_counts_targets_by_status(measured: Measured) -> None:
    assert measured.result.exit_code == 0, measured.result.output
    assert "out.csv: 5 targets (3 ok, 1 no_scale, 1 error)" in measured.result.stderr


def test_each_target_has_a_row_in_order(measured: Measured) -> None:
    statuses = {name: row["status"] for name, row in measured.rows.items()}
    assert list(statuses.items()) == [
        ("'=pool", "ok"),
        ("middle", "ok"),
        ("road", "ok"),
        ("outside", ""),
        ("pool without cars", "no_scale"),
    ]


def test_a_box_has_an_area_with_its_interval(measured: Measured) -> None:
    pool = measured.rows["'=pool"]
    gsd = float(pool["gsd_m_per_px"])
    area = float(pool["area_m2"])
    assert area == pytest.approx(100 * 50 * gsd**2, rel=0.15)
    assert float(pool["area_ci95_low_m2"]) < area < float(pool["area_ci95_high_m2"])


def test_a_line_has_a_distance(measured: Measured) -> None:
    road = measured.rows["road"]
    assert float(road["distance_m"]) == pytest.approx(400 * float(road["gsd_m_per_px"]))
    assert road["mask_score"] == ""


def test_all_targets_of_an_image_have_the_scale_of_one_search(measured: Measured) -> None:
    gsds = {measured.rows[name]["gsd_m_per_px"] for name in ("'=pool", "road")}
    assert len(gsds) == 1


def test_the_confidence_is_named_as_that_of_the_scale(measured: Measured) -> None:
    middle = measured.rows["middle"]
    road = measured.rows["road"]
    assert "confidence" not in middle
    assert float(middle["scale_confidence"]) == float(road["scale_confidence"]) > 0.5
    assert 0 <= float(middle["mask_score"]) <= 1


def test_a_target_outside_its_image_has_a_row_with_the_error(measured: Measured) -> None:
    assert measured.rows["outside"]["error_code"] == "invalid_prompt"


def test_an_existing_table_is_replaced_as_every_file(place: Path, tmp_path: Path) -> None:
    table = tmp_path / "existing.csv"
    table.write_text("an earlier table")
    assert _batch(place, table).exit_code == 0
    assert "an earlier table" not in table.read_text()


# --- Shapes of the caller's own


@pytest.fixture(scope="module")
def own_shapes(place: Path) -> list[dict[str, str]]:
    """Rows of a table with a polygon and a file of shapes, beside a box."""
    polygon = [100, 200, 200, 200, 200, 250, 100, 250]
    coco = {
        "images": [{"id": 1, "file_name": "cars.png"}],
        "annotations": [
            {"id": 4, "image_id": 1, "segmentation": [polygon]},
            {"id": 5, "image_id": 1, "segmentation": [[10, 10, 60, 10, 60, 60]]},
        ],
    }
    (place / "coco.json").write_text(json.dumps(coco))
    (place / "own.csv").write_text(
        "file,polygon,shapes,x1,y1,x2,y2,name\n"
        f"photos/cars.png,{' '.join(map(str, polygon))},,,,,,mine\n"
        "photos/cars.png,,coco.json,,,,,annotation\n"
        "photos/cars.png,,none.json,,,,,missing\n"
        "photos/cars.png,,,96,196,204,254,box\n"
    )
    result = _batch(place, place / "own_out.csv", table="own.csv")
    assert result.exit_code == 0, result.output
    with (place / "own_out.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_each_shape_of_a_file_has_a_row(own_shapes: list[dict[str, str]]) -> None:
    names = [(row["name"], row["kind"]) for row in own_shapes]
    assert names == [
        ("mine", "polygon"),
        ("annotation 4", "shapes"),
        ("annotation 5", "shapes"),
        ("missing", "shapes"),
        ("box", "box"),
    ]


def test_shapes_have_areas_and_no_score(own_shapes: list[dict[str, str]]) -> None:
    mine, same, other, _, _ = own_shapes
    gsd = float(mine["gsd_m_per_px"])
    assert float(mine["area_m2"]) == pytest.approx(5000 * gsd**2)
    assert same["area_m2"] == mine["area_m2"]
    assert float(other["area_m2"]) == pytest.approx(1250 * gsd**2)
    assert {row["mask_score"] for row in (mine, same, other)} == {""}


def test_a_missing_file_of_shapes_concerns_its_own_row(own_shapes: list[dict[str, str]]) -> None:
    assert own_shapes[3]["error_code"] == "invalid_prompt"


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("1 2 3,,,", "line 2: the polygon has an odd number"),
        ("1 2 x,,,", "line 2: polygon is '1 2 x'"),
        ("1 2 3 4 5 6,coco.json,,", "line 2: polygon and shapes are given"),
        ("1 2 3 4 5 6,,7,", "line 2: polygon and x1 are given"),
        (",coco.json,,line", "line 2: kind is 'line' beside a shapes"),
    ],
)
def test_a_bad_shape_names_its_line(place: Path, tmp_path: Path, row: str, message: str) -> None:
    table = f"file,polygon,shapes,x1,kind\nphotos/cars.png,{row}\n"
    (place / "bad.csv").write_text(table)
    result = _batch(place, tmp_path / "out.csv", table="bad.csv")
    assert result.exit_code == 2
    assert message in result.stderr


# --- Maps


def test_a_map_of_plain_images_is_in_pixels(place: Path, tmp_path: Path) -> None:
    assert _batch(place, tmp_path / "out.geojson").exit_code == 0
    collection = json.loads((tmp_path / "out.geojson").read_text())
    facts = [feature["properties"] for feature in collection["features"]]
    assert [row["name"] for row in facts if row["distance_m"]] == ["road"]
    measured = {(row["photograph"], row["name"], row["status"]) for row in facts}
    assert measured > {("photos/cars.png", "=pool", "ok")}
    assert "pixel" in collection["crs"]["properties"]["name"]


@pytest.fixture
def georeferenced(place: Path, tmp_path: Path) -> Path:
    """A folder with a georeferenced image and a plain one."""
    pixels = cv2.imread(str(place / "photos/cars.png"))
    assert pixels is not None
    shape = {"width": 800, "height": 600, "count": 3, "dtype": "uint8", "photometric": "RGB"}
    position = {"crs": "EPSG:32633", "transform": Affine(0.15, 0, 500_000, 0, -0.15, 5_000_000)}
    (tmp_path / "photos").mkdir()
    with rasterio.open(tmp_path / "photos/a.tif", "w", "GTiff", **position, **shape) as file:
        file.write(pixels[:, :, ::-1].transpose(2, 0, 1))
    cv2.imwrite(str(tmp_path / "photos/plain.png"), pixels)
    (tmp_path / "painted.onnx").symlink_to(place / "painted.onnx")
    one = "photos/a.tif,line,0,0,100,0,\n"
    other = "photos/plain.png,line,0,0,100,0,\n"
    (tmp_path / "one.csv").write_text(_HEADER + one)
    (tmp_path / "two.csv").write_text(_HEADER + one + other)
    return tmp_path


def test_a_map_of_georeferenced_images_is_in_degrees(georeferenced: Path) -> None:
    output = georeferenced / "one.geojson"
    assert _batch(georeferenced, output, table="one.csv").exit_code == 0
    (line,) = json.loads(output.read_text())["features"]
    (west, north), (east, _) = line["geometry"]["coordinates"]
    assert (west, north) == pytest.approx((15, 45.15), abs=0.01)
    assert east > west


def test_a_map_of_georeferenced_with_plain_images_is_refused(georeferenced: Path) -> None:
    output = georeferenced / "two.geojson"
    both = _batch(georeferenced, output, table="two.csv")
    assert both.exit_code == 2
    assert "some images are georeferenced" in both.stderr
    assert not output.exists()


# --- Errors


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("photos/cars.png,circle,1,1,2,2,\n", "line 2: kind is 'circle': use box, point, line"),
        ("photos/cars.png,line,1,1,,,\n", "line 2: a line has 2 numbers"),
        (",box,1,1,2,2,\n", "line 2: the photograph is not named"),
        ("photos/cars.png,box,one,1,2,2,\n", "line 2: x1 is 'one': use a number"),
        ("photos/other.png,box,1,1,2,2,\n", "which is not one of the images"),
        ("", "has no target"),
    ],
)
def test_an_invalid_table_is_refused_before_the_work(
    place: Path, tmp_path: Path, rows: str, words: str
) -> None:
    (place / "wrong.csv").write_text(_HEADER + rows)
    result = _batch(place, tmp_path / "out.csv", table="wrong.csv")
    assert result.exit_code == 2
    assert words in result.stderr
    assert not (tmp_path / "out.csv").exists()


def test_options_of_other_runs_are_refused(place: Path, tmp_path: Path) -> None:
    result = _batch(place, tmp_path / "out.csv", "--workers", "1")
    assert result.exit_code == 2
    assert "--measure excludes" in result.stderr


def test_a_map_without_targets_is_refused(place: Path, tmp_path: Path) -> None:
    arguments = ["batch", str(place / "photos"), "-o", str(tmp_path / "out.geojson")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert "holds the targets of --measure" in result.stderr
