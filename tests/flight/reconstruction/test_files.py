from __future__ import annotations

import json
import math
import struct
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.flight.reconstruction.flights import Pose, write_opensfm
from vehanchor.errors import OutputError, ReconstructionError
from vehanchor_flight.reconstruction.files import (
    images_of,
    on_earth,
    read_model,
    write_geo,
    write_rescaled,
)

if TYPE_CHECKING:
    from pathlib import Path

HALF = math.sqrt(0.5)
CAMERAS = (
    "# comment\n1 SIMPLE_RADIAL 800 600 700 400 300 -0.02\n7 PINHOLE 800 600 700 690 410 295\n"
)
IMAGES = (
    f"# comment\n1 {HALF} {HALF} 0 0 1.5 -2 30 1 a b.jpg\n10 20 -1 30 40 5\n"
    "2 1 0 0 0 0 0 0 7 deep/c.jpg\n\n"  # no points
)
POINTS = "5 1 2 3 10 20 30 0.5 1 0 2 1\n6 -4 5 6.5 10 20 30 0.5\n"


def _text(folder: Path) -> Path:
    folder.mkdir()
    for name, text in (("cameras", CAMERAS), ("images", IMAGES), ("points3D", POINTS)):
        (folder / f"{name}.txt").write_text(text)
    return folder


def _binary(folder: Path) -> Path:
    folder.mkdir()
    cameras = struct.pack("<Q", 2) + struct.pack("<IiQQ4d", 1, 2, 800, 600, 700, 400, 300, -0.02)
    cameras += struct.pack("<IiQQ4d", 7, 1, 800, 600, 700, 690, 410, 295)
    images = (
        struct.pack("<Q", 2)
        + struct.pack("<I7dI", 1, HALF, HALF, 0, 0, 1.5, -2, 30, 1)
        + b"a b.jpg\0"
    )
    images += (
        struct.pack("<Q", 2) + struct.pack("<ddq", 10, 20, -1) + struct.pack("<ddq", 30, 40, 5)
    )
    images += (
        struct.pack("<I7dI", 2, 1, 0, 0, 0, 0, 0, 0, 7) + b"deep/c.jpg\0" + struct.pack("<Q", 0)
    )
    points = struct.pack("<Q", 2) + struct.pack("<Q3d3BdQ", 5, 1, 2, 3, 10, 20, 30, 0.5, 2)
    points += struct.pack("<4I", 1, 0, 2, 1) + struct.pack(
        "<Q3d3BdQ", 6, -4, 5, 6.5, 10, 20, 30, 0.5, 0
    )
    for name, found in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.bin").write_bytes(found)
    return folder


@pytest.mark.parametrize("write", [_text, _binary])
def test_both_formats_of_colmap_are_read(tmp_path: Path, write: object) -> None:
    model = read_model(write(tmp_path / "model"))  # type: ignore[operator]
    assert [shot.name for shot in model.shots] == ["a b.jpg", "deep/c.jpg"]
    first, second = model.shots
    assert first.rotation == pytest.approx(np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]))
    assert first.translation == pytest.approx([1.5, -2, 30])
    assert first.lens.distortion == (-0.02,)
    assert second.lens.focal_y_px == 690
    assert model.points == pytest.approx(np.array([[1.0, 2, 3], [-4, 5, 6.5]]))


def test_fields_of_colmap_may_be_several_blanks_apart(tmp_path: Path) -> None:
    folder = _text(tmp_path / "old")
    for file in folder.iterdir():
        rows = [
            row if row.startswith("#") else row.replace(" ", "  ")
            for row in file.read_text().splitlines()
        ]
        file.write_text("\n".join(rows).replace("a  b.jpg", "a b.jpg") + "\n")
    old = read_model(folder)
    new = read_model(write_rescaled(old, tmp_path / "new", 2.5))
    assert new.points == pytest.approx(2.5 * old.points)
    assert [shot.name for shot in new.shots] == ["a b.jpg", "deep/c.jpg"]
    assert [shot.centre for shot in new.shots] == [
        pytest.approx(2.5 * shot.centre) for shot in old.shots
    ]


