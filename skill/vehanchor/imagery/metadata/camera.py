"""Camera metadata of an image file: height, focal length, orientation, original size.

Drones write the camera's height and orientation into XMP, under names that differ between makers
(``vehanchor.imagery.metadata.makers``). Focal length and sensor are in EXIF, which all makers
share. This module converts units and signs of angles, and refuses what it does not understand;
``vehanchor.rulers.camera`` measures with the numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

from vehanchor.imagery.metadata.blocks import MAX_XMP_BYTES, metadata_blocks
from vehanchor.imagery.metadata.crop import stated_crop
from vehanchor.imagery.metadata.exif import read_exif
from vehanchor.imagery.metadata.makers import MAKERS, makers_of
from vehanchor.imagery.metadata.projection import stated_projection
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

    TwoAngles: TypeAlias = tuple[float | None, float | None]
    """Two angles in degrees; None for an unknown one."""

_INCH = 2
_MM_PER_UNIT = {_INCH: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
"""Millimetres by FocalPlaneResolutionUnit: inch, cm, and TIFF/EP's mm and micrometre."""

_SENSOR_WIDTHS_MM = (4.0, 60.0)
"""Possible widths of an unknown sensor, from phones to medium format; our assumption.

A resized copy makes the sensor narrower.
"""

_SENSOR_TOLERANCE = 1.25
"""Ratio of a stated to a known width of a sensor; our assumption.

Pictures of another shape leave out a fifth of the columns.
"""


_MEASURED = "normal"
"""Status of a laser that measured; a target out of reach is ``TooFar``, with a distance of 0."""

_LEAST_LASER_M = 3.0
"""Least distance that DJI's laser range finders measure (DJI Mobile SDK)."""


def _xmp_names() -> tuple[str, ...]:
    """List the properties to find in XMP, each once; some programs flatten structures."""
    of_makers = dict.fromkeys(name for maker in MAKERS for name in maker.names)
    flattened = dict.fromkeys(name.replace("/", "") for name in of_makers if "/" in name)
    return (*IN_XMP, *of_makers, *flattened)


_XMP_NAMES = _xmp_names()


@dataclass(frozen=True)
class CameraMetadata:
    """Camera and its position; None for values that the file lacks.

    Attributes:
        make: maker of the camera, from EXIF; empty if unknown.
        model: model of the camera, from EXIF; empty if unknown.
        height_m: metres above take-off, or above ground if the maker knows it; never above sea
            level.
        height_tag: maker and property of the height, for example ``DJI RelativeAltitude``.
        laser_m: metres in a straight line to what the optical axis meets, by a laser range finder
            that states that it measured.
        laser_tag: maker and property of that distance.
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
        projection: what the file states of a picture that is not one perspective view, such as
            "ProjectionType equirectangular"; empty for a perspective view.
        crop: what shows that the image is a part of the photograph, as a clause; empty if nothing
            does.
        refused: why metadata were not used, as clauses with semicolons; empty if all was read.
        is_film: whether the facts are those of a film, whose mode may use a part of the sensor.
    """

    make: str = ""
    model: str = ""
    height_m: float | None = None
    height_tag: str = ""
    laser_m: float | None = None
    laser_tag: str = ""
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
    projection: str = ""
    crop: str = ""
    refused: str = ""
    is_film: bool = False


def read_camera(read_at: ReadAt, header: ImageHeader) -> CameraMetadata | None:
    """Read the camera metadata of an encoded image; None if it has none.

    Time and memory are bounded, so untrusted files are safe.
    """
    exif, xmp = metadata_blocks(read_at, header)
    if not exif and not xmp:
        return None
    tags = [read_exif(block) for block in exif]
    for block_tags in tags:
        packet_of_tiff = block_tags.get("ApplicationNotes")
        if isinstance(packet_of_tiff, bytes):
            xmp.append(packet_of_tiff)
    packets, refused = _read_packets(xmp)
    statements = Statements(tags, packets, refused)
    camera = _combine(statements, tags, header)
    return None if camera == CameraMetadata() else camera


