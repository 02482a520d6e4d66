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

    from vehanchor_flight.reconstruction.model import Reconstruction

HALF = math.sqrt(0.5)
CAMERAS = (
    "# comment\n1 SIMPLE_RADIAL 800 600 700 400 300 -0.02\n7 PINHOLE 800 600 700 690 410 295\n"
)
IMAGES = (
    f"# comment\n1 {HALF} {HALF} 0 0 1.5 -2 30 1 a b.jpg\n10 20 -1 30 40 5\n"
    "2 1 0 0 0 0 0 0 7 deep/c.jpg\n\n"  # no points
)
POINTS = "5 1 2 3 10 20 30 0.5 1 0 2 1\n6 -4 5 6.5 10 20 30 0.5\n"


CONTENTS = {"cameras": CAMERAS, "images": IMAGES, "points3D": POINTS}


def _write_text(folder: Path) -> Path:
    folder.mkdir()
    for name, text in CONTENTS.items():
        (folder / f"{name}.txt").write_text(text)
    return folder


def _write_binary(folder: Path) -> Path:
    """Write the model of ``_write_text`` as binary files."""
    folder.mkdir()
    count = struct.Struct("<Q")
    camera = struct.Struct("<IiQQ4d")
    pose = struct.Struct("<I7dI")
    point_of_image = struct.Struct("<ddq")
    point = struct.Struct("<Q3d3BdQ")
    contents = {
        "cameras": [
            count.pack(2),
            camera.pack(1, 2, 800, 600, 700, 400, 300, -0.02),
            camera.pack(7, 1, 800, 600, 700, 690, 410, 295),
        ],
        "images": [
            count.pack(2),
            pose.pack(1, HALF, HALF, 0, 0, 1.5, -2, 30, 1),
            b"a b.jpg\0",
            count.pack(2),
            point_of_image.pack(10, 20, -1),
            point_of_image.pack(30, 40, 5),
            pose.pack(2, 1, 0, 0, 0, 0, 0, 0, 7),
            b"deep/c.jpg\0",
            count.pack(0),
        ],
        "points3D": [
            count.pack(2),
            point.pack(5, 1, 2, 3, 10, 20, 30, 0.5, 2),
            struct.pack("<4I", 1, 0, 2, 1),
            point.pack(6, -4, 5, 6.5, 10, 20, 30, 0.5, 0),
        ],
    }
    for name, parts in contents.items():
        (folder / f"{name}.bin").write_bytes(b"".join(parts))
    return folder


WRITERS = {"text": _write_text, "binary": _write_binary}


@pytest.fixture(params=WRITERS)
def colmap(request: pytest.FixtureRequest, tmp_path: Path) -> Reconstruction:
    """Read a model of COLMAP, once from text and once from binary files."""
    write = WRITERS[request.param]
    return read_model(write(tmp_path / "model"))


def test_both_formats_of_colmap_have_the_poses(colmap: Reconstruction) -> None:
    assert [shot.name for shot in colmap.shots] == ["a b.jpg", "deep/c.jpg"]
    first = colmap.shots[0]
    quarter_turn = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    assert first.rotation == pytest.approx(quarter_turn)
    assert first.translation == pytest.approx([1.5, -2, 30])


def test_both_formats_of_colmap_have_the_lenses(colmap: Reconstruction) -> None:
    first, second = colmap.shots
    assert first.lens.distortion == (-0.02,)
    assert second.lens.focal_y_px == 690


def test_both_formats_of_colmap_have_the_points(colmap: Reconstruction) -> None:
    assert colmap.points == pytest.approx(np.array([[1.0, 2, 3], [-4, 5, 6.5]]))


def test_a_rescaled_colmap_model_differs_in_its_lengths_alone(
    colmap: Reconstruction, tmp_path: Path
) -> None:
    new = read_model(write_rescaled(colmap, tmp_path / "new", 2.5))
    assert new.kind == colmap.kind
    assert new.points == pytest.approx(2.5 * colmap.points)
    for before, after in zip(colmap.shots, new.shots, strict=True):
        assert after.centre == pytest.approx(2.5 * before.centre)
        assert after.rotation == pytest.approx(before.rotation)
        assert after.name == before.name
        assert after.lens == before.lens


def test_a_project_is_not_written_into_a_full_folder(
    colmap: Reconstruction, tmp_path: Path
) -> None:
    write_rescaled(colmap, tmp_path / "new", 2.5)
    with pytest.raises(OutputError, match="not empty"):
        write_rescaled(colmap, tmp_path / "new", 2.5)


def test_fields_of_colmap_may_be_several_blanks_apart(tmp_path: Path) -> None:
    folder = _write_text(tmp_path / "old")
    for file in folder.iterdir():
        rows = []
        for row in file.read_text().splitlines():
            rows.append(row if row.startswith("#") else row.replace(" ", "  "))
        # The blank in the name belongs to it.
        file.write_text("\n".join(rows).replace("a  b.jpg", "a b.jpg") + "\n")
    old = read_model(folder)
    new = read_model(write_rescaled(old, tmp_path / "new", 2.5))
    assert new.points == pytest.approx(2.5 * old.points)
    assert [shot.name for shot in new.shots] == ["a b.jpg", "deep/c.jpg"]
    for before, after in zip(old.shots, new.shots, strict=True):
        assert after.centre == pytest.approx(2.5 * before.centre)


