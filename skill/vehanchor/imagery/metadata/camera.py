"""Camera metadata of an image file: height, focal length, orientation, original size.

Drones write the camera's height and orientation into XMP, under names that differ between makers. Focal length and
sensor are in EXIF, which all makers share. ``MAKERS`` lists the names; docs/how-to/rulers.md names their sources. This
module only converts units and signs of angles; ``vehanchor.rulers.camera`` measures with them.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.imagery.metadata.blocks import MAX_XMP_BYTES, find_metadata
from vehanchor.imagery.metadata.exif import read_exif
from vehanchor.imagery.metadata.xmp import read_xmp

if TYPE_CHECKING:
    from collections.abc import Mapping

    from vehanchor.imagery.formats.ifd import ReadAt
    from vehanchor.imagery.metadata.exif import ExifTags

_NUMBER = re.compile(r"\s*([+-]?\d{1,12}(?:\.\d{0,12})?(?:[eE][+-]?\d{1,2})?)(?:\s*/\s*(\d{1,12}))?(?:\s|,|$)")
_PIX4D = "http://pix4d.com/camera/1.0"
_AUTEL = "autel"  # its namespace changed with its firmware; each contains the maker's name
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}  # FocalPlaneResolutionUnit: inch, cm; TIFF/EP's mm, micrometre
_ZERO_IS_FORWARD, _ZERO_IS_DOWN = 90.0, 0.0  # degrees to add to a pitch to count it from nadir
_BACKWARDS_DEG = -60.0  # under Pix4D's convention this camera looks backwards: the writer used the other one


class Maker(NamedTuple):
    """XMP names that one maker uses.

    Attributes:
        name: the maker.
        namespace: of its XMP properties, without a final slash; for Autel a word that it contains.
        height: property with the metres above take-off or above ground.
        pitch: property with the camera's pitch, degrees.
        roll: property with its roll, degrees.
        zero_deg: degrees to add to the pitch to count from nadir.
        yaw: property with its yaw, degrees.
        focal_px: property with the focal length in pixels of the full image; empty if the maker has none.
        centre_px: property with the column of the optical centre in the same pixels; empty if the maker has none.
        focal_mm: property with the focal length, mm; empty if the maker has none.
    """

    name: str
    namespace: str
    height: str
    pitch: str
    roll: str
    zero_deg: float
    yaw: str = ""
    focal_px: str = ""
    centre_px: str = ""
    focal_mm: str = ""


_DJI_NAMES = (
    "RelativeAltitude",
    "GimbalPitchDegree",
    "GimbalRollDegree",
    _ZERO_IS_FORWARD,
    "GimbalYawDegree",
    "CalibratedFocalLength",
    "CalibratedOpticalCenterX",
)
MAKERS: tuple[Maker, ...] = (
    Maker("DJI", "http://www.dji.com/drone-dji/1.0", *_DJI_NAMES),  # newer Autel drones use the same names
    Maker("Autel", _AUTEL, *_DJI_NAMES),
    Maker(
        "Skydio",
        "https://www.skydio.com/drone-skydio/1.0",
        "RelativeAltitude",
        "CameraOrientationNED/Pitch",
        "CameraOrientationNED/Roll",
        _ZERO_IS_FORWARD,
        "CameraOrientationNED/Yaw",
        "CalibratedFocalLengthX",
        "CalibratedOpticalCenterX",
    ),
    Maker(
        "Parrot",
        "http://www.parrot.com/drone-parrot/1.0",
        "",  # is in Pix4D's namespace
        "CameraPitchDegree",
        "CameraRollDegree",
        _ZERO_IS_FORWARD,
        "CameraYawDegree",
    ),
    Maker(  # senseFly, Parrot, older Autel drones
        "Pix4D",
        _PIX4D,
        "AboveGroundAltitude",
        "Pitch",
        "Roll",
        _ZERO_IS_DOWN,
        "Yaw",
        focal_mm="PerspectiveFocalLength",
    ),
)
"""In order of precedence: the first maker with a value is used."""


@dataclass(frozen=True)
class CameraMetadata:
    """Camera and its position; None for values that the file lacks.

    Attributes:
        make: of the camera, from EXIF; empty if unknown.
        model: of the camera, from EXIF; empty if unknown.
        height_m: metres above take-off, or above ground if the maker knows it; never above sea level.
        height_tag: maker and property of the height, for example ``DJI RelativeAltitude``.
        focal_mm: focal length, millimetres.
        focal_35mm: focal length of a 35 mm camera with the same view, millimetres.
        focal_px: calibrated focal length, pixels of the original image.
        pixel_mm: pixel pitch of the sensor for the original image, millimetres.
        taken_width_px: columns of the original image, as stored.
        taken_height_px: rows of the original image.
        centre_x_px: column of the optical centre in the original image.
        off_nadir_deg: off-nadir angle of the optical axis, 0 to 180.
        roll_deg: clockwise rotation of the image about the optical axis by the gimbal.
        digital_zoom: digital zoom factor; 1 for none.
        latitude_deg: latitude, positive to the north.
        longitude_deg: longitude, positive to the east.
        altitude_m: metres above sea level.
        taken_at: local time of the photograph, as EXIF writes it (2025:10:05 16:40:31); empty if unknown.
        refused: why the metadata were refused, as a clause; empty if they were read.
    """

    make: str = ""
    model: str = ""
    height_m: float | None = None
    height_tag: str = ""
    focal_mm: float | None = None
    focal_35mm: float | None = None
    focal_px: float | None = None
    pixel_mm: float | None = None
    taken_width_px: int | None = None
    taken_height_px: int | None = None
    centre_x_px: float | None = None
    off_nadir_deg: float | None = None
    digital_zoom: float = 1.0
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    roll_deg: float | None = None
    taken_at: str = ""
    refused: str = ""


def read_camera(read_at: ReadAt) -> CameraMetadata | None:
    """Read the camera metadata of an encoded image; None if it has none.

    Time and memory are bounded, so untrusted files are safe.
    """
    blocks = find_metadata(read_at)
    tags: ExifTags = {} if blocks.exif is None else read_exif(blocks.exif, MAX_XMP_BYTES)
    notes = tags.get("ApplicationNotes")
    packet = blocks.xmp or (notes if isinstance(notes, bytes) else None)
    properties, refused = ({}, "") if packet is None else read_xmp(packet)
    camera = _combine(tags, {(_namespace(space), name): text for (space, name), text in properties.items()}, refused)
    return None if camera == CameraMetadata() else camera


def _namespace(address: str) -> str:
    return _AUTEL if _AUTEL in address.lower() else address.rstrip("/")


def _combine(tags: ExifTags, properties: Mapping[tuple[str, str], str], refused: str) -> CameraMetadata:
    def first(field: str) -> tuple[float | None, Maker | None]:
        for maker in MAKERS:
            name = getattr(maker, field)
            value = _number(properties.get((maker.namespace, name))) if name else None
            if value is not None:
                return value, maker
        return None, None

    height, maker = first("height")
    focal_mm = first("focal_mm")[0]
    width, rows = _whole(tags.get("PixelXDimension")), _whole(tags.get("PixelYDimension"))
    return CameraMetadata(
        make=_text(tags.get("Make")),
        model=_text(tags.get("Model")),
        height_m=height,
        height_tag="" if maker is None else f"{maker.name} {maker.height}",
        focal_mm=focal_mm if focal_mm is not None else _float(tags.get("FocalLength")),
        focal_35mm=_float(tags.get("FocalLengthIn35mmFilm")) or None,  # 0 is "unknown" in the standard
        focal_px=first("focal_px")[0],
        pixel_mm=_pixel_mm(tags),
        taken_width_px=width if width and rows else None,
        taken_height_px=rows if width and rows else None,
        centre_x_px=first("centre_px")[0],
        off_nadir_deg=_off_nadir(properties, _text(tags.get("Make"))),
        digital_zoom=_float(tags.get("DigitalZoomRatio")) or 1.0,  # 0 is "not used"
        roll_deg=_gimbal_roll(properties),
        **_position(tags),
        taken_at=_text(tags.get("DateTimeOriginal")),
        refused=refused,
    )


def _gimbal_roll(properties: Mapping[tuple[str, str], str]) -> float | None:
    """Give the gimbal's roll from the first maker with a pitch; None if it is unknown or zero."""
    for maker in MAKERS:
        if _number(properties.get((maker.namespace, maker.pitch))) is None:
            continue
        roll = _number(properties.get((maker.namespace, maker.roll)))
        return roll or None if maker.zero_deg == _ZERO_IS_FORWARD else None
    return None


