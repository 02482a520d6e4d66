from __future__ import annotations

import struct
import tomllib
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from tests.skill.imagery.files import exif, jpeg, png_with_xmp, read_metadata, webp_with_exif, xmp
from vehanchor.imagery.formats.ifd import in_memory
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.metadata.exif import read_exif
from vehanchor.imagery.metadata.sensors import Sensor, sensor_of
from vehanchor.imagery.sources.opening import open_raster

DJI = {"drone-dji": "http://www.dji.com/drone-dji/1.0/"}
PIX4D = {"Camera": "http://pix4d.com/camera/1.0/"}
NADIR_DJI = (
    'drone-dji:RelativeAltitude="+98.90" drone-dji:AbsoluteAltitude="+336.66" '
    'drone-dji:GimbalPitchDegree="-89.90" '
    'drone-dji:GimbalRollDegree="+0.00" drone-dji:GimbalYawDegree="+37.10"'
)
PHANTOM = exif(
    {
        "Make": "DJI",
        "FocalLength": 4.7,
        "FocalLengthIn35mmFilm": 26,
        "PixelXDimension": 80,
        "PixelYDimension": 60,
    }
)


def _camera(data: bytes) -> CameraMetadata:
    camera = read_metadata(data)
    assert camera is not None
    return camera


class MakerCase(NamedTuple):
    """Metadata in a maker's form, and the camera that they describe."""

    make: str
    namespaces: dict[str, str]
    properties: str
    height_m: float | None = None
    off_nadir_deg: float | None = None
    focal_px: float | None = None


CASES = [
    MakerCase(
        "DJI",
        DJI,
        NADIR_DJI + ' drone-dji:CalibratedFocalLength="3666.67"',
        height_m=98.9,
        off_nadir_deg=0.1,
        focal_px=3666.67,
    ),
    MakerCase("Autel Robotics", DJI, NADIR_DJI, height_m=98.9, off_nadir_deg=0.1),
    MakerCase(
        "Autel Robotics",
        {"drone": "http://www.autelrobotics.com/autel-drone/1.0/"},
        'drone:RelativeAltitude="61.5" drone:GimbalPitchDegree="-80" drone:GimbalYawDegree="5"',
        height_m=61.5,
        off_nadir_deg=10.0,
    ),
    MakerCase(
        "Autel Robotics",
        PIX4D,
        'Camera:AboveGroundAltitude="40" Camera:Pitch="-90" Camera:Roll="0"',
        height_m=40,
        off_nadir_deg=0,
    ),
    MakerCase(
        "Skydio",
        {"drone-skydio": "https://www.skydio.com/drone-skydio/1.0/"},
        "<drone-skydio:RelativeAltitude>31.25</drone-skydio:RelativeAltitude>"
        "<drone-skydio:CalibratedFocalLengthX>2376.5625</drone-skydio:CalibratedFocalLengthX>"
        '<drone-skydio:CameraOrientationNED rdf:parseType="Resource">'
        "<drone-skydio:Yaw>12</drone-skydio:Yaw>"
        "<drone-skydio:Pitch>-85</drone-skydio:Pitch><drone-skydio:Roll>0</drone-skydio:Roll>"
        "</drone-skydio:CameraOrientationNED>",
        height_m=31.25,
        off_nadir_deg=5.0,
        focal_px=2376.5625,
    ),
    MakerCase(
        "Parrot",
        {**PIX4D, "drone-parrot": "http://www.parrot.com/drone-parrot/1.0/"},
        'Camera:AboveGroundAltitude="655360/13107" drone-parrot:CameraPitchDegree="-90.0" '
        'drone-parrot:CameraRollDegree="0.4" drone-parrot:CameraYawDegree="17"',
        height_m=50.0,
        off_nadir_deg=0.0,
    ),
    MakerCase(
        "senseFly",
        {"Camera": "http://pix4d.com/camera/1.0"},
        "<Camera:AboveGroundAltitude>120.5 m</Camera:AboveGroundAltitude>"
        "<Camera:Pitch>-3</Camera:Pitch><Camera:Roll>4</Camera:Roll>",
        height_m=120.5,
        off_nadir_deg=5.0,
    ),
    MakerCase("GoPro", {}, ""),
]


@pytest.fixture(params=CASES, ids=lambda case: case.make)
def case(request: pytest.FixtureRequest) -> MakerCase:
    maker_case: MakerCase = request.param
    return maker_case


