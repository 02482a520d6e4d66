"""Sports courts as a ruler: tennis and basketball courts are as long and wide as their rules say."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.anchors.stated import StatedEvidence, on_grid, says_nothing, stated

if TYPE_CHECKING:
    from vehanchor.anchors.evidence import View
    from vehanchor.courts.court import Court

__all__ = ["CourtEvidence", "Courts"]

_RULES_LOG_SD = 0.006  # lines 2.5 to 10 cm wide, courts laid out to a tape: half a per cent on 180 real courts
_UNKNOWN_RULES_LOG_SD = 0.012  # of a basketball court: FIBA's 28 m and the NBA's 28.65 m are told apart by little
_CHANCE_WRONG = 0.02
_APART = 0.06  # of the log of the scale: a court further than that from the median is something else


@dataclass(frozen=True, eq=False)
class CourtEvidence(StatedEvidence):
    """Courts and what they say.

    Attributes:
        courts: those that the scale was taken from, the surest first: their outlines are what there is to draw.
    """

    courts: tuple[Court, ...] = ()


class Courts:
    """Courts that lie whole in the image."""

    kind = "courts"

    def look(self, view: View) -> StatedEvidence:
        """Weigh the courts by how well each was fitted; those that say something else than most are left out."""
        courts = [court for court in view.sighting.courts if on_grid(court.gsd_m_per_px)]
        if not courts:
            return says_nothing(self.kind)
        middle = float(np.median([math.log(court.gsd_m_per_px) for court in courts]))
        nearest = min(courts, key=lambda court: abs(math.log(court.gsd_m_per_px) - middle))
        kept = [court for court in courts if abs(math.log(court.gsd_m_per_px / nearest.gsd_m_per_px)) <= _APART]
        weights = np.array([1 / _log_sd(court) ** 2 for court in kept])
        logs = np.log([court.gsd_m_per_px for court in kept])
        mean = float(weights @ logs / weights.sum())
        spread = float(np.sqrt(weights @ (logs - mean) ** 2 / weights.sum()))
        log_sd = max(min(_rules_log_sd(court) for court in kept), spread, float(weights.sum() ** -0.5))
        names = _named(kept)
        evidence = stated(self.kind, math.exp(mean), log_sd, _CHANCE_WRONG, f"{names} {{}}.", n=len(kept))
        return CourtEvidence(**vars(evidence), courts=tuple(kept))


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
