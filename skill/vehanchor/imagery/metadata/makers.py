"""Names that makers write into XMP: one row for each maker, in the spelling of the files."""

from __future__ import annotations

import math
from typing import NamedTuple

PIX4D = "http://pix4d.com/camera/1.0"
_FROM_HORIZON_BELOW_DEG = -59.5
"""Limit of pitches from nadir; the camera would look backwards at one below it.

Writers of such pitches count from the horizon.
"""


class Maker(NamedTuple):
    """XMP names of one maker.

    ``A/B`` is the field B of the structure A. A name is empty if the maker has none.

    Attributes:
        name: the maker.
        namespace: namespace of its properties, without a final slash. A word without a colon is a
            part of it.
        source: source of the names.
        height: metres above take-off or above ground.
        laser: metres in a straight line to the target of a laser range finder, which the optical
            axis meets.
        laser_status: whether the laser measured; ``Normal`` if it did.
        pitch: degrees.
        roll: degrees.
        level_below_deg: pitches below it are counted from the horizon (-90 is down), others from
            nadir (0 is down).
        focal_px: focal length, pixels of the full image.
        centre_px: column of the optical centre in the same pixels.
        focal: focal length in the unit of the property of the same name and ``Units``.
        focal_unit: unit of ``focal`` without that property.
        positions: pairs of latitude and longitude, degrees, positive to the north and east.
        makes: first words of EXIF's Make, in lower case, to which the row is limited; empty for
            all.
    """

    name: str
    namespace: str
    source: str
    height: str
    pitch: str
    roll: str
    level_below_deg: float = math.inf
    laser: str = ""
    laser_status: str = ""
    focal_px: str = ""
    centre_px: str = ""
    focal: str = ""
    focal_unit: str = "mm"
    positions: tuple[tuple[str, str], ...] = ()
    makes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all its properties."""
        names = (
            self.height,
            self.laser,
            self.laser_status,
            self.pitch,
            self.roll,
            self.focal_px,
            self.centre_px,
            self.focal,
            f"{self.focal}Units" if self.focal else "",
            *(name for pair in self.positions for name in pair),
        )
        return tuple(name for name in names if name)


_POSITIONS = (("GpsLatitude", "GpsLongitude"), ("GpsLatitude", "GpsLongtitude"))
"""Names of DJI, the second of which it misspelt for some years."""

_NO_DOCUMENT = "read so by OpenAthena; no document of the maker"

MAKERS: tuple[Maker, ...] = (
    Maker(
        name="DJI",
        namespace="http://www.dji.com/drone-dji/1.0",  # newer Autel drones write it, too
        source="DJI, Zenmuse P1 manual, XMP data list; Mavic 3M image processing guide; Matrice 4 "
        "manual, photo file",
        height="RelativeAltitude",
        laser="LRFTargetDistance",
        laser_status="LRFStatus",
        pitch="GimbalPitchDegree",
        roll="GimbalRollDegree",
        focal_px="CalibratedFocalLength",
        centre_px="CalibratedOpticalCenterX",
        positions=_POSITIONS,
    ),
    Maker(
        name="Autel",
        namespace="autel",
        source=_NO_DOCUMENT,
        height="RelativeAltitude",
        pitch="GimbalPitchDegree",
        roll="GimbalRollDegree",
        focal_px="CalibratedFocalLength",
        centre_px="CalibratedOpticalCenterX",
        positions=_POSITIONS,
    ),
    Maker(
        name="Skydio",
        namespace="https://www.skydio.com/drone-skydio/1.0",
        source="Skydio, camera and metadata overview; OpenAthenaIOS, issue 41",
        height="RelativeAltitude",
        pitch="CameraOrientationNED/Pitch",
        roll="CameraOrientationNED/Roll",
        focal_px="CalibratedFocalLength/X",
        centre_px="CalibratedOpticalCenter/X",
    ),
    Maker(
        name="Parrot",
        namespace="http://www.parrot.com/drone-parrot/1.0",
        source="Parrot, embedded photo metadata",
        height="",  # in Pix4D's namespace
        pitch="CameraPitchDegree",
        roll="CameraRollDegree",
    ),
    Maker(
        name="MicaSense",
        namespace=PIX4D,
        source="MicaSense, imageprocessing, metadata.py: without a unit, pixels",
        height="AboveGroundAltitude",
        pitch="Pitch",
        roll="Roll",
        level_below_deg=_FROM_HORIZON_BELOW_DEG,
        focal="PerspectiveFocalLength",
        focal_unit="px",
        makes=("micasense",),
    ),
    Maker(
        name="Autel, older",
        namespace=PIX4D,
        source=_NO_DOCUMENT,
        height="AboveGroundAltitude",
        pitch="Pitch",
        roll="Roll",
        level_below_deg=0.0,
        focal="PerspectiveFocalLength",
        makes=("autel", "camera"),
    ),
    # Also senseFly and Parrot.
    Maker(
        name="Pix4D",
        namespace=PIX4D,
        source="Pix4D, specification of xmp.camera tags",
        height="AboveGroundAltitude",
        pitch="Pitch",
        roll="Roll",
        level_below_deg=_FROM_HORIZON_BELOW_DEG,
        focal="PerspectiveFocalLength",
    ),
)
"""In order of precedence: the first maker with a value is used."""


def makers_of(make: str) -> tuple[Maker, ...]:
    """Choose the rows that hold for a camera by EXIF's Make: the first one of each namespace."""
    words = make.casefold().split(maxsplit=1)
    first_word = words[0] if words else ""
    rows: dict[str, Maker] = {}
    for maker in MAKERS:
        if not maker.makes or first_word in maker.makes:
            rows.setdefault(maker.namespace, maker)
    return tuple(rows.values())