@pytest.fixture
def camera(case: MakerCase) -> CameraMetadata:
    tags = {"Make": case.make, "Model": "Fly", "FocalLength": 4.5, "FocalLengthIn35mmFilm": 24}
    packet = xmp(case.namespaces, case.properties)
    return _camera(jpeg(exif=exif(tags, order=">"), xmp=packet))


def test_every_makers_height_is_read(case: MakerCase, camera: CameraMetadata) -> None:
    expected = None if case.height_m is None else pytest.approx(case.height_m, rel=1e-4)
    assert camera.height_m == expected


def test_every_makers_attitude_is_read(case: MakerCase, camera: CameraMetadata) -> None:
    expected = None if case.off_nadir_deg is None else pytest.approx(case.off_nadir_deg, abs=0.01)
    assert camera.off_nadir_deg == expected


def test_every_makers_focal_length_is_read(case: MakerCase, camera: CameraMetadata) -> None:
    assert camera.focal_px == case.focal_px


def test_exif_is_read_beside_every_makers_names(case: MakerCase, camera: CameraMetadata) -> None:
    assert (camera.make, camera.focal_mm, camera.focal_35mm) == (case.make, 4.5, 24.0)
    assert camera.refused == ""


FOCAL_PLANE = {
    "FocalPlaneXResolution": (1_639_344, 100),
    "FocalPlaneResolutionUnit": 2,
    "PixelXDimension": 4000,
}


@pytest.mark.parametrize(
    ("tags", "pixel_mm"),
    [
        pytest.param({"PixelYDimension": 3000}, 0.001549, id="per inch"),
        pytest.param({"FocalPlaneResolutionUnit": 3}, 6.1e-4, id="per cm"),
        pytest.param(
            {"FocalPlaneXResolution": (74_627, 100), "FocalPlaneResolutionUnit": 4},
            0.00134,
            id="per mm, Parrot Sequoia",
        ),
    ],
)
def test_the_pixel_pitch_comes_from_the_focal_plane(
    tags: dict[str, object], pixel_mm: float
) -> None:
    camera = _camera(jpeg(exif=exif({**FOCAL_PLANE, **tags})))
    assert camera.pixel_mm == pytest.approx(pixel_mm, rel=1e-3)


def test_a_height_above_the_sea_is_not_used() -> None:
    properties = 'drone-dji:AbsoluteAltitude="+336.66" drone-dji:GimbalPitchDegree="-90"'
    assert _camera(jpeg(xmp=xmp(DJI, properties))).height_m is None


def _laser_m(status: str, distance: str) -> float | None:
    """Distance by a laser, in metadata in the form of a Matrice 30."""
    properties = f'drone-dji:LRFStatus="{status}" drone-dji:LRFTargetDistance="{distance}"'
    return _camera(jpeg(exif=PHANTOM, xmp=xmp(DJI, properties))).laser_m


def test_the_distance_of_a_laser_that_measured_is_read() -> None:
    assert _laser_m("Normal", "54.103") == 54.103


@pytest.mark.parametrize(
    ("status", "distance"),
    [("TooFar", "0.000"), ("TooFar", "54.1"), ("", "54.1"), ("Normal", "0"), ("Normal", "1.2")],
)
def test_a_laser_that_did_not_measure_is_not_used(status: str, distance: str) -> None:
    assert _laser_m(status, distance) is None


NADIR_PACKET = xmp(DJI, NADIR_DJI)
TIFF = exif(
    {
        "ImageWidth": 80,
        "ImageLength": 60,
        "Make": "DJI",
        "ApplicationNotes": NADIR_PACKET,
        "FocalLengthIn35mmFilm": 26,
    }
)


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(png_with_xmp(NADIR_PACKET, PHANTOM), id="PNG"),
        pytest.param(webp_with_exif(PHANTOM, NADIR_PACKET), id="WebP"),
        pytest.param(TIFF, id="TIFF"),
    ],
)
def test_other_formats_carry_metadata_too(data: bytes) -> None:
    camera = _camera(data)
    assert (camera.make, camera.height_m, camera.focal_35mm) == ("DJI", 98.9, 26.0)


