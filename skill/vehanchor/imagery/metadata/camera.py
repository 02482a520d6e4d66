"""Camera metadata of an image file: height, focal length, orientation, original size.

Drones write the camera's height and orientation into XMP, under names that differ between makers
(``vehanchor.imagery.metadata.makers``). Focal length and sensor are in EXIF, which all makers
share. This module converts units and signs of angles, and refuses what it does not understand;
``vehanchor.rulers.camera`` measures with the numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate
from typing import TYPE_CHECKING

from vehanchor.imagery.metadata.blocks import MAX_XMP_BYTES, metadata_blocks
from vehanchor.imagery.metadata.exif import read_exif
from vehanchor.imagery.metadata.makers import MAKERS, makers_of
from vehanchor.imagery.metadata.sensors import sensor_of
from vehanchor.imagery.metadata.statements import DEGREES, IN_XMP, METRES, PIXELS, Statements
from vehanchor.imagery.metadata.xmp import DAMAGED, read_xmp

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from vehanchor.imagery.formats.ifd import ReadAt
    from vehanchor.imagery.formats.image_header import ImageHeader
    from vehanchor.imagery.metadata.exif import ExifTags
    from vehanchor.imagery.metadata.makers import Maker
    from vehanchor.imagery.metadata.xmp import Properties

# FocalPlaneResolutionUnit: inch, cm; TIFF/EP's mm, micrometre
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
# a choice: from phones to medium format; a resized copy has a narrower one
_SENSOR_WIDTHS_MM = (4.0, 60.0)
_SENSOR_TOLERANCE = 1.25  # a choice: pictures of another shape leave a fifth of the columns out
_OF_MAKERS = dict.fromkeys(name for each in MAKERS for name in each.names)
_NAMES = (
    *IN_XMP,
    *_OF_MAKERS,
    *{name.replace("/", ""): None for name in _OF_MAKERS if "/" in name},
)
"""Properties to find in XMP; some programs flatten structures."""


@dataclass(frozen=True)
class CameraMetadata:
    """Camera and its position; None for values that the file lacks.

    Attributes:
        make: of the camera, from EXIF; empty if unknown.
        model: of the camera, from EXIF; empty if unknown.
        height_m: metres above take-off, or above ground if the maker knows it; never above sea
            level.
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
        taken_at: local time of the photograph, as EXIF writes it (2025:10:05 16:40:31); empty if
            unknown.
        refused: what was not used and why, as clauses with semicolons; empty if all was read.
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
    roll_deg: float | None = None
    taken_at: str = ""
    refused: str = ""


def read_camera(read_at: ReadAt, header: ImageHeader) -> CameraMetadata | None:
    """Read the camera metadata of an encoded image; None if it has none.

    Time and memory are bounded, so untrusted files are safe.
    """
    exif, xmp = metadata_blocks(read_at, header)
    if not exif and not xmp:
        return None
    tags = [read_exif(each) for each in exif]
    xmp += [notes for each in tags if isinstance(notes := each.get("ApplicationNotes"), bytes)]
    starts = accumulate(map(len, xmp), initial=0)
    packets = [
        packet[: max(0, MAX_XMP_BYTES - start)] for start, packet in zip(starts, xmp, strict=False)
    ]
    read = [read_xmp(each, _NAMES) for each in packets if each]
    without = DAMAGED if any(found for found, _ in read) else ""  # of others: one had what there is
    refused = [reason for _, reason in read if reason not in ("", without)]
    camera = _combine(tags, [found for found, _ in read], refused)
    return None if camera == CameraMetadata() else camera


