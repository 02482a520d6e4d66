"""Files that state that they are crops, though their camera tags have the size of the crop."""

from __future__ import annotations

import pytest

from tests.skill.imagery.files import exif, jpeg, read_metadata, xmp
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.formats.image_header import ImageHeader
from vehanchor.imagery.metadata.crop import stated_crop
from vehanchor.imagery.metadata.lens import lens
from vehanchor.imagery.metadata.statements import Statements

CAMERA = {
    "Make": "SONY",
    "FocalLengthIn35mmFilm": 24,
    "PixelXDimension": 80,
    "PixelYDimension": 60,
}
CAMERA_RAW = {"crs": "http://ns.adobe.com/camera-raw-settings/1.0/"}
TIFF = {"tiff": "http://ns.adobe.com/tiff/1.0/"}
EXIF = {"exif": "http://ns.adobe.com/exif/1.0/"}


def _has_lens(*, packet: bytes | None = None, **tags: int) -> bool:
    """Test whether the camera's lens is that of the image of 80 x 60 px."""
    camera = read_metadata(jpeg(exif=exif({**CAMERA, **tags}), xmp=packet))
    assert camera is not None
    return lens(ImageFacts(80, 60), camera) is not None


@pytest.mark.parametrize(
    "packet",
    [
        xmp(CAMERA_RAW, 'crs:HasCrop="True" crs:AlreadyApplied="True" crs:CropTop="0.25"'),
        xmp(
            CAMERA_RAW,
            "<crs:HasCrop>True</crs:HasCrop><crs:AlreadyApplied>True</crs:AlreadyApplied>",
        ),
        xmp(TIFF, 'tiff:ImageWidth="5472" tiff:ImageLength="3648"'),
        xmp(EXIF, 'exif:PixelXDimension="5472" exif:PixelYDimension="3648"'),
    ],
)
def test_a_crop_that_an_editor_states_has_no_lens(packet: bytes) -> None:
    assert not _has_lens(packet=packet)


def test_a_size_of_another_shape_in_the_first_directory_shows_a_crop() -> None:
    assert not _has_lens(ImageWidth=5472, ImageLength=3648)


@pytest.mark.parametrize(
    "packet",
    [
        xmp(CAMERA_RAW, 'crs:HasCrop="False" crs:AlreadyApplied="True"'),
        # Settings that the editor has not applied to the pixels.
        xmp(CAMERA_RAW, 'crs:HasCrop="True" crs:CropTop="0.25"'),
        # The raw file had some more rows and columns, and the picture was turned.
        xmp(TIFF, 'tiff:ImageWidth="3040" tiff:ImageLength="4032"'),
    ],
)
def test_a_whole_photograph_keeps_its_lens(packet: bytes) -> None:
    assert _has_lens(packet=packet)


def test_an_optical_centre_beside_the_middle_makes_the_lens_doubtful() -> None:
    packet = xmp(
        {"drone-dji": "http://www.dji.com/drone-dji/1.0/"},
        'drone-dji:CalibratedFocalLength="53" drone-dji:CalibratedOpticalCenterX="80"',
    )
    camera = read_metadata(jpeg(exif=exif(CAMERA), xmp=packet))
    optics = lens(ImageFacts(80, 60), camera)
    assert optics is not None
    assert optics.chance_wrong > 0.1


def test_the_header_of_a_damaged_file_shows_no_crop() -> None:
    statements = Statements([{"ImageWidth": 40.0, "ImageLength": 30.0}], [], [])
    assert stated_crop(statements, ImageHeader("jpeg", width_px=0, height_px=30)) == ""
    assert stated_crop(statements, ImageHeader("jpeg", width_px=40, height_px=0)) == ""
