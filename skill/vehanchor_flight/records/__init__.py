"""Records of flights, running cameras and reconstructions."""

from __future__ import annotations

from vehanchor_flight.records.flight import FlightComponent, FlightEstimate, FlightLink, FlightPhotograph, FlightRuler
from vehanchor_flight.records.live import LiveScale
from vehanchor_flight.records.model_scale import ModelPhotograph, ModelRuler, ModelScale

__all__ = [
    "FlightComponent",
    "FlightEstimate",
    "FlightLink",
    "FlightPhotograph",
    "FlightRuler",
    "LiveScale",
    "ModelPhotograph",
    "ModelRuler",
    "ModelScale",
]
