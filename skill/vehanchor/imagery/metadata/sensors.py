"""Sensors of drone cameras, by the names that they write into EXIF (``sensors.toml``)."""

from __future__ import annotations

import tomllib
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

_FOCAL_ROUNDING_MM = 0.05
"""Rounding of a focal length in EXIF, which often has one decimal."""

_FIXED_LENS_RATIO = 1.03
"""Ratio of the longest to the shortest focal length up to which a lens counts as fixed."""


class Sensor(NamedTuple):
    """Sensor and lens of a camera.

    Attributes:
        name: name of the drone or payload.
        width_mm: long side of the whole sensor.
        height_mm: short side.
        focal_from_mm: shortest real focal length of the lens.
        focal_to_mm: longest real focal length.
        source: source of the numbers.
    """

    name: str
    width_mm: float
    height_mm: float
    focal_from_mm: float
    focal_to_mm: float
    source: str

    def focal_mm(self, stated_mm: float | None) -> float | None:
        """Choose the real focal length.

        Args:
            stated_mm: focal length in the metadata; None if they have none.

        Returns:
            The stated focal length; without one, that of a fixed lens. None if the sensor's lens
            cannot have the stated one.
        """
        if stated_mm is not None:
            shortest = self.focal_from_mm - _FOCAL_ROUNDING_MM
            longest = self.focal_to_mm + _FOCAL_ROUNDING_MM
            return stated_mm if shortest <= stated_mm <= longest else None
        if self.focal_to_mm > _FIXED_LENS_RATIO * self.focal_from_mm:
            return None
        return (self.focal_from_mm + self.focal_to_mm) / 2

    def pixel_mm(self, width_px: int, height_px: int) -> float:
        """Compute the pixel pitch of a picture that is as large as the sensor's shape allows.

        A picture of 16:9 has the full width of a sensor of 4:3; a picture of 4:3 has the full
        height of one of 3:2.

        Args:
            width_px: width of the picture, as taken or as a resized copy.
            height_px: height of the same picture.
        """
        long = max(width_px, height_px)
        short = min(width_px, height_px)
        return min(self.width_mm / long, self.height_mm / short)


def sensor_of(make: str, model: str) -> Sensor | None:
    """Look a camera up; None if the table lacks it.

    Args:
        make: EXIF's Make, in upper or lower case; only its first word counts.
        model: EXIF's Model.
    """
    words = make.split()
    if not words:
        return None
    maker = words[0].casefold()
    name = model.strip().casefold()
    return _sensors().get((maker, name))


@cache
def _sensors() -> Mapping[tuple[str, str], Sensor]:
    """Read the table; keys are make and model in lower case."""
    text = files(__package__).joinpath("sensors.toml").read_text(encoding="utf-8")
    sensors = {}
    for camera in tomllib.loads(text)["camera"]:
        shortest, longest = camera["focal_mm"]
        sensor = Sensor(
            name=camera["name"],
            width_mm=camera["width_mm"],
            height_mm=camera["height_mm"],
            focal_from_mm=shortest,
            focal_to_mm=longest,
            source=camera["source"],
        )
        for model in camera["models"]:
            sensors[camera["make"].casefold(), model.casefold()] = sensor
    return sensors