def test_damaged_files_are_refused_and_named(tmp_path: Path) -> None:
    whole = {path.name: path.read_bytes() for path in _binary(tmp_path / "whole").iterdir()}
    for name, found in whole.items():
        for end in (0, 5, len(found) // 2, len(found) - 3):
            folder = tmp_path / f"{name}{end}"
            folder.mkdir()
            for each, full in whole.items():
                (folder / each).write_bytes(full[:end] if each == name else full)
            with pytest.raises(ReconstructionError):
                read_model(folder)
    (tmp_path / "reconstruction.json").write_text('[{"shots": {"a": {}}, "cameras": {}}]')
    with pytest.raises(ReconstructionError, match="whole reconstruction"):
        read_model(tmp_path)
    with pytest.raises(ReconstructionError, match="no reconstruction in"):
        read_model(tmp_path / "whole" / "none")


def test_opensfm_is_read_and_rescaled(tmp_path: Path) -> None:
    poses = [Pose(50, 60, 40, 12, 30), Pose(70, 60, 44)]
    blank = [pose.painted(np.zeros((0, 4))) for pose in poses]
    write_opensfm(tmp_path / "project", blank, poses=poses, metres_per_unit=0.8)
    model = read_model(tmp_path / "project")
    assert images_of(model).name == "images"
    assert 0.8 * model.shots[0].centre == pytest.approx([50, -60, 40])
    assert model.shots[0].rotation == pytest.approx(poses[0].rotation)
    new = read_model(write_rescaled(model, tmp_path / "new", 0.8))
    assert new.shots[1].centre == pytest.approx([70, -60, 44])
    assert new.points == pytest.approx(0.8 * model.points)
    kept = json.loads((tmp_path / "new" / "reconstruction.json").read_text())[0]
    assert kept["reference_lla"]["altitude"] == 500


def test_geo_txt_moves_the_cameras_apart(tmp_path: Path) -> None:
    poses = [Pose(0, 0, 40), Pose(100, 0, 40), Pose(0, 100, 40), Pose(100, 100, 40)]
    write_opensfm(
        tmp_path / "project",
        [pose.painted(np.zeros((0, 4))) for pose in poses],
        poses=poses,
        metres_per_unit=1.0,
    )
    write_geo(tmp_path / "geo.txt", read_model(tmp_path / "project"), 1.1)
    first, *rows = (tmp_path / "geo.txt").read_text().splitlines()
    assert first == "EPSG:4326"
    places = np.array([[float(each) for each in row.split()[1:]] for row in rows])
    assert [row.split()[0] for row in rows] == ["0.png", "1.png", "2.png", "3.png"]
    east_m = (
        (places[1, 0] - places[0, 0]) * math.radians(1) * 6_389_000 * math.cos(math.radians(46))
    )
    north_m = (places[0, 1] - places[2, 1]) * math.radians(1) * 6_368_000
    assert (east_m, north_m) == pytest.approx((110, 110), abs=0.2)
    assert places[:, 2] == pytest.approx(np.full(4, 540), abs=0.01)


def test_positions_on_earth_are_those_of_proj() -> None:
    warp = pytest.importorskip("rasterio.warp")
    crs = pytest.importorskip("rasterio.crs")
    points = np.array([[0.0, 0, 0], [500, 0, 0], [0, -700, 20]])
    found = on_earth(points, (46.0, 7.0, 500.0))
    local = crs.CRS.from_proj4("+proj=aeqd +lat_0=46 +lon_0=7 +ellps=WGS84 +units=m")
    x, y = warp.transform("EPSG:4326", local, found[:, 1].tolist(), found[:, 0].tolist())
    shrunk = 1 + 500 / 6_380_000  # that plane lies at sea level
    assert np.column_stack([x, y]) * shrunk == pytest.approx(points[:, :2], abs=0.02)
    assert found[:, 2] == pytest.approx([500, 500.02, 520.04], abs=0.01)


@pytest.mark.parametrize("write", [_text, _binary])
def test_a_rescaled_colmap_model_differs_in_its_lengths_alone(
    tmp_path: Path, write: object
) -> None:
    old = read_model(write(tmp_path / "old"))  # type: ignore[operator]
    new = read_model(write_rescaled(old, tmp_path / "new", 2.5))
    assert new.kind == old.kind
    assert new.points == pytest.approx(2.5 * old.points)
    for before, after in zip(old.shots, new.shots, strict=True):
        assert after.centre == pytest.approx(2.5 * before.centre)
        assert after.rotation == pytest.approx(before.rotation)
        assert (after.name, after.lens) == (before.name, before.lens)
    with pytest.raises(OutputError, match="not empty"):
        write_rescaled(old, tmp_path / "new", 2.5)
