"""Sports courts as a ruler: the rules of tennis and basketball fix the size of a court."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.courts.find import find_courts
from vehanchor.rulers.ruler import Ruler, point_witness
from vehanchor.scale.density import on_grid
from vehanchor.scale.posterior import Mark
from vehanchor.scale.reliability import RELIABILITY, court_misfit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.courts.find import Court
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.posterior import Witness

# Log distance from the median scale beyond which a find is not a court.
_MAX_LOG_DISTANCE = 0.06


class Courts(Ruler):
    """Courts that are whole in the image."""

    kind = "courts"
    label = "sports courts"
    plural = True
    help = "a whole tennis or basketball court"
    colour = "#D55E00"
    reads_scene = True

    def measure(self, view: View) -> Witness | None:
        """Find courts, and weigh them by how well each was fitted; None without pixels."""
        if view.raster is None:
            return None
        courts = find_courts(view.raster, view.prior, view.runtime)
        in_image = [
            replace(court, corners=court.corners + view.raster.origin_px) for court in courts
        ]
        return witness_of(in_image)


def witness_of(courts: Sequence[Court]) -> Witness | None:
    """Weigh courts by how well each was fitted.

    Args:
        courts: courts of one image. Courts that differ from the median scale are left out.

    Returns:
        The witness, with outlines and sides as marks; None without courts.
    """
    courts = [court for court in courts if on_grid(court.gsd_m_per_px)]
    if not courts:
        return None
    # Courts of one image have one scale. The reference is the court nearest to the median, because
    # the median of two lies between them.
    log_gsds = [math.log(court.gsd_m_per_px) for court in courts]
    median = float(np.median(log_gsds))
    reference = min(courts, key=lambda court: abs(math.log(court.gsd_m_per_px) - median))
    consistent = []
    for court in courts:
        log_ratio = math.log(court.gsd_m_per_px / reference.gsd_m_per_px)
        if abs(log_ratio) <= _MAX_LOG_DISTANCE:
            consistent.append(court)

    # Mean by the precisions; the error is that of the mean, but no less than the courts' spread and
    # the error of the rules.
    reliability = RELIABILITY[Courts.kind]
    rules_variance = reliability.log_sd**2
    weights = np.array([1 / (court.log_sd**2 + rules_variance) for court in consistent])
    total_weight = weights.sum()
    log_scales = np.log([court.gsd_m_per_px for court in consistent])
    mean = float(weights @ log_scales / total_weight)
    squared_deviations = (log_scales - mean) ** 2
    spread = float(np.sqrt(weights @ squared_deviations / total_weight))
    mean_log_sd = float(total_weight**-0.5)
    return point_witness(
        Courts.kind,
        math.exp(mean),
        log_sd=max(reliability.log_sd, spread, mean_log_sd),
        chance_wrong=reliability.chance_wrong,
        statement=f"{_subject_and_verb(consistent)} {{}}.",
        shared=[court_misfit(max(court.quality for court in consistent))],
        n=len(consistent),
        marks=[mark for court in consistent for mark in _marks(court)],
    )


def _marks(court: Court) -> list[Mark]:
    """Mark the outline, and a long and a short side with their lengths."""
    corners = [(float(x), float(y)) for x, y in court.corners]
    return [
        Mark(tuple(corners), closed=True),
        Mark(tuple(corners[:2]), f"{court.length_m:g} m"),
        Mark(tuple(corners[1:3]), f"{court.width_m:g} m"),
    ]


_GAMES = {
    "tennis": "tennis court",
    "basketball_fiba": "basketball court by FIBA's rules",
    "basketball_nba": "basketball court by the NBA's rules",
    "basketball_ncaa": "basketball court by the NCAA's rules",
}


def _subject_and_verb(courts: list[Court]) -> str:
    """Begin a sentence about courts, such as "2 tennis courts give"."""
    kinds = {court.kind for court in courts}
    if len(courts) == 1:
        return f"A {_GAMES[courts[0].kind]} gives"
    if len(kinds) == 1:
        description = _GAMES[courts[0].kind]
        game, _, rules = description.partition(" court")
        return f"{len(courts)} {game} courts{rules} give"
    return f"{len(courts)} sports courts give"
