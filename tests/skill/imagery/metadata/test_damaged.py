"""Metadata that strict readers refuse, and statements that are invalid or contradictory."""

from __future__ import annotations

import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.skill.imagery.files import (
    EXIF_PREFIX,
    XMP_PREFIX,
    after_head,
    encoded,
    exif,
    jpeg,
    png_chunk,
    png_with_xmp,
    read_metadata,
    segment,
    smooth_rgb,
    xmp,
)
from vehanchor.imagery.metadata.blocks import MAX_XMP_BYTES
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.metadata.makers import MAKERS, Maker
from vehanchor.imagery.metadata.xmp import read_xmp

DJI = {"drone-dji": "http://www.dji.com/drone-dji/1.0/"}
PIX4D = {"Camera": "http://pix4d.com/camera/1.0"}
SKYDIO = {"drone-skydio": "https://www.skydio.com/drone-skydio/1.0/"}
NADIR = (
    'drone-dji:RelativeAltitude="+98.90" drone-dji:GimbalPitchDegree="-89.90" '
    'drone-dji:GimbalRollDegree="+0.00"'
)
PACKET = xmp(DJI, NADIR)
LENS = exif({"Make": "DJI", "FocalLength": 4.5, "FocalLengthIn35mmFilm": 24})


def _camera(data: bytes) -> CameraMetadata:
    camera = read_metadata(data)
    assert camera is not None
    return camera


def _camera_of(
    properties: str, namespaces: dict[str, str] = DJI, make: str = "DJI", **tags: object
) -> CameraMetadata:
    """Read the camera of a JPEG with these properties in XMP and these tags in EXIF."""
    return _camera(jpeg(exif=exif({"Make": make, **tags}), xmp=xmp(namespaces, properties)))


@pytest.mark.parametrize(
    "damage",
    [
        lambda packet: packet.decode().encode("utf-16-le"),
        lambda packet: packet.decode().encode("utf-16-be"),
        lambda packet: b"\xff\xfe" + packet.decode().encode("utf-16-le"),
        lambda packet: b"\xef\xbb\xbf" + packet,
        lambda packet: packet + b"\xff\xdb\0C rest of a segment",
        lambda packet: b"junk" + packet,
        lambda packet: packet[: packet.index(b"</rdf:Description>")],
        lambda packet: packet.replace(b"DJI Meta Data", b"A & B"),
        lambda packet: packet.replace(b"DJI Meta Data", b"\xb0 \x01"),
        lambda packet: packet.replace(b'rdf:about="DJI Meta Data"', NADIR.encode()),
        lambda packet: packet.replace(b"</x:xmpmeta>", b"</x:xmp>"),
        lambda packet: packet + b" " * MAX_XMP_BYTES,
    ],
)
def test_damaged_xmp_is_read_by_the_names_of_the_makers(damage: Callable[[bytes], bytes]) -> None:
    properties, refused = read_xmp(damage(PACKET), MAKERS[0].names)
    assert refused == ""
    assert properties["http://www.dji.com/drone-dji/1.0", "RelativeAltitude"][0] == "+98.90"


NOT_XML = b"<x:xmpmeta> & "


def test_damaged_xmp_without_a_name_of_the_makers_is_refused() -> None:
    assert "damaged" in _camera(jpeg(exif=LENS, xmp=NOT_XML)).refused


def test_damaged_xmp_does_not_matter_beside_another_packet() -> None:
    camera = _camera(jpeg(exif=LENS, xmp=PACKET, more=segment(XMP_PREFIX + NOT_XML)))
    assert (camera.height_m, camera.refused) == (98.9, "")


DAMAGED_SKYDIO = (
    "<drone-skydio:Pitch>7</drone-skydio:Pitch> & "
    '<drone-skydio:CalibratedFocalLength rdf:parseType="Resource">'
    "<drone-skydio:X>3000.5</drone-skydio:X><drone-skydio:Y>1</drone-skydio:Y>"
    "</drone-skydio:CalibratedFocalLength>"
    '<drone-skydio:CameraOrientationNED drone-skydio:Roll="1" drone-skydio:Pitch="-80" />'
)


