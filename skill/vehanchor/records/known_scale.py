"""The scale of an image in the few fields that a caller gives back."""

from __future__ import annotations

from pydantic import Field

from vehanchor.records.record import Record


class KnownPlane(Record, strict=True):
    """Tilt of the camera, for a scale that is given back and holds at the image's centre."""

    tilt_deg: float = Field(gt=0, lt=90, description="Angle between the camera's axis and straight down.")
    roll_deg: float = Field(
        ge=-360, le=360, description="Direction of the tilt, clockwise from the image's upper side."
    )
    focal_length_px: float = Field(gt=0, description="Focal length, pixels of the full image.")


class KnownScale(Record, strict=True):  # it comes back from callers: true is no metre
    """A scale to give back for the next measurement in the same image, which then needs no search."""

    gsd_m_per_px: float = Field(gt=0, description="Metres per pixel of the full image.")
    gsd_ci95_low_m_per_px: float = Field(gt=0, description="Lower end of its 95 % interval.")
    gsd_ci95_high_m_per_px: float = Field(gt=0, description="Upper end of its 95 % interval.")
    confidence: float = Field(ge=0, le=1, description="Confidence in the scale.")
    image_id: str = Field(max_length=64, description="Checksum of the image's pixels: it holds for no other image.")
    model_id: str = Field(max_length=64, description="First digits of the checksum of the detector.")
    plane: KnownPlane | None = Field(
        default=None,
        exclude_if=lambda plane: plane is None,
        description="Tilt of the camera; absent for a camera that points straight down.",
    )
