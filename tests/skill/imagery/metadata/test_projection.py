"""Pictures that state that they are not one perspective view."""

from __future__ import annotations

import pytest

from tests.skill.imagery.files import exif, jpeg, read_metadata, xmp
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.metadata.lens import perspective_problem

GPANO = {"GPano": "http://ns.google.com/photos/1.0/panorama/"}
PIX4D = {"Camera": "http://pix4d.com/camera/1.0"}


def _projection(data: bytes) -> str:
    camera = read_metadata(data)
    return "" if camera is None else camera.projection


@pytest.mark.parametrize(
    "packet",
    [
        xmp(GPANO, 'GPano:ProjectionType="equirectangular"'),
        xmp(GPANO, "<GPano:ProjectionType>cylindrical</GPano:ProjectionType>"),
        xmp(GPANO, 'GPano:FullPanoWidthPixels="8000"'),
        xmp(GPANO, 'GPano:UsePanoramaViewer="True"'),
        xmp(PIX4D, 'Camera:ModelType="fisheye"'),
        xmp({"aux": "http://ns.adobe.com/exif/1.0/aux/"}, 'aux:Lens="8mm f/3.5 Fish-Eye"'),
    ],
)
def test_a_stated_projection_is_believed(packet: bytes) -> None:
    assert _projection(jpeg(xmp=packet))


@pytest.mark.parametrize(
    "packet",
    [
        xmp(GPANO, 'GPano:ProjectionType="rectilinear" GPano:FullPanoWidthPixels="800"'),
        xmp(GPANO, 'GPano:UsePanoramaViewer="False"'),
        xmp(PIX4D, 'Camera:ModelType="perspective"'),
    ],
)
def test_a_stated_perspective_view_is_one(packet: bytes) -> None:
    assert _projection(jpeg(xmp=packet)) == ""


@pytest.mark.parametrize(("focal_35mm", "is_fisheye"), [(15, True), (24, False)])
def test_a_wide_field_of_view_of_gopro_is_that_of_a_fisheye(
    focal_35mm: int, is_fisheye: bool
) -> None:
    block = exif({"Make": "GoPro", "FocalLengthIn35mmFilm": focal_35mm})
    assert bool(_projection(jpeg(exif=block))) == is_fisheye


@pytest.mark.parametrize(
    ("model", "size", "is_sphere"),
    [
        ("RICOH THETA Z1", (120, 60), True),
        ("RICOH THETA Z1", (80, 60), False),
        ("RICOH GR III", (120, 60), False),
    ],
)
def test_the_whole_picture_of_a_camera_for_all_directions_is_a_sphere(
    model: str, size: tuple[int, int], is_sphere: bool
) -> None:
    block = exif({"Make": "RICOH", "Model": model})
    data = jpeg(exif=block, width_px=size[0], height_px=size[1])
    assert bool(_projection(data)) == is_sphere


def test_a_plain_photograph_states_no_projection() -> None:
    assert _projection(jpeg(exif=exif({"Make": "DJI"}))) == ""


def test_a_picture_wider_than_any_sensor_is_a_panorama() -> None:
    camera = CameraMetadata(focal_35mm=26.0)
    assert "panorama" in perspective_problem(ImageFacts(6000, 2000), camera)
    assert perspective_problem(ImageFacts(4000, 2250), camera) == ""