def test_elements_in_structures_of_damaged_xmp_are_read() -> None:
    assert _camera_of(DAMAGED_SKYDIO, SKYDIO, "Skydio").focal_px == 3000.5


def test_attributes_of_structures_of_damaged_xmp_are_read() -> None:
    camera = _camera_of(DAMAGED_SKYDIO, SKYDIO, "Skydio")
    assert camera.off_nadir_deg == pytest.approx(10)


@pytest.mark.slow
@pytest.mark.parametrize(
    "filling",
    [b"<", b"a:", b'drone-dji:RelativeAltitude="', b"x:CameraOrientationNED ", b" ", b"&"],
)
def test_hostile_xmp_is_read_in_time(filling: bytes) -> None:
    packet = b"<x:xmpmeta><" + filling * (MAX_XMP_BYTES // len(filling))
    parts = [packet[start : start + 60_000] for start in range(0, 10**6, 60_000)]
    data = jpeg(exif=LENS, more=b"".join(segment(XMP_PREFIX + part) for part in parts))
    started = time.process_time()
    read_metadata(data)
    assert time.process_time() - started < 1


EDITOR = xmp({"xmp": "http://ns.adobe.com/xap/1.0/"}, 'xmp:CreatorTool="Editor"')


def _parts_of_extended_xmp() -> list[bytes]:
    """Split the packet into parts of 200 bytes, as a JPEG holds too long a packet."""
    digest = b"0" * 32
    parts = []
    for start in range(0, len(PACKET), 200):
        head = digest + struct.pack(">II", len(PACKET), start)
        body = b"http://ns.adobe.com/xmp/extension/\0" + head + PACKET[start : start + 200]
        parts.append(segment(body))
    return parts


def _png_with_compressed_xmp() -> bytes:
    text = b"XML:com.adobe.xmp\0\1\0\0\0" + zlib.compress(PACKET)
    return after_head(encoded(".png", smooth_rgb(80, 60)), png_chunk(b"iTXt", text))


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(jpeg(xmp=PACKET, more=segment(XMP_PREFIX + EDITOR)), id="second packet"),
        pytest.param(jpeg(xmp=EDITOR, more=segment(XMP_PREFIX + PACKET)), id="first packet"),
        pytest.param(
            jpeg(xmp=EDITOR, more=b"".join(reversed(_parts_of_extended_xmp()))),
            id="extended packet, in any order",
        ),
        pytest.param(
            jpeg(xmp=EDITOR, exif=exif({"Make": "DJI", "ApplicationNotes": PACKET})),
            id="tag in EXIF",
        ),
        pytest.param(_png_with_compressed_xmp(), id="compressed text"),
    ],
)
def test_every_packet_is_read(data: bytes) -> None:
    assert _camera(data).height_m == 98.9


def test_every_exif_block_is_read() -> None:
    second = EXIF_PREFIX + exif({"FocalLength": 4.5})
    camera = _camera(jpeg(exif=exif({"Make": "DJI"}), more=segment(second)))
    assert (camera.make, camera.focal_mm) == ("DJI", 4.5)


def test_a_pointer_in_exif_may_have_the_type_of_a_directory() -> None:
    camera = _camera(jpeg(exif=exif({"FocalLength": 4.5}, pointer_kind=13)))
    assert camera.focal_mm == 4.5


@pytest.fixture(scope="module")
def camera_in_xmp() -> CameraMetadata:
    """A camera whose lens only XMP states."""
    namespaces = {"exif": "http://ns.adobe.com/exif/1.0/", "tiff": "http://ns.adobe.com/tiff/1.0/"}
    properties = (
        'tiff:Make="DJI" tiff:Model="FC6310" exif:FocalLength="8800/1000" '
        'exif:FocalLengthIn35mmFilm="24" '
        'exif:PixelXDimension="5472" exif:PixelYDimension="3648"'
    )
    return _camera(png_with_xmp(xmp(namespaces, properties), b""))


def test_a_model_that_only_xmp_states_is_read(camera_in_xmp: CameraMetadata) -> None:
    assert (camera_in_xmp.make, camera_in_xmp.model) == ("DJI", "FC6310")


