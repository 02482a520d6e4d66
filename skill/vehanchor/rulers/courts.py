"""Sports courts as a ruler: the rules of tennis and basketball fix the size of a court."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.courts.find import find_courts
from vehanchor.rulers.ruler import Ruler, point_witness
from vehanchor.scale.density import on_grid
from vehanchor.scale.posterior import Mark
from vehanchor.scale.reliability import RELIABILITY

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.courts.find import Court
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.posterior import Witness

_APART = 0.06  # of the log of the scale: further from the median, it is not such a court


class Courts(Ruler):
    """Courts that are whole in the image."""

    kind = "courts"
    label = "sports courts"
    plural = True
    help = "a tennis or basketball court whole in the image"
    colour = "#D55E00"

    def measure(self, view: View) -> Witness | None:
        """Weigh the courts found by how well each was fitted; none without pixels."""
        return witness_of(
            () if view.raster is None else find_courts(view.raster, view.prior, view.runtime)
        )


def witness_of(courts: Sequence[Court]) -> Witness | None:
    """Weigh courts by how well each was fitted.

    Args:
        courts: of one image. Courts that differ from the median scale are left out.

    Returns:
        The witness, with outlines and sides as marks; None without courts.
    """
    courts = [court for court in courts if on_grid(court.gsd_m_per_px)]
    if not courts:
        return None
    middle = float(np.median([math.log(court.gsd_m_per_px) for court in courts]))
    nearest = min(courts, key=lambda court: abs(math.log(court.gsd_m_per_px) - middle))
    kept = [
        court
        for court in courts
        if abs(math.log(court.gsd_m_per_px / nearest.gsd_m_per_px)) <= _APART
    ]
    reliability = RELIABILITY[Courts.kind]
    weights = np.array([1 / (court.log_sd**2 + reliability.log_sd**2) for court in kept])
    logs = np.log([court.gsd_m_per_px for court in kept])
    mean = float(weights @ logs / weights.sum())
    spread = float(np.sqrt(weights @ (logs - mean) ** 2 / weights.sum()))
    log_sd = max(reliability.log_sd, spread, float(weights.sum() ** -0.5))
    return point_witness(
        Courts.kind,
        math.exp(mean),
        log_sd=log_sd,
        chance_wrong=reliability.chance_wrong,
        statement=f"{_named(kept)} {{}}.",
        n=len(kept),
        marks=[mark for court in kept for mark in _marks(court)],
    )


def _marks(court: Court) -> list[Mark]:
    """Mark the outline, and a long and a short side with their lengths."""
    points = [(float(x), float(y)) for x, y in court.corners]
    sides = [(points[:2], court.length_m), (points[1:3], court.width_m)]
    return [
        Mark(tuple(points), closed=True),
        *(Mark(tuple(ends), f"{metres:g} m") for ends, metres in sides),
    ]


_GAMES = {
    "tennis": "tennis court",
    "basketball_fiba": "basketball court by FIBA's rules",
    "basketball_nba": "basketball court by the NBA's rules",
    "basketball_ncaa": "basketball court by the NCAA's rules",
}


def _named(courts: list[Court]) -> str:
    """Name courts as subject and verb of a sentence."""
    kinds = {court.kind for court in courts}
    if len(courts) == 1:
        return f"A {_GAMES[courts[0].kind]} says"
    if len(kinds) == 1:
        first, _, rules = _GAMES[courts[0].kind].partition(" court")
        return f"{len(courts)} {first} courts{rules} say"
    return f"{len(courts)} sports courts say"
