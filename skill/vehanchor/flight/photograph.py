"""One photograph of a flight: what is kept of it when its pixels are gone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.detection.detections import Detections
from vehanchor.estimate import analyse_detections
from vehanchor.rulers.evidence import ImageFacts, View
from vehanchor.storage.stored import stored

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.analysis.scale import ScaleAnalysis
    from vehanchor.detection.card import DetectorCard
    from vehanchor.flight.features import Features
    from vehanchor.options import ScaleOptions
    from vehanchor.rulers.evidence import Evidence


@stored("photograph_findings")
@dataclass(frozen=True, eq=False)
class Look:
    """The findings in one photograph, as a journal keeps them.

    Attributes:
        image: facts of the file.
        detections: what was found in it.
        resolved: share of the pixels' resolution at which there is detail around its vehicles.
        others: evidence of the rulers beside vehicles, some of which look at pixels.
    """

    image: ImageFacts
    detections: Detections
    resolved: float
    others: tuple[Evidence, ...] | None = None

    @classmethod
    def of(cls, image: ImageFacts, detections: Detections, analysis: ScaleAnalysis) -> Look:
        """The findings that an analysis was made from."""
        return cls(image, detections, analysis.resolved, analysis.others)


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph with what it says by itself.

    Attributes:
        name: as the caller named it.
        view: all that rulers were shown, without its pixels.
        analysis: what they said.
        features: by which it finds those that overlap; None where nobody asked.
    """

    name: str
    view: View
    analysis: ScaleAnalysis
    features: Features | None = None

    @property
    def measured(self) -> Detections:
        """What was found, levelled where the camera looked aside."""
        return self.view.detections if self.analysis.in_image is None else self.analysis.vehicles.fleet.detections

    @classmethod
    def of(
        cls, name: str, look: Look, card: DetectorCard, options: ScaleOptions, features: Features | None = None
    ) -> Photograph:
        """Lead the findings through the second half of the skill."""
        view = fixed_view(look.image, look.detections, card, options, look.resolved)
        return cls(name, view, analyse_detections(view, look.others), features)


def fixed_view(
    image: ImageFacts, detections: Detections, card: DetectorCard, options: ScaleOptions, resolved: float
) -> View:
    """A view of which the detail is known already, so that no pixel is needed."""
    return View(image, detections, card, options, lambda _centres, _scale: resolved)


def chief_member(members: Sequence[Photograph]) -> int:
    """Index of the photograph with the most vehicles, the first of equals: what is measured in its pixels is sharp."""
    return int(np.argmax([member.analysis.estimate.n_vehicles for member in members]))