def test_a_focal_length_that_only_xmp_states_is_read(camera_in_xmp: CameraMetadata) -> None:
    assert (camera_in_xmp.focal_mm, camera_in_xmp.focal_35mm) == (8.8, 24)


def test_a_size_that_only_xmp_states_is_read(camera_in_xmp: CameraMetadata) -> None:
    assert (camera_in_xmp.taken_width_px, camera_in_xmp.taken_height_px) == (5472, 3648)


@pytest.mark.parametrize(
    ("text", "height_m"),
    [
        ("+100.00 m", 100.0),
        ("100.0000000000001", 100.0),
        ("-0.99999999999999", -1.0),
        ("328.08 ft", 99.999),
        ("328.08feet", 99.999),
        ("328.08'", 99.999),
        ("100,95", 100.95),
        ("200000/2000", 100.0),
        ("1e2", 100.0),
        (".5", 0.5),
        ("nan", None),
        ("inf", None),
        ("100 yd", None),
        ("1,250", None),
        ("100,5,3", None),
        ("100/0", None),
        ("about 100", None),
    ],
)
def test_a_height_is_a_number_of_metres_or_feet(text: str, height_m: float | None) -> None:
    camera = _camera_of(f'drone-dji:RelativeAltitude="{text}"')
    assert camera.height_m == (None if height_m is None else pytest.approx(height_m, rel=1e-5))
    assert (text[:32] in camera.refused) == (height_m is None)


OTHER_PACKET = PACKET.replace(b"+98.90", b"+40")


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(jpeg(xmp=PACKET, more=segment(XMP_PREFIX + OTHER_PACKET)), id="two packets"),
        pytest.param(
            jpeg(xmp=PACKET.replace(b"rdf:about", b'drone-dji:RelativeAltitude="40" rdf:about')),
            id="one packet",
        ),
    ],
)
def test_of_two_heights_that_differ_neither_is_used(data: bytes) -> None:
    camera = _camera(data)
    assert camera.height_m is None
    assert "DJI RelativeAltitude is both 40 and 98.9" in camera.refused


EXIF_IN_XMP = {"exif": "http://ns.adobe.com/exif/1.0/"}


def test_of_two_focal_lengths_that_differ_neither_is_used() -> None:
    camera = _camera_of('exif:FocalLength="24"', EXIF_IN_XMP, FocalLength=8.8)
    assert camera.focal_mm is None
    assert camera.refused == "FocalLength is both 8.8 and 24"


def test_two_focal_lengths_may_differ_by_rounding() -> None:
    assert _camera_of('exif:FocalLength="8.83"', EXIF_IN_XMP, FocalLength=8.8).focal_mm == 8.8


def test_the_same_number_in_other_words_is_one_statement() -> None:
    camera = _camera(
        jpeg(xmp=PACKET, more=segment(XMP_PREFIX + PACKET.replace(b"+98.90", b"98.9 m")))
    )
    assert (camera.height_m, camera.refused) == (98.9, "")


@pytest.mark.parametrize(
    ("make", "properties", "focal_mm", "focal_px"),
    [
        (
            "MicaSense",
            'Camera:PerspectiveFocalLength="1459.7272592972727"',
            5.5,
            1459.7272592972727,
        ),
        (
            "MicaSense",
            'Camera:PerspectiveFocalLength="1459.7" Camera:PerspectiveFocalLengthUnits="pixels"',
            5.5,
            1459.7,
        ),
        (
            "MicaSense",
            'Camera:PerspectiveFocalLength="5.44" Camera:PerspectiveFocalLengthUnits="mm"',
            5.44,
            None,
        ),
        ("senseFly", 'Camera:PerspectiveFocalLength="10.6"', 10.6, None),
        (
            "senseFly",
            'Camera:PerspectiveFocalLength="10.6" Camera:PerspectiveFocalLengthUnits="inch"',
            5.5,
            None,
        ),
    ],
)
def test_a_focal_length_has_the_unit_of_its_maker(
    make: str, properties: str, focal_mm: float, focal_px: float | None
) -> None:
    camera = _camera_of(properties, PIX4D, make, FocalLength=5.5)
    assert (camera.focal_mm, camera.focal_px) == (focal_mm, focal_px)
    assert camera.refused.count("inch") == properties.count("inch")