@pytest.mark.parametrize("read", [Path, Path.read_bytes])
def test_an_open_image_has_its_camera(read: Callable[[Path], Any], tmp_path: Path) -> None:
    path = tmp_path / "photo.jpg"
    path.write_bytes(jpeg(exif=PHANTOM, xmp=NADIR_PACKET))
    with open_raster(read(path)) as raster:
        assert raster.camera is not None
        assert raster.camera.height_m == 98.9


def test_an_image_without_metadata_has_no_camera() -> None:
    with open_raster(jpeg()) as raster:
        assert raster.camera is None


LAUGHS = "".join(f'<!ENTITY l{k} "&l{k - 1};&l{k - 1};&l{k - 1};&l{k - 1};">' for k in range(1, 20))


@pytest.mark.parametrize(
    "before",
    [
        f'<!DOCTYPE x [<!ENTITY l0 "ha">{LAUGHS}]>',
        '<!DOCTYPE x [<!ENTITY secret SYSTEM "file:///etc/passwd">]>',
        '<!DOCTYPE x SYSTEM "http://127.0.0.1:9/x.dtd">',
    ],
)
def test_a_packet_that_declares_entities_is_refused(before: str) -> None:
    camera = _camera(jpeg(xmp=xmp(DJI, NADIR_DJI, before=before)))
    assert camera.height_m is None
    assert "entities" in camera.refused


def _endless(n_entries: int, entry: bytes) -> bytes:
    """Make a TIFF structure that declares so many equal entries."""
    return b"II*\0" + struct.pack("<IH", 8, n_entries) + entry * min(n_entries, 5000)


HOSTILE_EXIF = pytest.mark.parametrize(
    "block",
    [
        pytest.param(
            _endless(65535, struct.pack("<HHII", 0x8769, 4, 1, 8)),
            id="directories that point to themselves",
        ),
        pytest.param(
            _endless(65535, struct.pack("<HHII", 0x010F, 2, 0xFFFFFFFF, 0)), id="a name of 4 GB"
        ),
        pytest.param(
            _endless(3, struct.pack("<HHII", 0x920A, 5, 0xFFFFFFFF, 0xFFFFFFF0)),
            id="values behind the end",
        ),
        pytest.param(
            _endless(2, struct.pack("<HHII", 0x02BC, 1, 0xFFFFFFF0, 8)), id="notes of 4 GB"
        ),
        pytest.param(b"II*\0" + struct.pack("<I", 0xFFFFFFFF), id="a directory behind the end"),
        pytest.param(b"II*\0\x08", id="cut off"),
        pytest.param(b"", id="empty"),
    ],
)


@HOSTILE_EXIF
def test_hostile_exif_is_read_by_few_small_reads(block: bytes) -> None:
    sizes: list[int] = []
    read = in_memory(block)

    def read_at(offset: int, count: int) -> bytes:
        part = read(offset, count)
        sizes.append(len(part))
        return part

    read_exif(read_at)
    assert len(sizes) <= 10
    assert sum(sizes) <= 10_000


@HOSTILE_EXIF
def test_hostile_exif_gives_no_height(block: bytes) -> None:
    camera = read_metadata(jpeg(exif=block))
    assert camera is None or camera.height_m is None


@HOSTILE_EXIF
def test_an_image_with_hostile_exif_opens(block: bytes) -> None:
    with open_raster(jpeg(exif=block)) as raster:
        assert (raster.width_px, raster.height_px) == (80, 60)


POSITION = {
    "GPSLatitudeRef": "N",
    "GPSLatitude": (41, 1, 25, 1, 4325, 100),
    "GPSLongitudeRef": "W",
    "GPSLongitude": (81, 1, 36, 1, 2118, 100),
}
LATITUDE_DEG = 41 + 25 / 60 + 43.25 / 3600
LONGITUDE_DEG = 81 + 36 / 60 + 21.18 / 3600


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_position_is_read_in_degrees(order: str) -> None:
    camera = _camera(jpeg(exif=exif(POSITION, order)))
    assert camera.latitude_deg == pytest.approx(LATITUDE_DEG)
    assert camera.longitude_deg == pytest.approx(-LONGITUDE_DEG)


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_hemispheres_give_the_signs(order: str) -> None:
    tags = {**POSITION, "GPSLatitudeRef": "S", "GPSLongitudeRef": "E"}
    camera = _camera(jpeg(exif=exif(tags, order)))
    assert camera.latitude_deg == pytest.approx(-LATITUDE_DEG)
    assert camera.longitude_deg == pytest.approx(LONGITUDE_DEG)


