"""Sports courts as a ruler: tennis and basketball courts are as long and wide as their rules say."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.courts.find import find_courts, propose_courts
from vehanchor.courts.rectified import find_courts_on, rough_courts_on
from vehanchor.errors import TooObliqueError
from vehanchor.rulers.evidence import Mark
from vehanchor.rulers.lognormal import LognormalEvidence, lognormal_evidence, no_evidence, on_grid
from vehanchor.scale.plane import GroundPlane
from vehanchor.storage.stored import stored
from vehanchor.tilt.camera_tilt import metadata_tilt, plane_with
from vehanchor.tilt.court_cue import court_cues
from vehanchor.tilt.posterior import tilt_posterior
from vehanchor.tilt.vehicle_cue import focal_of, may_be_tilted

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.courts.court import Court
    from vehanchor.imagery.raster import Raster
    from vehanchor.rulers.evidence import View

_RULES_LOG_SD = 0.006  # lines 2.5 to 10 cm wide, courts laid out to a tape: half a per cent on the tennis tiles
_UNKNOWN_RULES_LOG_SD = 0.012  # of a basketball court: FIBA's 28 m and the NBA's 28.65 m are told apart by little
_CHANCE_WRONG = 0.02
_SURE_OF_A_COURT = 0.6  # share of a proposal from which views from aside are tried, too
_TRIED_DEG = (12.0, 28.0, 42.0)  # a court's shape is found from ten degrees off
_LEAST_TILT_DEG = 4.0  # of a guess that is followed: as if from straight down the image was searched already
_MOST_TRIED = 3  # proposals
_APART = 0.06  # of the log of the scale: a court further than that from the median is something else


@stored("courts_evidence")
@dataclass(frozen=True, eq=False)
class CourtsEvidence(LognormalEvidence):
    """What courts say, with those that say it.

    Attributes:
        courts: as they are in the image.
    """

    courts: tuple[Court, ...] = ()

    def on(self, plane: GroundPlane) -> CourtsEvidence:
        """The scale of the image's centre, where the camera looked aside.

        Args:
            plane: the ground; its scale does not matter.
        """
        return evidence_of([_levelled(court, plane) for court in self.courts], seen=self.courts)


class Courts:
    """Courts that lie whole in the image."""

    kind = "courts"

    def look(self, view: View) -> LognormalEvidence:
        """Find courts by their lines; nothing where nobody kept the image."""
        if view.raster is None:
            return evidence_of(())
        raster, looked = view.raster, metadata_tilt(view.image, view.options)
        if looked is not None:
            plane = plane_with(looked, view.image, 1.0)
            return evidence_of(find_courts_on(raster, plane, view.detections, view.card, runtime=view.runtime))
        proposed = propose_courts(raster, view.detections, view.card, view.runtime)
        found = find_courts(raster, view.detections, view.card, proposed=proposed)
        sure = any(each.share >= _SURE_OF_A_COURT for each in proposed.proposals)
        if not found and sure and may_be_tilted(view):
            found = self._aside(view, raster)
        return evidence_of(found)

    def _aside(self, view: View, raster: Raster) -> tuple[Court, ...]:
        """Courts that are some only as a camera sees them that looked aside, nobody knows how far."""
        focal, size = focal_of(view.image, view.options), (view.image.width_px, view.image.height_px)
        for tilt_deg in _TRIED_DEG:
            try:
                tried = GroundPlane(1.0, tilt_deg, focal.pixels, *size)
                rough = rough_courts_on(
                    raster,
                    tried,
                    view.detections,
                    view.card,
                    most=_MOST_TRIED,
                    runtime=view.runtime,
                )
                leans = [tilt_posterior([cue], focal) for cue in court_cues(rough, *size)]
                followed = (each for each in leans if each is not None and each.tilt_deg >= _LEAST_TILT_DEG)
                for posterior in followed:  # from there it has to be borne out
                    plane = GroundPlane(1.0, posterior.tilt_deg, posterior.focal_px, *size, posterior.roll_deg)
                    found = find_courts_on(raster, plane, view.detections, view.card, runtime=view.runtime)
                    if found:
                        return found
            except TooObliqueError:
                continue
        return ()


def evidence_of(courts: Sequence[Court], *, seen: Sequence[Court] | None = None) -> CourtsEvidence:
    """Weigh courts by how well each was fitted.

    Args:
        courts: of one image. Those that say something else than most are left out.
        seen: the same as they are in the image, where these were levelled.

    Returns:
        The evidence, with the outlines and what their sides measure as marks; of none, that nothing was found.
    """
    as_seen = tuple(courts if seen is None else seen)
    courts = [court for court in courts if on_grid(court.gsd_m_per_px)]
    if not courts:
        return _with(no_evidence(Courts.kind), as_seen)
    middle = float(np.median([math.log(court.gsd_m_per_px) for court in courts]))
    nearest = min(courts, key=lambda court: abs(math.log(court.gsd_m_per_px) - middle))
    kept = [court for court in courts if abs(math.log(court.gsd_m_per_px / nearest.gsd_m_per_px)) <= _APART]
    weights = np.array([1 / _log_sd(court) ** 2 for court in kept])
    logs = np.log([court.gsd_m_per_px for court in kept])
    mean = float(weights @ logs / weights.sum())
    spread = float(np.sqrt(weights @ (logs - mean) ** 2 / weights.sum()))
    log_sd = max(min(_rules_log_sd(court) for court in kept), spread, float(weights.sum() ** -0.5))
    said = lognormal_evidence(
        Courts.kind,
        math.exp(mean),
        log_sd,
        _CHANCE_WRONG,
        f"{_named(kept)} {{}}.",
        n=len(kept),
        marks=[mark for court in kept for mark in _marks(court)],
    )
    return _with(said, as_seen)


def _with(said: LognormalEvidence, courts: tuple[Court, ...]) -> CourtsEvidence:
    return CourtsEvidence(**{each.name: getattr(said, each.name) for each in fields(said)}, courts=courts)


def _levelled(court: Court, plane: GroundPlane) -> Court:
    """The court with the scale that the image's centre has, if the court is as large as its rules say."""
    x, y = plane.from_above(court.corners if court.shape is None else court.shape).T
    area_px = abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2
    return replace(court, gsd_m_per_px=math.sqrt(court.length_m * court.width_m / area_px))


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