@pytest.mark.parametrize("damaged", ["cameras.bin", "images.bin", "points3D.bin"])
def test_a_file_that_is_cut_off_is_refused(tmp_path: Path, damaged: str) -> None:
    folder = _write_binary(tmp_path / "model")
    whole = (folder / damaged).read_bytes()
    for end in (0, 5, len(whole) // 2, len(whole) - 3):
        (folder / damaged).write_bytes(whole[:end])
        with pytest.raises(ReconstructionError):
            read_model(folder)


def test_a_damaged_file_of_opensfm_is_named(tmp_path: Path) -> None:
    (tmp_path / "reconstruction.json").write_text('[{"shots": {"a": {}}, "cameras": {}}]')
    with pytest.raises(ReconstructionError, match="whole reconstruction"):
        read_model(tmp_path)


def test_a_camera_of_opensfm_without_a_size_is_named(tmp_path: Path) -> None:
    camera = {"width": 0, "height": 0, "focal": 0.8}
    shot = {"camera": "c", "rotation": [0, 0, 0], "translation": [0, 0, 0]}
    part = {"cameras": {"c": camera}, "shots": {"a.jpg": shot}}
    (tmp_path / "reconstruction.json").write_text(json.dumps([part]))
    with pytest.raises(ReconstructionError, match="0 x 0 px"):
        read_model(tmp_path)


def test_a_folder_without_a_model_is_named(tmp_path: Path) -> None:
    with pytest.raises(ReconstructionError, match="no reconstruction in"):
        read_model(_write_binary(tmp_path / "whole") / "none")


def _write_project(folder: Path, poses: list[Pose], metres_per_unit: float) -> Path:
    """Write a project of OpenSfM without cars; return its folder."""
    photographs = [pose.painted(np.zeros((0, 4))) for pose in poses]
    write_opensfm(folder, photographs, poses=poses, metres_per_unit=metres_per_unit)
    return folder


POSES = [Pose(50, 60, 40, 12, 30), Pose(70, 60, 44)]


@pytest.fixture
def opensfm(tmp_path: Path) -> Reconstruction:
    """Read a model of OpenSfM at 0.8 m a unit."""
    return read_model(_write_project(tmp_path / "project", POSES, 0.8))


def test_opensfm_is_read(opensfm: Reconstruction) -> None:
    first = opensfm.shots[0]
    assert 0.8 * first.centre == pytest.approx([50, -60, 40])
    assert first.rotation == pytest.approx(POSES[0].rotation)


def test_photographs_of_opensfm_are_found(opensfm: Reconstruction) -> None:
    assert images_of(opensfm).name == "images"


def test_opensfm_is_rescaled(opensfm: Reconstruction, tmp_path: Path) -> None:
    new = read_model(write_rescaled(opensfm, tmp_path / "new", 0.8))
    assert new.shots[1].centre == pytest.approx([70, -60, 44])
    assert new.points == pytest.approx(0.8 * opensfm.points)


def test_a_rescaled_project_keeps_its_place_on_earth(
    opensfm: Reconstruction, tmp_path: Path
) -> None:
    file = write_rescaled(opensfm, tmp_path / "new", 0.8)
    (part,) = json.loads(file.read_text())
    assert part["reference_lla"]["altitude"] == 500


def test_geo_txt_moves_the_cameras_apart(tmp_path: Path) -> None:
    poses = [Pose(0, 0, 40), Pose(100, 0, 40), Pose(0, 100, 40), Pose(100, 100, 40)]
    model = read_model(_write_project(tmp_path / "project", poses, 1.0))
    write_geo(tmp_path / "geo.txt", model, 1.1)
    header, *rows = (tmp_path / "geo.txt").read_text().splitlines()
    assert header == "EPSG:4326"
    cells = [row.split() for row in rows]
    assert [name for name, *_ in cells] == ["0.png", "1.png", "2.png", "3.png"]
    longitude, latitude, altitude = np.array([row[1:] for row in cells], dtype=np.float64).T
    # Radii of curvature of the ellipsoid at 46 degrees, and 500 m above it.
    parallel_radius_m = 6_389_000 * math.cos(math.radians(46))
    meridian_radius_m = 6_368_000
    east_m = math.radians(longitude[1] - longitude[0]) * parallel_radius_m
    north_m = math.radians(latitude[0] - latitude[2]) * meridian_radius_m
    assert (east_m, north_m) == pytest.approx((110, 110), abs=0.2)
    assert altitude == pytest.approx(np.full(4, 540), abs=0.01)


def test_positions_on_earth_are_those_of_proj() -> None:
    warp = pytest.importorskip("rasterio.warp")
    crs = pytest.importorskip("rasterio.crs")
    points = np.array([[0.0, 0, 0], [500, 0, 0], [0, -700, 20]])
    latitude, longitude, altitude = on_earth(points, (46.0, 7.0, 500.0)).T
    local = crs.CRS.from_proj4("+proj=aeqd +lat_0=46 +lon_0=7 +ellps=WGS84 +units=m")
    x, y = warp.transform("EPSG:4326", local, longitude.tolist(), latitude.tolist())
    # That plane lies at sea level.
    shrinking = 1 + 500 / 6_380_000
    assert np.column_stack([x, y]) * shrinking == pytest.approx(points[:, :2], abs=0.02)
    assert altitude == pytest.approx([500, 500.02, 520.04], abs=0.01)