@pytest.mark.parametrize(
    "damage",
    [
        {"GPSLatitude": (0, 1, 0, 1, 0, 1), "GPSLongitude": (0, 1, 0, 1, 0, 1)},  # no fix
        {"GPSLatitude": (91, 1, 0, 1, 0, 1)},
        {"GPSLatitude": (41, 0, 0, 1, 0, 1)},
        {"GPSLatitude": (41, 1, 7, 0, 0, 1)},
        {"GPSLongitude": (181, 1, 0, 1, 0, 1)},
    ],
)
def test_an_invalid_position_is_not_used(damage: dict[str, object]) -> None:
    camera = _camera(jpeg(exif=exif({"Make": "DJI", **POSITION, **damage})))
    assert camera.latitude_deg is None


@pytest.mark.parametrize("longitude", ["GpsLongitude", "GpsLongtitude"])
def test_a_position_in_xmp_alone_is_read(longitude: str) -> None:
    packet = xmp(DJI, f'drone-dji:GpsLatitude="-41.5" drone-dji:{longitude}="+81.25"')
    camera = _camera(jpeg(exif=exif({"Make": "DJI"}), xmp=packet))
    assert (camera.latitude_deg, camera.longitude_deg) == (-41.5, 81.25)


def test_the_position_in_exif_goes_first() -> None:
    packet = xmp(DJI, 'drone-dji:GpsLatitude="-41.5" drone-dji:GpsLongitude="+81.25"')
    camera = _camera(jpeg(exif=exif(POSITION), xmp=packet))
    assert camera.latitude_deg == pytest.approx(LATITUDE_DEG)


TABLE_TEXT = files("vehanchor.imagery.metadata").joinpath("sensors.toml").read_text("utf-8")
CAMERAS = tomllib.loads(TABLE_TEXT)["camera"]
MODELS = [
    pytest.param(camera, model, id=f"{camera['make']} {model}")
    for camera in CAMERAS
    for model in camera["models"]
]


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera["name"])
def test_every_camera_of_the_table_has_a_model(camera: dict[str, Any]) -> None:
    assert camera["models"]


def _sensor(make: str, model: str) -> Sensor:
    sensor = sensor_of(make, model)
    assert sensor is not None
    return sensor


@pytest.mark.parametrize(("camera", "model"), MODELS)
def test_every_camera_is_found_by_its_names_in_exif(camera: dict[str, Any], model: str) -> None:
    make = f"{camera['make']} Robotics".upper()
    assert _sensor(make, f" {model} ").name == camera["name"]


@pytest.mark.parametrize(("camera", "model"), MODELS)
def test_every_sensor_has_a_source(camera: dict[str, Any], model: str) -> None:
    assert _sensor(camera["make"], model).source


@pytest.mark.parametrize(("camera", "model"), MODELS)
def test_every_sensor_has_a_plausible_size(camera: dict[str, Any], model: str) -> None:
    sensor = _sensor(camera["make"], model)
    assert 4 < sensor.width_mm < 37
    assert 1.3 < sensor.width_mm / sensor.height_mm < 1.52


@pytest.mark.parametrize(("camera", "model"), MODELS)
def test_every_sensor_has_plausible_focal_lengths(camera: dict[str, Any], model: str) -> None:
    sensor = _sensor(camera["make"], model)
    assert 0 < sensor.focal_from_mm <= sensor.focal_to_mm


FIXED = ("DJI", "FC3170")
ZOOM = ("DJI", "FC2204")


@pytest.mark.parametrize(
    ("camera", "stated_mm", "focal_mm"),
    [
        pytest.param(FIXED, 4.5, 4.5, id="fixed lens"),
        pytest.param(FIXED, 9.1, None, id="another lens"),
        pytest.param(FIXED, None, pytest.approx(4.5), id="fixed lens, not stated"),
        pytest.param(ZOOM, 8.6, 8.6, id="zoom"),
        pytest.param(ZOOM, None, None, id="zoom, not stated"),
    ],
)
def test_the_stated_focal_length_must_fit_the_lens(
    camera: tuple[str, str], stated_mm: float | None, focal_mm: Any
) -> None:
    assert _sensor(*camera).focal_mm(stated_mm) == focal_mm
