"""Metadata that strict readers refuse, and statements that contradict each other or have no meaning."""

from __future__ import annotations

import re
import struct
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.skill.imagery.files import (
    XMP_PREFIX,
    encoded,
    exif,
    jpeg,
    png_with_xmp,
    read_metadata,
    segment,
    smooth_rgb,
    xmp,
)
from vehanchor.imagery.metadata.blocks import MAX_XMP_BYTES
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.metadata.makers import MAKERS
from vehanchor.imagery.metadata.xmp import read_xmp

DJI = {"drone-dji": "http://www.dji.com/drone-dji/1.0/"}
PIX4D = {"Camera": "http://pix4d.com/camera/1.0"}
SKYDIO = {"drone-skydio": "https://www.skydio.com/drone-skydio/1.0/"}
SAID = (
    'drone-dji:RelativeAltitude="+98.90" drone-dji:GimbalPitchDegree="-89.90" '
    'drone-dji:GimbalRollDegree="+0.00"'
)
PACKET = xmp(DJI, SAID)
LENS = exif({"Make": "DJI", "FocalLength": 4.5, "FocalLengthIn35mmFilm": 24})


def _camera(data: bytes) -> CameraMetadata:
    camera = read_metadata(data)
    assert camera is not None
    return camera


def _of(
    properties: str, namespaces: dict[str, str] = DJI, make: str = "DJI", **tags: object
) -> CameraMetadata:
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
        lambda packet: packet.replace(b'rdf:about="DJI Meta Data"', SAID.encode()),
        lambda packet: packet.replace(b"</x:xmpmeta>", b"</x:xmp>"),
        lambda packet: packet + b" " * MAX_XMP_BYTES,
    ],
)
def test_damaged_xmp_is_read_by_the_names_of_the_makers(damage: Callable[[bytes], bytes]) -> None:
    found, refused = read_xmp(damage(PACKET), MAKERS[0].names)
    assert refused == ""
    assert found[("http://www.dji.com/drone-dji/1.0", "RelativeAltitude")][0] == "+98.90"


def test_damaged_xmp_without_a_known_name_says_so() -> None:
    assert "damaged" in _camera(jpeg(exif=LENS, xmp=b"<x:xmpmeta> & ")).refused
    with_other = jpeg(exif=LENS, xmp=PACKET, more=segment(XMP_PREFIX + b"<x:xmpmeta> & "))
    assert (_camera(with_other).height_m, _camera(with_other).refused) == (98.9, "")


def test_structures_and_elements_of_damaged_xmp_are_read() -> None:
    inner = "<drone-skydio:X>3000.5</drone-skydio:X><drone-skydio:Y>1</drone-skydio:Y>"
    said = (
        f"<drone-skydio:Pitch>7</drone-skydio:Pitch> & "
        "<drone-skydio:CalibratedFocalLength "
        f'rdf:parseType="Resource">{inner}</drone-skydio:CalibratedFocalLength>'
        '<drone-skydio:CameraOrientationNED drone-skydio:Roll="1" drone-skydio:Pitch="-80" />'
    )
    camera = _of(said, SKYDIO, "Skydio")
    assert camera.focal_px == 3000.5
    assert camera.off_nadir_deg == pytest.approx(10)


