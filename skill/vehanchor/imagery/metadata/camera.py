"""What a file's metadata say of the camera: its height, its focal length, where it looked, how large the picture was.

Drones write the height and the camera's attitude into XMP, under names of their maker; focal length and sensor stand in
EXIF, which all makers share. ``MAKERS`` is the table of names (docs/how-to/rulers.md tells where each is documented).
Nothing is computed here but units and the sense of angles; ``vehanchor.rulers.camera`` measures with it.
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
_AUTEL = "autel"  # its addresses changed with its firmware; each has the maker's name in it
_MM_PER_UNIT = {2: 25.4, 3: 10.0}  # EXIF's FocalPlaneResolutionUnit: inch, centimetre
_ZERO_IS_FORWARD, _ZERO_IS_DOWN = 90.0, 0.0  # degrees to add to a pitch to have it from straight down
_BACKWARDS_DEG = -60.0  # under Pix4D's rule such a camera looks behind itself: the writer meant the other rule


class Maker(NamedTuple):
    """Names under which one maker writes.

    Attributes:
        name: of the maker.
        namespace: of its XMP properties, without a slash at the end; for Autel a word of it.
        height: property with the metres above take-off, or above the ground.
        pitch: property with the camera's pitch, degrees.
        roll: property with its roll, degrees.
        zero_deg: what to add to the pitch to count from straight down.
        yaw: property with its yaw, degrees.
        focal_px: property with the focal length in pixels of the full picture; empty for none.
        centre_px: property with the optical centre's column in such pixels; empty for none.
        focal_mm: property with the focal length, mm; empty for none.
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
    Maker("DJI", "http://www.dji.com/drone-dji/1.0", *_DJI_NAMES),  # newer Autels write the same
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
        "",  # stands in Pix4D's namespace
        "CameraPitchDegree",
        "CameraRollDegree",
        _ZERO_IS_FORWARD,
        "CameraYawDegree",
    ),
    Maker(  # senseFly, Parrot, older Autels
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
"""In the order in which they are asked; the first with a value answers."""


@dataclass(frozen=True)
class CameraMetadata:
    """A camera and its place, as far as the file says; None for what it does not say.

    Attributes:
        make: of the camera, as EXIF has it; empty where it does not say.
        model: of the camera.
        height_m: metres above take-off, or above the ground where the maker knows it; never above the sea.
        height_tag: where that stands, ``DJI RelativeAltitude`` for one.
        focal_mm: focal length, millimetres.
        focal_35mm: focal length of a 35 mm camera with the same view, millimetres.
        focal_px: calibrated focal length, pixels of the picture as it was taken.
        pixel_mm: pitch of the sensor's pixels, millimetres, of the picture as it was taken.
        taken_width_px: columns of the picture as it was taken, as stored.
        taken_height_px: its rows.
        centre_x_px: column of the optical centre in the picture as it was taken.
        off_nadir_deg: angle between the camera's axis and straight down, 0 to 180.
        roll_deg: by which a gimbal turned the picture about the camera's own axis, clockwise.
        digital_zoom: factor of enlarging in the camera; 1 for none.
        latitude_deg: where it was, north is positive.
        longitude_deg: east is positive.
        altitude_m: metres above the sea.
        refused: why metadata were not read, as a clause; empty where they were.
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
    refused: str = ""


def read_camera(read_at: ReadAt) -> CameraMetadata | None:
    """Read what an encoded image says of its camera, in bounded time and memory, whatever its bytes.

    Args:
        read_at: of the file.

    Returns:
        What it says; None where it says nothing.
    """
    blocks = find_metadata(read_at)
    tags: ExifTags = {} if blocks.exif is None else read_exif(blocks.exif, MAX_XMP_BYTES)
    notes = tags.get("ApplicationNotes")
    packet = blocks.xmp or (notes if isinstance(notes, bytes) else None)
    properties, refused = ({}, "") if packet is None else read_xmp(packet)
    said = _combined(tags, {(_namespace(space), name): text for (space, name), text in properties.items()}, refused)
    return None if said == CameraMetadata() else said


def _namespace(address: str) -> str:
    return _AUTEL if _AUTEL in address.lower() else address.rstrip("/")


def _combined(tags: ExifTags, properties: Mapping[tuple[str, str], str], refused: str) -> CameraMetadata:
    def first(field: str) -> tuple[float | None, Maker | None]:
        for maker in MAKERS:
            name = getattr(maker, field)
            value = _number(properties.get((maker.namespace, name))) if name else None
            if value is not None:
                return value, maker
        return None, None

    height, of = first("height")
    focal_mm = first("focal_mm")[0]
    width, rows = _whole(tags.get("PixelXDimension")), _whole(tags.get("PixelYDimension"))
    return CameraMetadata(
        make=_text(tags.get("Make")),
        model=_text(tags.get("Model")),
        height_m=height,
        height_tag="" if of is None else f"{of.name} {of.height}",
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
        refused=refused,
    )


def _gimbal_roll(properties: Mapping[tuple[str, str], str]) -> float | None:
    """Roll of the first maker who tells a pitch, where it is a gimbal's; None where it says nothing, or nothing new."""
    for maker in MAKERS:
        if _number(properties.get((maker.namespace, maker.pitch))) is None:
            continue
        roll = _number(properties.get((maker.namespace, maker.roll)))
        return roll or None if maker.zero_deg == _ZERO_IS_FORWARD else None
    return None


def _position(tags: ExifTags) -> dict[str, float | None]:
    """Latitude, longitude and altitude; nothing where latitude or longitude has no meaning."""
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
    """Angle from straight down, by pitch and roll of the first maker who says both or the pitch alone."""
    for maker in MAKERS:
        pitch = _number(properties.get((maker.namespace, maker.pitch)))
        roll = _number(properties.get((maker.namespace, maker.roll))) or 0.0
        yaw = _number(properties.get((maker.namespace, maker.yaw))) or 0.0
        if pitch is None:
            continue
        zero = maker.zero_deg
        if zero == _ZERO_IS_FORWARD and pitch == roll == yaw == 0:
            continue  # some drones write zeros for what they do not know
        # Pix4D's rule has 0 for down; some that write in its namespace (Autel) have -90 for it.
        if zero == _ZERO_IS_DOWN and (pitch <= _BACKWARDS_DEG or (pitch < 0 and "autel" in make.lower())):
            zero = _ZERO_IS_FORWARD
        from_down = math.radians(pitch + zero)
        if zero == _ZERO_IS_FORWARD:  # a gimbal's roll turns the picture about the camera's own axis
            return math.degrees(math.acos(math.cos(from_down)))
        return math.degrees(math.acos(max(-1.0, min(1.0, math.cos(from_down) * math.cos(math.radians(roll))))))
    return None


def _number(text: str | None) -> float | None:
    """A decimal number, or a fraction, with or without a unit behind it; of several with commas the first."""
    matched = None if text is None else _NUMBER.match(text)
    if matched is None:
        return None
    below = float(matched[2] or 1)
    value = float(matched[1]) / below if below else math.nan
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
