"""An honest file of every image format, from which the tests of all formats derive."""

from __future__ import annotations

from tests.skill.imagery.files import HEIC, RGB, encoded
from tests.skill.imagery.formats import test_windowed as jpeg2000
from vehanchor.imagery.formats.header import IMAGE_FORMATS

_OF_OTHER_DECODERS = {"JPEG 2000": jpeg2000.encoded(RGB), "HEIC": HEIC}
"""Samples of the formats that OpenCV does not encode."""

SAMPLES = {
    name: encoded(image_format.suffixes[0]) if image_format.opencv else _OF_OTHER_DECODERS[name]
    for name, image_format in IMAGE_FORMATS.items()
}
"""A file of each format by its name; all but HEIC show ``RGB``."""