@pytest.mark.slow
@pytest.mark.parametrize(
    "filling",
    [b"<", b"a:", b'drone-dji:RelativeAltitude="', b"x:CameraOrientationNED ", b" ", b"&"],
)
def test_hostile_xmp_is_read_in_time(filling: bytes) -> None:
    packet = b"<x:xmpmeta><" + filling * (MAX_XMP_BYTES // len(filling))
    data = jpeg(
        exif=LENS,
        more=b"".join(
            segment(XMP_PREFIX + packet[at : at + 60_000]) for at in range(0, 10**6, 60_000)
        ),
    )
    started = time.process_time()
    read_metadata(data)
    assert time.process_time() - started < 1


def test_every_packet_is_read() -> None:
    editor = xmp({"xmp": "http://ns.adobe.com/xap/1.0/"}, 'xmp:CreatorTool="Editor"')
    digest = b"0" * 32
    parts = [
        segment(
            b"http://ns.adobe.com/xmp/extension/\0"
            + digest
            + struct.pack(">II", len(PACKET), at)
            + PACKET[at : at + 200]
        )
        for at in range(0, len(PACKET), 200)
    ]
    for data in (
        jpeg(xmp=PACKET, more=segment(XMP_PREFIX + editor)),
        jpeg(xmp=editor, more=segment(XMP_PREFIX + PACKET)),
        jpeg(xmp=editor, more=b"".join(reversed(parts))),
        jpeg(xmp=editor, exif=exif({"Make": "DJI", "ApplicationNotes": PACKET})),
        _png_with_compressed_xmp(),
    ):
        assert _camera(data).height_m == 98.9


def _png_with_compressed_xmp() -> bytes:
    body = b"iTXt" + b"XML:com.adobe.xmp\0\1\0\0\0" + zlib.compress(PACKET)
    plain = encoded(".png", smooth_rgb(80, 60))
    return (
        plain[:33]
        + struct.pack(">I", len(body) - 4)
        + body
        + struct.pack(">I", zlib.crc32(body))
        + plain[33:]
    )


def test_every_exif_block_is_read_and_its_pointers_may_be_directories() -> None:
    data = jpeg(
        exif=exif({"Make": "DJI"}),
        more=segment(b"Exif\0\0" + exif({"FocalLength": 4.5}, pointer_kind=13)),
    )
    assert (_camera(data).make, _camera(data).focal_mm) == ("DJI", 4.5)


def test_a_lens_that_only_xmp_states_is_read() -> None:
    spaces = {"exif": "http://ns.adobe.com/exif/1.0/", "tiff": "http://ns.adobe.com/tiff/1.0/"}
    said = (
        'tiff:Make="DJI" tiff:Model="FC6310" exif:FocalLength="8800/1000" '
        'exif:FocalLengthIn35mmFilm="24"'
    )
    camera = _camera(
        png_with_xmp(
            xmp(spaces, said + ' exif:PixelXDimension="5472" exif:PixelYDimension="3648"'), b""
        )
    )
    assert (camera.make, camera.model, camera.focal_mm, camera.focal_35mm) == (
        "DJI",
        "FC6310",
        8.8,
        24,
    )
    assert (camera.taken_width_px, camera.taken_height_px) == (5472, 3648)


@pytest.mark.parametrize(
    ("text", "height_m"),
    [
        ("+100.00 m", 100.0),
        ("100.0000000000001", 100.0),
        ("-0.99999999999999", -1.0),
        ("328.08 ft", 99.999),
        ("328.08feet", 99.999),
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
def test_a_height_is_a_number_of_metres_or_feet_or_is_not_used(
    text: str, height_m: float | None
) -> None:
    camera = _of(f'drone-dji:RelativeAltitude="{text}"')
    assert camera.height_m == (None if height_m is None else pytest.approx(height_m, rel=1e-5))
    assert (text[:32] in camera.refused) == (height_m is None)


def test_of_two_statements_that_differ_neither_is_used() -> None:
    other = PACKET.replace(b"+98.90", b"+40")
    for data in (
        jpeg(xmp=PACKET, more=segment(XMP_PREFIX + other)),
        jpeg(xmp=PACKET.replace(b"rdf:about", b'drone-dji:RelativeAltitude="40" rdf:about')),
    ):
        camera = _camera(data)
        assert camera.height_m is None
        assert re.search("DJI RelativeAltitude is both 40 and 98.9", camera.refused)
    lens = {"exif": "http://ns.adobe.com/exif/1.0/"}
    camera = _of('exif:FocalLength="24"', lens, FocalLength=8.8)
    assert (camera.focal_mm, camera.refused) == (None, "FocalLength is both 8.8 and 24")
    assert _of('exif:FocalLength="8.83"', lens, FocalLength=8.8).focal_mm == 8.8


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
    camera = _of(properties, PIX4D, make, FocalLength=5.5)
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
    said = f'Camera:AboveGroundAltitude="50" Camera:Pitch="{pitch}" Camera:Roll="0"'
    assert _of(said, PIX4D, make).off_nadir_deg == pytest.approx(off_nadir_deg)


@pytest.mark.parametrize("yaw", ["+0.00", "-93.40"])
def test_a_gimbal_of_zeros_is_unknown(yaw: str) -> None:
    said = (
        'drone-dji:GimbalPitchDegree="+0.00" drone-dji:GimbalRollDegree="+0.00" '
        f'drone-dji:GimbalYawDegree="{yaw}"'
    )
    camera = _of(said)
    assert camera.off_nadir_deg is None
    assert "unknown angles" in camera.refused
    assert _of(said.replace("+0.00", "+0.10", 1)).off_nadir_deg == pytest.approx(90.1)


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
    plane = {
        "FocalPlaneXResolution": (4_000_000, 293),
        "FocalPlaneResolutionUnit": 2,
        "PixelXDimension": width_px,
    }
    camera = _camera(
        jpeg(
            exif=exif(
                {"Make": "DJI", "Model": model, **plane, "PixelYDimension": width_px * 3 // 4}
            )
        )
    )
    assert (camera.pixel_mm is not None) == sensor_is_possible
    assert ("mm wide" in camera.refused) != sensor_is_possible


def test_the_documentation_has_every_row_of_the_makers() -> None:
    text = (Path(__file__).parents[4] / "docs/reading.md").read_text(encoding="utf-8")
    rows = {
        line.split("|")[1].split(";")[0].split(":")[0].strip(): line
        for line in text.splitlines()
        if "is down" in line
    }
    assert set(rows) == {maker.name for maker in MAKERS}
    for maker in MAKERS:
        assert maker.namespace in rows[maker.name]
        assert all(
            f"`{name}`" in rows[maker.name]
            for name in (maker.height, maker.pitch, maker.focal_px, maker.focal)
            if name
        )


@pytest.mark.parametrize(
    "said",
    [
        "<drone-skydio:CalibratedFocalLength "
        'rdf:parseType="Resource"><drone-skydio:X>3000</drone-skydio:X>'
        "</drone-skydio:CalibratedFocalLength>",
        '<drone-skydio:CalibratedFocalLength drone-skydio:X="3000" drone-skydio:Y="2"/>',
        'drone-skydio:CalibratedFocalLengthX="3000"',
    ],
)
def test_a_structure_is_read_as_the_file_has_it_and_flattened(said: str) -> None:
    assert _of(said, SKYDIO, "Skydio").focal_px == 3000
