"""Sports courts as a ruler: tennis and basketball courts are as long and wide as their rules say."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.anchors.evidence import Mark
from vehanchor.anchors.stated import on_grid, says_nothing, stated
from vehanchor.courts.find import find_courts

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.anchors.evidence import View
    from vehanchor.anchors.stated import StatedEvidence
    from vehanchor.courts.court import Court

__all__ = ["Courts", "evidence_of"]

_RULES_LOG_SD = 0.006  # lines 2.5 to 10 cm wide, courts laid out to a tape: half a per cent on the tennis tiles
_UNKNOWN_RULES_LOG_SD = 0.012  # of a basketball court: FIBA's 28 m and the NBA's 28.65 m are told apart by little
_CHANCE_WRONG = 0.02
_APART = 0.06  # of the log of the scale: a court further than that from the median is something else


class Courts:
    """Courts that lie whole in the image."""

    kind = "courts"

    def look(self, view: View) -> StatedEvidence:
        """Find courts by their lines; nothing where nobody kept the image."""
        return evidence_of(() if view.raster is None else find_courts(view.raster, view.sighting, view.card))


def evidence_of(courts: Sequence[Court]) -> StatedEvidence:
    """Weigh courts by how well each was fitted.

    Args:
        courts: of one image. Those that say something else than most are left out.

    Returns:
        The evidence, with the outlines and what their sides measure as marks; of none, that nothing was found.
    """
    courts = [court for court in courts if on_grid(court.gsd_m_per_px)]
    if not courts:
        return says_nothing(Courts.kind)
    middle = float(np.median([math.log(court.gsd_m_per_px) for court in courts]))
    nearest = min(courts, key=lambda court: abs(math.log(court.gsd_m_per_px) - middle))
    kept = [court for court in courts if abs(math.log(court.gsd_m_per_px / nearest.gsd_m_per_px)) <= _APART]
    weights = np.array([1 / _log_sd(court) ** 2 for court in kept])
    logs = np.log([court.gsd_m_per_px for court in kept])
    mean = float(weights @ logs / weights.sum())
    spread = float(np.sqrt(weights @ (logs - mean) ** 2 / weights.sum()))
    log_sd = max(min(_rules_log_sd(court) for court in kept), spread, float(weights.sum() ** -0.5))
    return stated(
        Courts.kind,
        math.exp(mean),
        log_sd,
        _CHANCE_WRONG,
        f"{_named(kept)} {{}}.",
        n=len(kept),
        marks=[mark for court in kept for mark in _marks(court)],
    )


def _marks(court: Court) -> list[Mark]:
    """The outline, and the metres of a long and of a short side beside them."""
    points = [(float(x), float(y)) for x, y in court.corners]
    sides = [(points[:2], court.length_m), (points[1:3], court.width_m)]
    return [
        Mark(tuple(points), closed=True),
        *(Mark(tuple(ends), f"{metres:g} m") for ends, metres in sides),
    ]


def _rules_log_sd(court: Court) -> float:
    return _RULES_LOG_SD if court.kind == "tennis" else _UNKNOWN_RULES_LOG_SD


def _log_sd(court: Court) -> float:
    return math.hypot(court.log_sd, _rules_log_sd(court))


_GAMES = {
    "tennis": "tennis court",
    "basketball_fiba": "basketball court by FIBA's rules",
    "basketball_nba": "basketball court by the NBA's rules",
    "basketball_ncaa": "basketball court by the NCAA's rules",
}


def _named(courts: list[Court]) -> str:
    """What they are, and the verb, as the beginning of a sentence."""
    kinds = {court.kind for court in courts}
    if len(courts) == 1:
        return f"A {_GAMES[courts[0].kind]} says"
    if len(kinds) == 1:
        first, _, rules = _GAMES[courts[0].kind].partition(" court")
        return f"{len(courts)} {first} courts{rules} say"
    return f"{len(courts)} sports courts say"