def _read_packets(xmp: Sequence[bytes]) -> tuple[list[Properties], list[str]]:
    """Read the properties of XMP packets, and the reasons why packets were refused.

    The packets share ``MAX_XMP_BYTES``; the last ones can be cut or left out.
    """
    packets: list[Properties] = []
    reasons: list[str] = []
    bytes_left = MAX_XMP_BYTES
    for packet in xmp:
        limited = packet[: max(0, bytes_left)]
        bytes_left -= len(packet)
        if limited:
            properties, reason = read_xmp(limited, _XMP_NAMES)
            packets.append(properties)
            reasons.append(reason)
    # A damaged packet does not matter if another one has the properties.
    ignored = {"", DAMAGED} if any(packets) else {""}
    return packets, [reason for reason in reasons if reason not in ignored]


def _combine(
    statements: Statements, tags: Sequence[ExifTags], header: ImageHeader
) -> CameraMetadata:
    """Combine the statements of all blocks."""
    make = statements.text("Make")
    model = statements.text("Model")
    makers = makers_of(make)
    height_m, height_tag = _first_quantity(statements, makers, field="height", units=METRES)
    laser_m, laser_tag = _laser(statements, makers)
    focal_px, _ = _first_quantity(statements, makers, field="focal_px", units=PIXELS)
    centre_px, _ = _first_quantity(statements, makers, field="centre_px", units=PIXELS)
    focal_mm = statements.lens_number("FocalLength")
    # A maker's millimetres replace those of EXIF; its pixels only fill a gap.
    maker_focal, unit = _maker_focal(statements, makers)
    if maker_focal is not None:
        if unit == "mm":
            focal_mm = maker_focal
        else:
            focal_px = focal_px or maker_focal
    taken_width_px = statements.whole("PixelXDimension")
    taken_height_px = statements.whole("PixelYDimension")
    # One side alone does not give the size of the original image.
    if not taken_width_px or not taken_height_px:
        taken_width_px = None
        taken_height_px = None
    off_nadir, roll = _attitude(statements, makers)
    latitude, longitude = _position(statements, makers, tags)
    return CameraMetadata(
        make=make,
        model=model,
        height_m=height_m,
        height_tag=height_tag,
        laser_m=laser_m,
        laser_tag=laser_tag,
        focal_mm=focal_mm,
        focal_35mm=statements.lens_number("FocalLengthIn35mmFilm"),
        focal_px=focal_px,
        pixel_mm=_pixel_mm(statements, taken_width_px, make=make, model=model),
        taken_width_px=taken_width_px,
        taken_height_px=taken_height_px,
        centre_x_px=centre_px,
        off_nadir_deg=off_nadir,
        digital_zoom=statements.lens_number("DigitalZoomRatio") or 1.0,
        roll_deg=roll,
        latitude_deg=latitude,
        longitude_deg=longitude,
        taken_at=statements.text("DateTimeOriginal"),
        projection=stated_projection(statements, header),
        crop=stated_crop(statements, header),
        refused="; ".join(dict.fromkeys(statements.refused)),
    )


def _first_quantity(
    statements: Statements,
    makers: Sequence[Maker],
    *,
    field: str,
    units: Mapping[str, float],
) -> tuple[float | None, str]:
    """Read a quantity of the first maker that has it, and the maker's and the property's name."""
    for maker in makers:
        name = getattr(maker, field)
        if not name:
            continue
        value = statements.quantity(maker, name, units)
        if value is not None:
            return value, f"{maker.name} {name}"
    return None, ""


def _laser(statements: Statements, makers: Sequence[Maker]) -> tuple[float | None, str]:
    """Read the distance by a laser that measured, and the maker's and the property's name."""
    for maker in makers:
        if not maker.laser or statements.word(maker, maker.laser_status) != _MEASURED:
            continue
        distance_m = statements.quantity(maker, maker.laser, METRES)
        if distance_m is not None and distance_m >= _LEAST_LASER_M:
            return distance_m, f"{maker.name} {maker.laser}"
    return None, ""


def _maker_focal(statements: Statements, makers: Sequence[Maker]) -> tuple[float | None, str]:
    """Read the focal length of the first maker that has one with a unit, and the unit."""
    for maker in makers:
        if not maker.focal:
            continue
        value, unit = statements.focal(maker)
        if value is not None:
            return value, unit
    return None, ""


