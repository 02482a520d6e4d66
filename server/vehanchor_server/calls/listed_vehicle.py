"""Vehicles behind a scale in words, for planners who see no picture and want to drop one."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pydantic import Field

from vehanchor_server.base_model import FrozenModel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.pictures.evidence import ScaleEvidence

MAX_LISTED = 60
"""Most vehicles that are listed: more would not be read one by one. A choice."""


class ListedVehicle(FrozenModel):
    """A vehicle that the search found, or that the caller added."""

    number: int = Field(description="Its number in drop.")
    x_px: float = Field(description="Its centre, pixels of the full image from the left edge.")
    y_px: float = Field(description="Its centre, pixels from the upper edge.")
    length_px: float = Field(description="Length of its box, square pixels of the full image.")
    used: bool = Field(description="Whether the scale rests on it; false for an outlier.")


def list_vehicles(analysis: ScaleEvidence) -> tuple[ListedVehicle, ...]:
    """List the vehicles of an analysis, best first, at most 60."""
    detections = analysis.detections
    boxes = detections.boxes[:MAX_LISTED]
    centres = analysis.grid.to_file(boxes[:, :2]).tolist()
    vehicles = []
    for (x, y), length, number, kept in zip(
        centres,
        boxes[:, 2].tolist(),
        detections.numbers.tolist(),
        analysis.kept.tolist(),
        strict=False,
    ):
        vehicle = ListedVehicle(
            number=number,
            x_px=round(x, 1),
            y_px=round(y, 1),
            length_px=round(length, 1),
            used=kept,
        )
        vehicles.append(vehicle)
    return tuple(vehicles)


def vehicles_in_words(vehicles: Sequence[ListedVehicle], n_detections: int) -> str:
    """Describe each vehicle by its number, centre and length, and say how many are not listed."""
    if not vehicles:
        return "No vehicles."
    name = "Vehicles"
    if n_detections > len(vehicles):
        name = f"The {len(vehicles)} surest of {n_detections} vehicles"
    words = [_in_words(vehicle) for vehicle in vehicles]
    return f"{name} by their numbers in drop, at x, y, with lengths: {'; '.join(words)}."


def _in_words(vehicle: ListedVehicle) -> str:
    unused = "" if vehicle.used else " (outlier)"
    return (
        f"{vehicle.number} at {vehicle.x_px:.0f}, {vehicle.y_px:.0f}, "
        f"{vehicle.length_px:.0f} px{unused}"
    )
