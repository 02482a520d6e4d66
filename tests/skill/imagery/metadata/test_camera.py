from __future__ import annotations

import struct
import tomllib
from importlib.resources import files

import pytest

from tests.skill.imagery.files import exif, jpeg, png_with_xmp, read_metadata, webp_with_exif, xmp
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.metadata.exif import read_exif
from vehanchor.imagery.metadata.sensors import sensor_of
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


def _known(data: bytes) -> CameraMetadata:
    camera = read_metadata(data)
    assert camera is not None
    return camera


@pytest.mark.parametrize(
    ("make", "namespaces", "properties", "height_m", "off_nadir_deg", "focal_px"),
    [
        ("DJI", DJI, NADIR_DJI + ' drone-dji:CalibratedFocalLength="3666.67"', 98.9, 0.1, 3666.67),
        ("Autel Robotics", DJI, NADIR_DJI, 98.9, 0.1, None),
        (
            "Autel Robotics",
            {"drone": "http://www.autelrobotics.com/autel-drone/1.0/"},
            'drone:RelativeAltitude="61.5" drone:GimbalPitchDegree="-80" drone:GimbalYawDegree="5"',
            61.5,
            10.0,
            None,
        ),
        (
            "Autel Robotics",
            PIX4D,
            'Camera:AboveGroundAltitude="40" Camera:Pitch="-90" Camera:Roll="0"',
            40,
            0,
            None,
        ),
        (
            "Skydio",
            {"drone-skydio": "https://www.skydio.com/drone-skydio/1.0/"},
            "<drone-skydio:RelativeAltitude>31.25</drone-skydio:RelativeAltitude>"
            "<drone-skydio:CalibratedFocalLengthX>2376.5625</drone-skydio:CalibratedFocalLengthX>"
            "<drone-skydio:CameraOrientationNED "
            'rdf:parseType="Resource"><drone-skydio:Yaw>12</drone-skydio:Yaw>'
            "<drone-skydio:Pitch>-85</drone-skydio:Pitch><drone-skydio:Roll>0</drone-skydio:Roll>"
            "</drone-skydio:CameraOrientationNED>",
            31.25,
            5.0,
            2376.5625,
        ),
        (
            "Parrot",
            {**PIX4D, "drone-parrot": "http://www.parrot.com/drone-parrot/1.0/"},
            'Camera:AboveGroundAltitude="655360/13107" drone-parrot:CameraPitchDegree="-90.0" '
            'drone-parrot:CameraRollDegree="0.4" drone-parrot:CameraYawDegree="17"',
            50.0,
            0.0,
            None,
        ),
        (
            "senseFly",
            {"Camera": "http://pix4d.com/camera/1.0"},
            "<Camera:AboveGroundAltitude>120.5 "
            "m</Camera:AboveGroundAltitude><Camera:Pitch>-3</Camera:Pitch>"
            "<Camera:Roll>4</Camera:Roll>",
            120.5,
            5.0,
            None,
        ),
        ("GoPro", {}, "", None, None, None),
    ],
)
def test_every_makers_height_and_attitude_are_read(
    make: str,
    namespaces: dict[str, str],
    properties: str,
    height_m: float | None,
    off_nadir_deg: float | None,
    focal_px: float | None,
) -> None:
    tags = exif(
        {"Make": make, "Model": "Fly", "FocalLength": 4.5, "FocalLengthIn35mmFilm": 24}, order=">"
    )
    camera = _known(jpeg(exif=tags, xmp=xmp(namespaces, properties)))
    assert (camera.make, camera.focal_mm, camera.focal_35mm, camera.refused) == (
        make,
        4.5,
        24.0,
        "",
    )
    assert camera.height_m == (None if height_m is None else pytest.approx(height_m, rel=1e-4))
    assert camera.off_nadir_deg == (
        None if off_nadir_deg is None else pytest.approx(off_nadir_deg, abs=0.01)
    )
    assert camera.focal_px == focal_px


def test_the_sensors_pixels_come_from_the_focal_plane() -> None:
    tags = {
        "FocalPlaneXResolution": (1_639_344, 100),
        "FocalPlaneResolutionUnit": 2,
        "PixelXDimension": 4000,
    }
    assert _known(jpeg(exif=exif({**tags, "PixelYDimension": 3000}))).pixel_mm == pytest.approx(
        0.001549, rel=1e-3
    )
    assert _known(
        jpeg(exif=exif({**tags, "FocalPlaneResolutionUnit": 3}))
    ).pixel_mm == pytest.approx(6.1e-4, rel=1e-3)
    # Parrot's, per mm
    sequoia = {**tags, "FocalPlaneXResolution": (74_627, 100), "FocalPlaneResolutionUnit": 4}
    assert _known(jpeg(exif=exif(sequoia))).pixel_mm == pytest.approx(0.00134, rel=1e-3)