def _attitude(statements: Statements, makers: Sequence[Maker]) -> TwoAngles:
    """Compute the off-nadir angle and the gimbal's roll from the first maker with a pitch.

    Returns:
        Degrees; None for an unknown angle.
    """
    for maker in makers:
        pitch = statements.quantity(maker, maker.pitch, DEGREES)
        if pitch is None:
            continue
        roll = statements.quantity(maker, maker.roll, DEGREES) or 0.0
        is_from_horizon = pitch < maker.level_below_deg
        if is_from_horizon and pitch == roll == 0:
            statements.refused.append(
                f"{maker.name} {maker.pitch} and {maker.roll} are 0, as some drones write unknown "
                "angles"
            )
            continue
        pitch_from_nadir = pitch
        if is_from_horizon:
            pitch_from_nadir += 90
        from_nadir = math.radians(pitch_from_nadir)
        # A gimbal's roll turns the image about the optical axis, so it does not tilt the camera.
        if maker.level_below_deg == math.inf:
            # Any angle becomes one of 0 to 180 degrees.
            off_nadir = math.acos(math.cos(from_nadir))
            return math.degrees(off_nadir), roll or None
        # Counted from nadir, the roll tilts the camera, too: the cosines of both tilts multiply.
        # Counted from the horizon, it turns the image about the optical axis.
        cosine = math.cos(from_nadir)
        if not is_from_horizon:
            cosine *= math.cos(math.radians(roll))
        off_nadir = math.acos(max(-1.0, min(1.0, cosine)))
        return math.degrees(off_nadir), None
    return None, None


def _position(
    statements: Statements, makers: Sequence[Maker], tags: Sequence[ExifTags]
) -> TwoAngles:
    """Get latitude and longitude from EXIF, or else from a maker's properties.

    Returns:
        Degrees; None if there is none, or if it is invalid.
    """
    with_position = (block for block in tags if "GPSLatitude" in block)
    block = next(with_position, None)
    if block is not None:
        return _checked_position(*_position_in_exif(block))
    for maker in makers:
        for latitude_name, longitude_name in maker.positions:
            latitude = statements.quantity(maker, latitude_name, DEGREES)
            longitude = statements.quantity(maker, longitude_name, DEGREES)
            if latitude is not None and longitude is not None:
                return _checked_position(latitude, longitude)
    return None, None


def _position_in_exif(block: ExifTags) -> TwoAngles:
    """Get latitude and longitude of a block, with the signs of their hemispheres."""
    latitude = block.get("GPSLatitude")
    longitude = block.get("GPSLongitude")
    if not isinstance(latitude, float) or not isinstance(longitude, float):
        return None, None
    if block.get("GPSLatitudeRef") == "S":
        latitude = -latitude
    if block.get("GPSLongitudeRef") == "W":
        longitude = -longitude
    return latitude, longitude


def _checked_position(latitude: float | None, longitude: float | None) -> TwoAngles:
    """Return a position on Earth; None for others, and without a fix."""
    if latitude is None or longitude is None:
        return None, None
    has_no_fix = latitude == longitude == 0
    if has_no_fix or abs(latitude) > 90 or abs(longitude) > 180:
        return None, None
    return latitude, longitude


def _pixel_mm(
    statements: Statements, width_px: int | None, *, make: str, model: str
) -> float | None:
    """Compute the pixel pitch from the focal plane's resolution.

    Args:
        statements: statements of the file.
        width_px: columns of the original image; None if unknown.
        make: EXIF's Make.
        model: EXIF's Model.

    Returns:
        Millimetres; None if the pitch is unknown, or if it makes the sensor impossibly wide.
    """
    pixels_per_unit = statements.lens_number("FocalPlaneXResolution")
    unit = statements.whole("FocalPlaneResolutionUnit") or _INCH
    if not pixels_per_unit or unit not in _MM_PER_UNIT:
        return None
    pixel_mm = _MM_PER_UNIT[unit] / pixels_per_unit
    if width_px is None:
        return pixel_mm
    sensor_mm = pixel_mm * width_px
    sensor = sensor_of(make, model)
    if sensor is None:
        min_mm, max_mm = _SENSOR_WIDTHS_MM
    else:
        min_mm = sensor.width_mm / _SENSOR_TOLERANCE
        max_mm = sensor.width_mm * _SENSOR_TOLERANCE
    if not min_mm <= sensor_mm <= max_mm:
        statements.refused.append(
            f"FocalPlaneXResolution implies a sensor {sensor_mm:.2g} mm wide, as in a resized copy"
        )
        return None
    return pixel_mm
