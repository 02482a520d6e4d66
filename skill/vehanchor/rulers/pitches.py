"""Football pitches as a ruler: the Laws of the Game fix the penalty area."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.rulers.evidence import Mark
from vehanchor.rulers.lognormal import lognormal_evidence, no_evidence, on_grid
from vehanchor.rulers.penalty_areas import DEPTH_M, WIDTH_M, find_penalty_areas
from vehanchor.rulers.prior_range import prior_range
from vehanchor.rulers.ruler import Ruler
from vehanchor.scale.lengths import Interval

if TYPE_CHECKING:
    from vehanchor.rulers.evidence import View
    from vehanchor.rulers.lognormal import LognormalEvidence
    from vehanchor.rulers.penalty_areas import PenaltyArea

_RESOLVED = Interval(0.02, 0.2)  # metres per pixel: in coarser images, a children's pitch looks like a full one
_PRIOR_SHARE, _FARTHEST = 0.98, 2.2  # grass looks alike at many scales
_LAYOUT_LOG_SD = 0.02  # pitches are laid out by tape, on ground that drains to its sides; not measured
_CHANCE_WRONG = 0.1  # our assumption: no false area in photographs, but no photograph had a true one
_APART = 0.03  # of the log of the scale: farther from the best-fitted area, it is none


class Pitches(Ruler):
    """Penalty areas that are whole in the image."""

    kind = "pitches"
    label = "football pitches"
    plural = True
    help = "a full-size penalty area of a football pitch whole in the image, up to 0.2 m/px"
    colour = "#009E73"
    independent_of_vehicles = True

    def find(self, view: View) -> tuple[PenaltyArea, ...]:
        """Find penalty areas at the scales that the scene-scale prior allows; none without pixels or prior.

        After a search that ended early, only the searched part of the image is examined.
        """
        scale = prior_range(view, _RESOLVED, _PRIOR_SHARE, _FARTHEST)
        if view.raster is None or scale is None:
            return ()
        return tuple(find_penalty_areas(view.raster, scale, view.detections.covers))

    def measure(self, view: View) -> LognormalEvidence:
        """Average the scales of the areas that agree with the one whose lines are seen best."""
        areas: tuple[PenaltyArea, ...] = view.found[self.kind] if self.kind in view.found else self.find(view)
        if not areas:
            return no_evidence(self.kind)
        best = max(areas, key=lambda area: area.coverage)
        kept = [area for area in areas if abs(math.log(area.gsd_m_per_px / best.gsd_m_per_px)) <= _APART]
        gsd = math.exp(float(np.mean([math.log(area.gsd_m_per_px) for area in kept])))
        if not on_grid(gsd):
            return no_evidence(self.kind)
        log_sd = math.hypot(_LAYOUT_LOG_SD, min(area.log_sd for area in kept))
        says = "A penalty area says" if len(kept) == 1 else f"{len(kept)} penalty areas say"
        return lognormal_evidence(
            self.kind,
            gsd,
            log_sd,
            _CHANCE_WRONG,
            f"{says} {{}}.",
            n=len(kept),
            marks=[mark for area in kept for mark in _marks(area)],
        )


def _marks(area: PenaltyArea) -> list[Mark]:
    """Mark the outline, and the front and a side with their lengths."""
    points = [(float(x), float(y)) for x, y in area.corners]
    sides = [(points[:2], WIDTH_M), (points[1:3], DEPTH_M)]
    return [Mark(tuple(points), closed=True), *(Mark(tuple(ends), f"{metres:g} m") for ends, metres in sides)]
