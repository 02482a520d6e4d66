"""Memory of analyses, so that an area after an estimate of the same image costs no second search.

An analysis is a pure function of an image and its facts, the detector and options: the memory
changes the time, never the result. Two files can have equal pixels and other metadata.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

from vehanchor.analysis.pipeline import analyse_raster
from vehanchor.imagery.facts import image_facts

if TYPE_CHECKING:
    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.detection.detector import Detector
    from vehanchor.imagery.raster import Raster
    from vehanchor.options import ScaleOptions

# Largest number of analyses in memory; 10,000 vehicles take 1 MB. A choice.
_MAX_ANALYSES = 8


class AnalysisMemory:
    """The last analyses, by image with its facts, detector and options."""

    def __init__(self) -> None:
        # The cache holds a list by key, empty until the analysis is made.
        self._slots = lru_cache(_MAX_ANALYSES)(_empty_slot)

    def analyse(self, detector: Detector, raster: Raster, options: ScaleOptions) -> ScaleAnalysis:
        """Return the analysis of an open image; see ``vehanchor.analysis.pipeline.analyse_raster``.

        A search with a time limit is not remembered, because its result depends on the machine.
        """
        if options.search.max_seconds is not None:
            return analyse_raster(detector, raster, options)
        facts = repr(image_facts(raster))
        slot = self._slots(facts, detector.card.sha256, repr(options))
        if not slot:
            slot.append(analyse_raster(detector, raster, options))
        return slot[0]


def _empty_slot(*_key: str) -> list[ScaleAnalysis]:
    """Make an empty list for the analysis of an image, a detector and options."""
    return []