@pytest.mark.parametrize(
    ("make", "pitch", "off_nadir_deg"),
    [
        ("Autel Robotics", -30, 60),
        ("Camera", -30, 60),
        ("Camera", -90, 0),
        ("Camera", 3, 3),
        ("senseFly", -30, 30),
        ("senseFly", -90, 0),
    ],
)
def test_a_pitch_has_the_zero_of_its_maker(make: str, pitch: float, off_nadir_deg: float) -> None:
    properties = f'Camera:AboveGroundAltitude="50" Camera:Pitch="{pitch}" Camera:Roll="0"'
    assert _camera_of(properties, PIX4D, make).off_nadir_deg == pytest.approx(off_nadir_deg)


ZEROS = 'drone-dji:GimbalPitchDegree="+0.00" drone-dji:GimbalRollDegree="+0.00"'


@pytest.mark.parametrize("yaw", ["+0.00", "-93.40"])
def test_a_gimbal_of_zeros_is_unknown(yaw: str) -> None:
    camera = _camera_of(f'{ZEROS} drone-dji:GimbalYawDegree="{yaw}"')
    assert camera.off_nadir_deg is None
    assert "unknown angles" in camera.refused


@pytest.mark.parametrize("yaw", ["+0.00", "-93.40"])
def test_a_gimbal_of_nearly_zeros_looks_at_the_horizon(yaw: str) -> None:
    nearly_zeros = ZEROS.replace("+0.00", "+0.10", 1)
    camera = _camera_of(f'{nearly_zeros} drone-dji:GimbalYawDegree="{yaw}"')
    assert camera.off_nadir_deg == pytest.approx(90.1)


@pytest.mark.parametrize(
    ("model", "width_px", "sensor_is_possible"),
    [
        ("S110", 4000, True),
        ("S110", 1000, False),
        ("S110", 100_000, False),
        ("FC330", 5000, False),
        ("FC330", 3316, True),
    ],
)
def test_a_focal_plane_of_another_size_is_not_used(
    model: str, width_px: int, sensor_is_possible: bool
) -> None:
    tags = {
        "Make": "DJI",
        "Model": model,
        "FocalPlaneXResolution": (4_000_000, 293),
        "FocalPlaneResolutionUnit": 2,
        "PixelXDimension": width_px,
        "PixelYDimension": width_px * 3 // 4,
    }
    camera = _camera(jpeg(exif=exif(tags)))
    assert (camera.pixel_mm is not None) == sensor_is_possible
    assert ("mm wide" in camera.refused) != sensor_is_possible


@pytest.fixture(scope="module")
def documented_rows() -> dict[str, str]:
    """Rows of the makers in the documentation, by their names."""
    text = (Path(__file__).parents[4] / "docs/reading.md").read_text(encoding="utf-8")
    rows = {}
    for line in text.splitlines():
        if "is down" in line:
            first_cell = line.split("|")[1]
            name = first_cell.split(";")[0].split(":")[0].strip()
            rows[name] = line
    return rows


def test_the_documentation_has_every_maker(documented_rows: dict[str, str]) -> None:
    assert set(documented_rows) == {maker.name for maker in MAKERS}


@pytest.mark.parametrize("maker", MAKERS, ids=lambda maker: maker.name)
def test_the_documentation_has_the_names_of_every_maker(
    maker: Maker, documented_rows: dict[str, str]
) -> None:
    row = documented_rows[maker.name]
    assert maker.namespace in row
    for name in (maker.height, maker.pitch, maker.focal_px, maker.focal):
        assert not name or f"`{name}`" in row


@pytest.mark.parametrize(
    "properties",
    [
        "<drone-skydio:CalibratedFocalLength "
        'rdf:parseType="Resource"><drone-skydio:X>3000</drone-skydio:X>'
        "</drone-skydio:CalibratedFocalLength>",
        '<drone-skydio:CalibratedFocalLength drone-skydio:X="3000" drone-skydio:Y="2"/>',
        'drone-skydio:CalibratedFocalLengthX="3000"',
    ],
)
def test_every_form_of_a_structure_is_read(properties: str) -> None:
    assert _camera_of(properties, SKYDIO, "Skydio").focal_px == 3000
