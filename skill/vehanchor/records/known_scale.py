"""Known scale of an image, which a caller gives back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field, ValidationError

from vehanchor.errors import InvalidParameterError
from vehanchor.records.record import Record

_WIDEST_M_PER_PX = 1e9  # above every estimate, with a finite square


class KnownPlane(Record, strict=True):
    """Tilt of the camera, for a known scale of the image's centre."""

    tilt_deg: float = Field(gt=0, lt=90, description="Angle between the camera's axis and straight down.")
    roll_deg: float = Field(
        ge=-360, le=360, description="Direction of the tilt, clockwise from the image's upper side."
    )
    focal_length_px: float = Field(gt=0, description="Focal length, pixels of the full image.")


class KnownScale(Record, strict=True):  # input from callers: true is not a number
    """Scale to give back for the next measurement in the same image, without a search."""

    gsd_m_per_px: float = Field(gt=0, description="Metres per pixel of the full image.")
    gsd_ci95_low_m_per_px: float = Field(gt=0, description="Lower end of its 95 % interval.")
    gsd_ci95_high_m_per_px: float = Field(gt=0, description="Upper end of its 95 % interval.")
    confidence: float = Field(ge=0, le=1, description="Confidence in the scale.")
    image_id: str = Field(max_length=64, description="Identifies the image; the scale is for this image only.")
    model_id: str = Field(max_length=64, description="First digits of the detector's checksum.")
    plane: KnownPlane | None = Field(
        default=None,
        exclude_if=lambda plane: plane is None,
        description="Tilt of the camera; absent for a camera that points straight down.",
    )


def known_scale(given: Any) -> KnownScale:
    """Read a scale that a caller gives back.

    Args:
        given: a ``KnownScale``, a record with one as its ``scale``, or either as a mapping.

    Raises:
        InvalidParameterError: the value is none of these, has no scale, or is not the scale of an estimate.
    """
    found = given
    if isinstance(given, Mapping):
        found = given.get("scale", given)
    elif isinstance(given, Record) and "scale" in type(given).model_fields:
        found = getattr(given, "scale", None)
    if found is None:
        raise InvalidParameterError("scale is a record without a scale: give an estimate that has one")
    if isinstance(found, Mapping):
        try:
            found = KnownScale.model_validate(found)
        except ValidationError as error:
            wrong = error.errors()[0]
            place = ".".join(map(str, wrong["loc"])) or "scale"
            raise InvalidParameterError(
                f"scale is not what an estimate gave as scale: {place}: {wrong['msg']}. Give it back unchanged"
            ) from None
    if not isinstance(found, KnownScale):
        raise InvalidParameterError(
            f"scale is a {type(found).__name__}: give back an estimate or its scale; a number is gsd_m_per_px"
        )
    low, high = found.gsd_ci95_low_m_per_px, found.gsd_ci95_high_m_per_px
    if not low <= found.gsd_m_per_px <= high:
        raise InvalidParameterError("scale is not what an estimate gave: its value lies outside its interval")
    if not 1 / _WIDEST_M_PER_PX <= low <= high <= _WIDEST_M_PER_PX:
        raise InvalidParameterError(f"scale is not what an estimate gave: {found.gsd_m_per_px:g} m/px is no image's")
    return found
