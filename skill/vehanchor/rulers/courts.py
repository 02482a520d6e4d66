"""Sports courts as a ruler: the rules of tennis and basketball fix the size of a court."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.courts.find import find_courts, propose_courts
from vehanchor.courts.rectified import find_courts_on, rough_courts_on
from vehanchor.errors import TooObliqueError
from vehanchor.rulers.court_cue import court_cues
from vehanchor.rulers.point import no_evidence, point_witness
from vehanchor.rulers.ruler import Ruler
from vehanchor.scale.density import on_grid
from vehanchor.scale.plane import GroundPlane
from vehanchor.scale.posterior import Mark
from vehanchor.scale.reliability import RELIABILITY
from vehanchor.tilt.estimate import may_be_tilted
from vehanchor.tilt.focal import focal_of
from vehanchor.tilt.posterior import tilt_posterior

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.courts.court import Court
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.imagery.raster import Raster
    from vehanchor.rulers.court_cue import CourtCue
    from vehanchor.rulers.view import View
    from vehanchor.scale.posterior import Witness

_UNKNOWN_RULES_LOG_SD = 0.012  # of a basketball court: FIBA's 28 m and the NBA's 28.65 m are hard to distinguish
_LIKELY_COURT = 0.6  # lowest share of a proposal that is also tried in tilted views
_TRIED_DEG = (12.0, 28.0, 42.0)  # the fit of a court converges from ten degrees off
_LEAST_TILT_DEG = 4.0  # of a tried view: the image was searched at nadir before
_MOST_TRIED = 3  # proposals
_APART = 0.06  # of the log of the scale: further from the median, it is not such a court


class Courts(Ruler):
    """Courts that are whole in the image."""

    kind = "courts"
    label = "sports courts"
    plural = True
    help = "a tennis or basketball court whole in the image"
    colour = "#D55E00"
    uses_plane = True
    independent_of_vehicles = True

    def find(self, view: View) -> tuple[Court, ...]:
        """Find courts by their lines; none without pixels."""
        if view.raster is None:
            return ()
        if view.plane is not None:
            return self._found_on(view, view.raster, view.plane)
        proposed = propose_courts(view.raster, view.detections, view.card, view.prior, runtime=view.runtime)
        found = find_courts(view.raster, view.detections, view.card, proposed=proposed)
        likely = any(each.share >= _LIKELY_COURT for each in proposed.proposals)
        if not found and likely and may_be_tilted(view.image, view.options, view.detections):
            found = self._found_tilted(view, view.raster)
        return found

    def moved(self, found: tuple[Court, ...], places: Callable[[ArrayLike], NDArray[np.float64]]) -> tuple[Court, ...]:
        """Move the corners of courts."""
        return tuple(
            replace(each, corners=places(each.corners), shape=None if each.shape is None else places(each.shape))
            for each in found
        )

    def tilt_cues(self, found: tuple[Court, ...], image: ImageFacts) -> list[CourtCue]:
        """Make tilt cues of courts in perspective."""
        return court_cues(found, image.width_px, image.height_px)

    def measure(self, view: View) -> Witness:
        """Weigh the courts found by how well each was fitted."""
        plane, courts = view.plane, view.found[self.kind] if self.kind in view.found else self.find(view)
        return witness_of(courts if plane is None else [_rectified(court, plane) for court in courts])

    def _found_tilted(self, view: View, raster: Raster) -> tuple[Court, ...]:
        """Find courts that can be recognised only in perspective; the tilt is unknown."""
        focal, size = focal_of(view.image, view.options), (view.image.width_px, view.image.height_px)
        for tilt_deg in _TRIED_DEG:
            try:
                rough = rough_courts_on(
                    raster,
                    GroundPlane(1.0, tilt_deg, focal.pixels, *size),
                    view.detections,
                    view.card,
                    most=_MOST_TRIED,
                    runtime=view.runtime,
                )
                posteriors = [tilt_posterior([cue], focal) for cue in court_cues(rough, *size)]
                for posterior in (each for each in posteriors if each is not None):
                    if posterior.tilt_deg < _LEAST_TILT_DEG:
                        continue
                    plane = GroundPlane(1.0, posterior.tilt_deg, posterior.focal_px, *size, posterior.roll_deg)
                    if found := self._found_on(view, raster, plane):
                        return found
            except TooObliqueError:
                continue
        return ()

    @staticmethod
    def _found_on(view: View, raster: Raster, plane: GroundPlane) -> tuple[Court, ...]:
        return find_courts_on(raster, plane, view.detections, view.card, runtime=view.runtime)


def witness_of(courts: Sequence[Court]) -> Witness:
    """Weigh courts by how well each was fitted.

    Args:
        courts: of one image. Courts that differ from the median scale are left out.

    Returns:
        The witness, with outlines and sides as marks.
    """
    courts = [court for court in courts if on_grid(court.gsd_m_per_px)]
    if not courts:
        return no_evidence(Courts.kind)
    middle = float(np.median([math.log(court.gsd_m_per_px) for court in courts]))
    nearest = min(courts, key=lambda court: abs(math.log(court.gsd_m_per_px) - middle))
    kept = [court for court in courts if abs(math.log(court.gsd_m_per_px / nearest.gsd_m_per_px)) <= _APART]
    weights = np.array([1 / _log_sd(court) ** 2 for court in kept])
    logs = np.log([court.gsd_m_per_px for court in kept])
    mean = float(weights @ logs / weights.sum())
    spread = float(np.sqrt(weights @ (logs - mean) ** 2 / weights.sum()))
    log_sd = max(min(_rules_log_sd(court) for court in kept), spread, float(weights.sum() ** -0.5))
    return point_witness(
        Courts.kind,
        math.exp(mean),
        log_sd,
        RELIABILITY[Courts.kind].chance_wrong,
        f"{_named(kept)} {{}}.",
        n=len(kept),
        marks=[mark for court in kept for mark in _marks(court)],
    )


def _rectified(court: Court, plane: GroundPlane) -> Court:
    """Convert a court to the scale of the image's centre."""
    x, y = plane.from_above(court.corners if court.shape is None else court.shape).T
    area_px = abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2
    return replace(court, gsd_m_per_px=math.sqrt(court.length_m * court.width_m / area_px))


def _marks(court: Court) -> list[Mark]:
    """Mark the outline, and a long and a short side with their lengths."""
    points = [(float(x), float(y)) for x, y in court.corners]
    sides = [(points[:2], court.length_m), (points[1:3], court.width_m)]
    return [
        Mark(tuple(points), closed=True),
        *(Mark(tuple(ends), f"{metres:g} m") for ends, metres in sides),
    ]


def _rules_log_sd(court: Court) -> float:
    return RELIABILITY[Courts.kind].log_sd if court.kind == "tennis" else _UNKNOWN_RULES_LOG_SD


def _log_sd(court: Court) -> float:
    return math.hypot(court.log_sd, _rules_log_sd(court))


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