def test_a_height_above_the_sea_is_no_height() -> None:
    assert (
        _known(
            jpeg(
                xmp=xmp(
                    DJI, 'drone-dji:AbsoluteAltitude="+336.66" drone-dji:GimbalPitchDegree="-90"'
                )
            )
        ).height_m
        is None
    )


def test_png_and_webp_and_tiff_carry_metadata_too() -> None:
    packet = xmp(DJI, NADIR_DJI)
    in_tiff = exif(
        {
            "ImageWidth": 80,
            "ImageLength": 60,
            "Make": "DJI",
            "ApplicationNotes": packet,
            "FocalLengthIn35mmFilm": 26,
        }
    )
    for data in (png_with_xmp(packet, PHANTOM), webp_with_exif(PHANTOM, packet), in_tiff):
        camera = _known(data)
        assert (camera.make, camera.height_m, camera.focal_35mm) == ("DJI", 98.9, 26.0)


def test_an_open_image_knows_its_camera_whatever_it_was_opened_from(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    data = jpeg(exif=PHANTOM, xmp=xmp(DJI, NADIR_DJI))
    path = tmp_path_factory.mktemp("camera") / "photo.jpg"
    path.write_bytes(data)
    for source in (data, path):
        with open_raster(source) as raster:
            assert raster.camera is not None
            assert raster.camera.height_m == 98.9
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
    camera = _known(jpeg(xmp=xmp(DJI, NADIR_DJI, before=before)))
    assert camera.height_m is None
    assert "entities" in camera.refused


def _endless(n_entries: int, entry: bytes) -> bytes:
    return b"II*\0" + struct.pack("<IH", 8, n_entries) + entry * min(n_entries, 5000)


@pytest.mark.parametrize(
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
def test_hostile_exif_is_read_by_few_and_small_reads_and_says_little(block: bytes) -> None:
    sizes: list[int] = []

    def read_at(offset: int, count: int) -> bytes:
        sizes.append(len(block[offset : offset + count]))
        return block[offset : offset + count]

    read_exif(read_at)
    assert len(sizes) <= 10
    assert sum(sizes) <= 10_000
    camera = read_metadata(jpeg(exif=block))
    assert camera is None or camera.height_m is None
    with open_raster(jpeg(exif=block)) as raster:
        assert (raster.width_px, raster.height_px) == (80, 60)


_PLACE = {
    "GPSLatitudeRef": "N",
    "GPSLatitude": (41, 1, 25, 1, 4325, 100),
    "GPSLongitudeRef": "W",
    "GPSLongitude": (81, 1, 36, 1, 2118, 100),
}


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_position_is_read_in_degrees(order: str) -> None:
    camera = _known(jpeg(exif=exif(_PLACE, order)))
    assert camera.latitude_deg == pytest.approx(41 + 25 / 60 + 43.25 / 3600)
    assert camera.longitude_deg == pytest.approx(-(81 + 36 / 60 + 21.18 / 3600))
    south = _known(
        jpeg(exif=exif({**_PLACE, "GPSLatitudeRef": "S", "GPSLongitudeRef": "E"}, order))
    )
    assert south.latitude_deg is not None
    assert south.longitude_deg is not None
    assert south.latitude_deg < 0 < south.longitude_deg


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
def test_a_position_without_meaning_is_none(damage: dict[str, object]) -> None:
    camera = read_metadata(jpeg(exif=exif({"Make": "DJI", **_PLACE, **damage})))
    assert camera is not None
    assert camera.latitude_deg is None


TABLE = tomllib.loads(
    files("vehanchor.imagery.metadata").joinpath("sensors.toml").read_text(encoding="utf-8")
)["camera"]


@pytest.mark.parametrize("camera", TABLE, ids=lambda camera: camera["name"])
def test_every_camera_is_found_and_has_a_plausible_sensor_with_a_source(
    camera: dict[str, object],
) -> None:
    models = camera["models"]
    assert isinstance(models, list)
    assert models
    for model in models:
        sensor = sensor_of(f"{camera['make']} Robotics".upper(), f" {model} ")
        assert sensor is not None
        assert sensor.name == camera["name"]
        assert sensor.source
        assert 4 < sensor.width_mm < 37
        assert 1.3 < sensor.width_mm / sensor.height_mm < 1.52
        assert 0 < sensor.focal_from_mm <= sensor.focal_to_mm


def test_the_focal_length_of_the_file_chooses_the_lens() -> None:
    fixed = sensor_of("DJI", "FC3170")
    zoom = sensor_of("DJI", "FC2204")
    assert fixed is not None
    assert zoom is not None
    assert (fixed.focal_mm(4.5), fixed.focal_mm(9.1)) == (4.5, None)
    assert fixed.focal_mm(None) == pytest.approx(4.5)
    assert (zoom.focal_mm(8.6), zoom.focal_mm(None)) == (8.6, None)
