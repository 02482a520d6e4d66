"""Names that makers write into XMP: one row for each maker, as the file has them."""

from __future__ import annotations

import math
from typing import NamedTuple

PIX4D = "http://pix4d.com/camera/1.0"
_ALWAYS = math.inf


class Maker(NamedTuple):
    """XMP names of one maker; ``A/B`` is the field B of the structure A, and a name is empty if the maker has none.

    Attributes:
        name: the maker.
        namespace: of its properties, without a final slash; a word without a colon is one that it
            contains.
        source: of the names.
        height: metres above take-off or above ground.
        pitch: degrees.
        roll: degrees.
        level_below_deg: pitches below it are counted from the horizon (-90 is down), others from
            nadir (0 is down).
        focal_px: focal length, pixels of the full image.
        centre_px: column of the optical centre in the same pixels.
        focal: focal length in the unit of the property of the same name and ``Units``.
        focal_unit: unit of ``focal`` without that property.
        makes: first words of EXIF's Make, in lower case, to which the row is limited; empty for
            all.
    """

    name: str
    namespace: str
    source: str
    height: str
    pitch: str
    roll: str
    level_below_deg: float = _ALWAYS
    focal_px: str = ""
    centre_px: str = ""
    focal: str = ""
    focal_unit: str = "mm"
    makes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """All of its properties."""
        units = f"{self.focal}Units" if self.focal else ""
        names = self.height, self.pitch, self.roll, self.focal_px, self.centre_px, self.focal, units
        return tuple(filter(None, names))


_DJI_ATTITUDE = ("GimbalPitchDegree", "GimbalRollDegree")
_DJI_LENS = ("CalibratedFocalLength", "CalibratedOpticalCenterX")
_PIX4D_NAMES = ("AboveGroundAltitude", "Pitch", "Roll")
_PIX4D_FOCAL = "PerspectiveFocalLength"
_ORIENTATION = ("CameraOrientationNED/Pitch", "CameraOrientationNED/Roll")
_TRIED = "read so by OpenAthena; no document of the maker"

MAKERS: tuple[Maker, ...] = (
    Maker(
        "DJI",
        "http://www.dji.com/drone-dji/1.0",  # newer Autel drones write it, too
        "DJI, Zenmuse P1 manual, XMP data list; Mavic 3M image processing guide",
        "RelativeAltitude",
        *_DJI_ATTITUDE,
        _ALWAYS,
        *_DJI_LENS,
    ),
    Maker("Autel", "autel", _TRIED, "RelativeAltitude", *_DJI_ATTITUDE, _ALWAYS, *_DJI_LENS),
    Maker(
        "Skydio",
        "https://www.skydio.com/drone-skydio/1.0",
        "Skydio, camera and metadata overview; OpenAthenaIOS, issue 41",
        "RelativeAltitude",
        *_ORIENTATION,
        _ALWAYS,
        "CalibratedFocalLength/X",
        "CalibratedOpticalCenter/X",
    ),
    Maker(
        "Parrot",
        "http://www.parrot.com/drone-parrot/1.0",
        source="Parrot, embedded photo metadata",
        height="",  # in Pix4D's namespace
        pitch="CameraPitchDegree",
        roll="CameraRollDegree",
    ),
    Maker(
        "MicaSense",
        PIX4D,
        "MicaSense, imageprocessing, metadata.py: without a unit, pixels",
        *_PIX4D_NAMES,
        -59.5,
        focal=_PIX4D_FOCAL,
        focal_unit="px",
        makes=("micasense",),
    ),
    Maker(
        "Autel, older",
        PIX4D,
        _TRIED,
        *_PIX4D_NAMES,
        0.0,
        focal=_PIX4D_FOCAL,
        makes=("autel", "camera"),
    ),
    # senseFly, Parrot; below -59.5 degrees the camera would look backwards: the writer counts from
    # the horizon
    Maker(
        "Pix4D",
        PIX4D,
        "Pix4D, specification of xmp.camera tags",
        *_PIX4D_NAMES,
        -59.5,
        focal=_PIX4D_FOCAL,
    ),
)
"""In order of precedence: the first maker with a value is used."""


def makers_of(make: str) -> tuple[Maker, ...]:
    """Rows that hold for a camera by EXIF's Make, the first one of each namespace."""
    rows: dict[str, Maker] = {}
    for each in MAKERS:
        if not each.makes or make.casefold().split(maxsplit=1)[:1] in [
            [word] for word in each.makes
        ]:
            rows.setdefault(each.namespace, each)
    return tuple(rows.values())
