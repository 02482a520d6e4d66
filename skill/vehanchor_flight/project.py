"""Record of one photograph with the scale of its flight."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.rulers.camera_tilt import with_scale

if TYPE_CHECKING:
    from vehanchor.records import GsdEstimate, RulerScale
    from vehanchor_flight.records import FlightEstimate, FlightPhotograph


SCALE = ("gsd_m_per_px", "gsd_ci95_low_m_per_px", "gsd_ci95_high_m_per_px")
_OF_FLIGHT = (*SCALE, "status", "confidence", "scale", "reason")


def estimate_in_flight(flight: FlightEstimate, photograph: FlightPhotograph) -> GsdEstimate:
    """Replace a photograph's own scale by the scale of the flight.

    Args:
        flight: the flight of the photograph.
        photograph: a photograph with a record of its own.

    Returns:
        Its own record, with scale, interval, confidence, reason and rulers of its component, in its
        pixels.

    Raises:
        ValueError: the photograph could not be read and has no record.
    """
    if photograph.own is None or photograph.component is None:
        raise ValueError(f"{photograph.photograph} could not be read: it has no record")
    pooled = flight.components[photograph.component].pooled
    ratio = 1.0
    if photograph.gsd_m_per_px is not None and pooled.gsd_m_per_px is not None:
        ratio = photograph.gsd_m_per_px / pooled.gsd_m_per_px
    own_tilt = photograph.own.tilt
    return photograph.own.model_copy(
        update={
            **{name: getattr(photograph, name) for name in _OF_FLIGHT},
            "leading_ruler": pooled.leading_ruler,
            "rulers": tuple(_in_pixels(ruler, ratio) for ruler in pooled.rulers),
            "tilt": own_tilt and with_scale(own_tilt, photograph.own, photograph.gsd_m_per_px),
        }
    )


def _in_pixels(ruler: RulerScale, ratio: float) -> RulerScale:
    return ruler.model_copy(update={name: getattr(ruler, name) * ratio for name in SCALE})
