"""Record of one photograph with the scale of its flight."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.rulers.camera_tilt import with_scale

if TYPE_CHECKING:
    from vehanchor.records import GsdEstimate, RulerScale
    from vehanchor_flight.records import FlightEstimate, FlightPhotograph


SCALE_FIELDS = ("gsd_m_per_px", "gsd_ci95_low_m_per_px", "gsd_ci95_high_m_per_px")
_FLIGHT_FIELDS = (*SCALE_FIELDS, "status", "confidence", "scale", "reason")


def estimate_in_flight(flight: FlightEstimate, photograph: FlightPhotograph) -> GsdEstimate:
    """Replace a photograph's own scale by the scale of the flight.

    Args:
        flight: the flight of the photograph.
        photograph: a photograph with a record of its own.

    Returns:
        Its own record, with scale, interval, confidence, reason, remedies and rulers of its
        component, in its pixels.

    Raises:
        ValueError: the photograph could not be read and has no record.
    """
    own = photograph.own
    if own is None or photograph.component is None:
        raise ValueError(f"{photograph.photograph} could not be read: it has no record")
    pooled = flight.components[photograph.component].pooled
    # The rulers of the component are in pixels of its reference.
    ratio = 1.0
    if photograph.gsd_m_per_px is not None and pooled.gsd_m_per_px is not None:
        ratio = photograph.gsd_m_per_px / pooled.gsd_m_per_px
    tilt = own.tilt
    if tilt is not None:
        tilt = with_scale(tilt, own, photograph.gsd_m_per_px)
    changes = {name: getattr(photograph, name) for name in _FLIGHT_FIELDS}
    changes["leading_ruler"] = pooled.leading_ruler
    rulers = [_scaled(ruler, ratio) for ruler in pooled.rulers]
    changes["rulers"] = tuple(rulers)
    changes["tilt"] = tilt
    remedies = pooled.details.remedies
    changes["details"] = own.details.model_copy(update={"remedies": remedies})
    return own.model_copy(update=changes)


def _scaled(ruler: RulerScale, ratio: float) -> RulerScale:
    """Multiply a ruler's scale and interval."""
    scaled = {name: getattr(ruler, name) * ratio for name in SCALE_FIELDS}
    return ruler.model_copy(update=scaled)