def _combine(
    tags: Sequence[ExifTags], packets: Sequence[Properties], refused: Sequence[str]
) -> CameraMetadata:
    stated = Statements(tags, packets, refused)
    make = stated.text("Make")
    model = stated.text("Model")
    makers = makers_of(make)
    height, height_tag = _first(stated, makers, field="height", units=METRES)
    focal_px, _ = _first(stated, makers, field="focal_px", units=PIXELS)
    centre_px, _ = _first(stated, makers, field="centre_px", units=PIXELS)
    focal_mm = stated.lens_number("FocalLength")
    for each in makers:
        value, unit = stated.focal(each) if each.focal else (None, "")
        if value is not None:
            focal_px, focal_mm = (
                (focal_px or value, focal_mm) if unit == "px" else (focal_px, value)
            )
            break
    width = stated.whole("PixelXDimension")
    rows = stated.whole("PixelYDimension")
    off_nadir, roll = _attitude(stated, makers)
    return CameraMetadata(
        make=make,
        model=model,
        height_m=height,
        height_tag=height_tag,
        focal_mm=focal_mm,
        focal_35mm=stated.lens_number("FocalLengthIn35mmFilm"),
        focal_px=focal_px,
        pixel_mm=_pixel_mm(stated, width if rows else None, make=make, model=model),
        taken_width_px=width if width and rows else None,
        taken_height_px=rows if width and rows else None,
        centre_x_px=centre_px,
        off_nadir_deg=off_nadir,
        digital_zoom=stated.lens_number("DigitalZoomRatio") or 1.0,
        roll_deg=roll,
        **_position(next((each for each in tags if "GPSLatitude" in each), {})),
        taken_at=stated.text("DateTimeOriginal"),
        refused="; ".join(dict.fromkeys(stated.refused)),
    )


def _first(
    stated: Statements, makers: Sequence[Maker], field: str, units: Mapping[str, float]
) -> tuple[float | None, str]:
    """Take a quantity from the first maker that has it; give it with the maker's and the property's name."""
    for each in makers:
        name = getattr(each, field)
        value = stated.quantity(each, name, units) if name else None
        if value is not None:
            return value, f"{each.name} {name}"
    return None, ""


def _attitude(stated: Statements, makers: Sequence[Maker]) -> tuple[float | None, float | None]:
    """Compute the off-nadir angle and the gimbal's roll from the first maker with a pitch; None for unknown ones."""
    for each in makers:
        pitch = stated.quantity(each, each.pitch, DEGREES)
        if pitch is None:
            continue
        roll = stated.quantity(each, each.roll, DEGREES) or 0.0
        level = pitch < each.level_below_deg
        if level and pitch == roll == 0:
            stated.refused.append(
                f"{each.name} {each.pitch} and {each.roll} are 0, as some drones write unknown "
                "angles"
            )
            continue
        from_down = math.radians(pitch + 90 if level else pitch)
        # a gimbal's roll turns the image about the optical axis
        if each.level_below_deg == math.inf:
            return math.degrees(math.acos(math.cos(from_down))), roll or None
        tilt = math.cos(from_down) * (1.0 if level else math.cos(math.radians(roll)))
        return math.degrees(math.acos(max(-1.0, min(1.0, tilt)))), None
    return None, None


def _position(tags: ExifTags) -> dict[str, float]:
    """Give latitude and longitude; empty if one is invalid."""
    north = tags.get("GPSLatitude")
    east = tags.get("GPSLongitude")
    if not isinstance(north, float) or not isinstance(east, float):
        return {}
    if north > 90 or east > 180 or north == east == 0:  # 0, 0 is "no fix"
        return {}
    return {
        "latitude_deg": -north if tags.get("GPSLatitudeRef") == "S" else north,
        "longitude_deg": -east if tags.get("GPSLongitudeRef") == "W" else east,
    }


def _pixel_mm(stated: Statements, width_px: int | None, make: str, model: str) -> float | None:
    """Compute the pixel pitch from the focal plane's resolution; None if the sensor that it makes is impossible."""
    per_unit = stated.lens_number("FocalPlaneXResolution")
    unit = stated.whole("FocalPlaneResolutionUnit") or 2
    if not per_unit or per_unit < 0 or unit not in _MM_PER_UNIT:
        return None
    pixel_mm = _MM_PER_UNIT[unit] / per_unit
    wide = pixel_mm * (width_px or 0)
    sensor = sensor_of(make, model)
    least, most = (
        _SENSOR_WIDTHS_MM
        if sensor is None
        else (sensor.width_mm / _SENSOR_TOLERANCE, sensor.width_mm * _SENSOR_TOLERANCE)
    )
    if width_px and not least <= wide <= most:
        stated.refused.append(
            f"FocalPlaneXResolution makes the sensor {wide:.2g} mm wide, as in a copy of "
            "another size"
        )
        return None
    return pixel_mm
