"""``vehanchor batch --measure``: a table of boxes, points and lines becomes a table or a map."""

from __future__ import annotations

import csv
import json
from pathlib import Path

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
    folder = tmp_path_factory.mktemp("targets")
    (folder / "photos").mkdir()
    for name, n_cars in (("cars", 24), ("bare", 0)):
        image = pool_among_cars(n_cars, (100, 200, 200, 250))
        assert cv2.imwrite(str(folder / f"photos/{name}.png"), image[:, :, ::-1])
    (folder / "targets.csv").write_text(_HEADER + _TARGETS)
    write_detector(folder / "painted.onnx")
    return folder


def _batch(place: Path, output: Path, *options: object, table: str = "targets.csv") -> Result:
    words = [
        "batch",
        place / "photos",
        "--measure",
        place / table,
        "-o",
        output,
        "--detector",
        place / "painted.onnx",
    ]
    words += ["--rulers", "vehicles"]  # the scene-scale prior does not know painted pictures
    return CliRunner().invoke(app, [str(each) for each in (*words, *options)])


def test_each_target_has_a_row_with_metres_or_an_error(place: Path, tmp_path: Path) -> None:
    result = _batch(place, tmp_path / "out.csv")
    assert result.exit_code == 0, result.output
    assert "out.csv: 5 targets (3 ok, 1 no_scale, 1 error)" in result.stderr
    with (tmp_path / "out.csv").open(newline="") as file:
        pool, middle, road, outside, bare = list(csv.DictReader(file))
    gsd = float(pool["gsd_m_per_px"])
    assert float(pool["area_m2"]) == pytest.approx(100 * 50 * gsd**2, rel=0.15)
    assert (
        float(pool["area_ci95_low_m2"]) < float(pool["area_m2"]) < float(pool["area_ci95_high_m2"])
    )
    assert float(road["distance_m"]) == pytest.approx(400 * gsd)
    assert float(road["gsd_m_per_px"]) == gsd, "one search for all targets of an image"
    assert [each["status"] for each in (pool, middle, road, outside, bare)] == [
        *("ok", "ok", "ok", "", "no_scale")
    ]
    assert "confidence" not in middle, "the scale's confidence is not that of the measurement"
    assert float(middle["scale_confidence"]) == float(road["scale_confidence"]) > 0.5
    assert 0 <= float(middle["mask_score"]) <= 1
    assert road["mask_score"] == ""
    assert (pool["name"], outside["error_code"]) == ("'=pool", "invalid_prompt"), (
        "no formula for a spreadsheet"
    )
    again = _batch(place, tmp_path / "out.csv")
    assert (again.exit_code, "--overwrite" in again.stderr) == (2, True)


def test_outlines_and_lines_go_to_maps_in_pixels(place: Path, tmp_path: Path) -> None:
    assert _batch(place, tmp_path / "out.geojson").exit_code == 0
    collection = json.loads((tmp_path / "out.geojson").read_text())
    facts = [each["properties"] for each in collection["features"]]
    assert [each["name"] for each in facts if each["distance_m"]] == ["road"]
    assert {(each["file"], each["name"], each["status"]) for each in facts} > {
        ("photos/cars.png", "=pool", "ok")
    }
    assert "pixel" in collection["crs"]["properties"]["name"]


def test_targets_of_georeferenced_and_plain_images_go_to_different_files(
    place: Path, tmp_path: Path
) -> None:
    pixels = cv2.imread(str(place / "photos/cars.png"))
    assert pixels is not None
    shape = {"width": 800, "height": 600, "count": 3, "dtype": "uint8", "photometric": "RGB"}
    where = Affine(0.15, 0, 500_000, 0, -0.15, 5_000_000)
    (tmp_path / "photos").mkdir()
    with rasterio.open(
        tmp_path / "photos/a.tif", "w", "GTiff", crs="EPSG:32633", transform=where, **shape
    ) as file:
        file.write(pixels[:, :, ::-1].transpose(2, 0, 1))
    cv2.imwrite(str(tmp_path / "photos/plain.png"), pixels)
    (tmp_path / "painted.onnx").symlink_to(place / "painted.onnx")
    (tmp_path / "one.csv").write_text(_HEADER + "photos/a.tif,line,0,0,100,0,\n")
    (tmp_path / "two.csv").write_text(
        _HEADER + "photos/a.tif,line,0,0,100,0,\nphotos/plain.png,line,0,0,100,0,\n"
    )
    assert _batch(tmp_path, tmp_path / "one.geojson", table="one.csv").exit_code == 0
    (line,) = json.loads((tmp_path / "one.geojson").read_text())["features"]
    (west, north), (east, _) = line["geometry"]["coordinates"]
    assert (west, north) == pytest.approx((15, 45.15), abs=0.01), "degrees"
    assert east > west
    both = _batch(tmp_path, tmp_path / "two.geojson", table="two.csv")
    assert (both.exit_code, "some images are georeferenced" in both.stderr) == (2, True)
    assert not (tmp_path / "two.geojson").exists()


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        ("photos/cars.png,circle,1,1,2,2,\n", "line 2: kind is 'circle': use box, point, line"),
        ("photos/cars.png,line,1,1,,,\n", "line 2: a line has 2 numbers"),
        (",box,1,1,2,2,\n", "line 2: the file is not named"),
        ("photos/cars.png,box,one,1,2,2,\n", "line 2: x1 is 'one': use a number"),
        ("photos/other.png,box,1,1,2,2,\n", "which is not one of the images"),
        ("", "has no target"),
    ],
)
def test_a_table_that_is_wrong_is_refused_before_the_work(
    place: Path, tmp_path: Path, rows: str, words: str
) -> None:
    (place / "wrong.csv").write_text(_HEADER + rows)
    result = _batch(place, tmp_path / "out.csv", table="wrong.csv")
    assert result.exit_code == 2
    assert words in result.stderr
    assert not (tmp_path / "out.csv").exists()


def test_it_excludes_what_it_does_not_do(place: Path, tmp_path: Path) -> None:
    result = _batch(place, tmp_path / "out.csv", "--workers", "1")
    assert (result.exit_code, "--measure excludes" in result.stderr) == (2, True)
    alone = CliRunner().invoke(
        app, ["batch", str(place / "photos"), "-o", str(tmp_path / "out.geojson")]
    )
    assert (alone.exit_code, "holds the targets of --measure" in alone.stderr) == (2, True)