def _position(tags: ExifTags) -> dict[str, float | None]:
    """Give latitude, longitude and altitude; empty if latitude or longitude is invalid."""
    north, east = _float(tags.get("GPSLatitude")), _float(tags.get("GPSLongitude"))
    if north is None or east is None or north > 90 or east > 180 or north == east == 0:  # 0, 0 is "no fix"
        return {}
    above, below = _float(tags.get("GPSAltitude")), tags.get("GPSAltitudeRef") == 1
    return {
        "latitude_deg": -north if tags.get("GPSLatitudeRef") == "S" else north,
        "longitude_deg": -east if tags.get("GPSLongitudeRef") == "W" else east,
        "altitude_m": None if above is None else -above if below else above,
    }


def _off_nadir(properties: Mapping[tuple[str, str], str], make: str) -> float | None:
    """Compute the off-nadir angle from the first maker with a pitch, and from its roll if it has one."""
    for maker in MAKERS:
        pitch = _number(properties.get((maker.namespace, maker.pitch)))
        roll = _number(properties.get((maker.namespace, maker.roll))) or 0.0
        yaw = _number(properties.get((maker.namespace, maker.yaw))) or 0.0
        if pitch is None:
            continue
        zero = maker.zero_deg
        if zero == _ZERO_IS_FORWARD and pitch == roll == yaw == 0:
            continue  # some drones write zeros for unknown angles
        # In Pix4D's convention 0 is nadir; Autel writes -90 in the same namespace.
        if zero == _ZERO_IS_DOWN and (pitch <= _BACKWARDS_DEG or (pitch < 0 and "autel" in make.lower())):
            zero = _ZERO_IS_FORWARD
        from_down = math.radians(pitch + zero)
        if zero == _ZERO_IS_FORWARD:  # a gimbal's roll turns the image about the optical axis
            return math.degrees(math.acos(math.cos(from_down)))
        return math.degrees(math.acos(max(-1.0, min(1.0, math.cos(from_down) * math.cos(math.radians(roll))))))
    return None


def _number(text: str | None) -> float | None:
    """Parse a decimal number or a fraction, with or without a unit; the first if commas separate several."""
    matched = None if text is None else _NUMBER.match(text)
    if matched is None:
        return None
    denominator = float(matched[2] or 1)
    value = float(matched[1]) / denominator if denominator else math.nan
    return value if math.isfinite(value) else None


def _pixel_mm(tags: ExifTags) -> float | None:
    per_unit, unit = _float(tags.get("FocalPlaneXResolution")), _whole(tags.get("FocalPlaneResolutionUnit")) or 2
    return _MM_PER_UNIT[unit] / per_unit if per_unit and per_unit > 0 and unit in _MM_PER_UNIT else None


def _float(value: object) -> float | None:
    return value if isinstance(value, float) else None


def _whole(value: object) -> int | None:
    return int(value) if isinstance(value, float) and 0 < value < 1e9 else None


def _text(value: object) -> str:
    return "".join(each for each in value if each.isprintable()) if isinstance(value, str) else ""
