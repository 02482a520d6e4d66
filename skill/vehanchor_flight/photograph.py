"""Results kept of each photograph of a flight; its pixels are not kept."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.analysis.journal_classes import FORMER_NAMES, STORED_CLASSES
from vehanchor.analysis.pipeline import analyse_view
from vehanchor.detection.detections import Detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.rulers.active import ruler_class
from vehanchor.rulers.ruler import View
from vehanchor.storage.codec import Codec

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.options import ScaleOptions
    from vehanchor.rulers.camera_tilt import CameraTilt
    from vehanchor.scale.posterior import Witness
    from vehanchor_flight.features import Features


@dataclass(frozen=True, eq=False)
class StoredPhotograph:
    """Search result and evidence of one photograph, as the journal keeps them.

    Attributes:
        image: facts of the image.
        detections: result of the search, in pixels of the image.
        detail_share: share of the pixels' resolution at which there is detail around its vehicles.
        others: witnesses of the rulers that measure each photograph, with the tilt; None if they
            have not measured.
        prior: the scene-scale prior; None without one.
        tilt: of the camera; None at nadir.
        reduced: the image in a few grey levels, ``[32, 32]``; None if it was not kept.
    """

    image: ImageFacts
    detections: Detections
    detail_share: float
    others: tuple[Witness, ...] | None = None
    prior: SceneScalePrior | None = None
    tilt: CameraTilt | None = None
    reduced: NDArray[np.uint8] | None = None

    @classmethod
    def of(cls, view: View, analysis: ScaleAnalysis) -> StoredPhotograph:
        """Take the intermediate results of an analysis."""
        others = of_photographs(analysis.witnesses)
        return cls(
            view.image, view.detections, analysis.detail_share, others, view.prior, view.tilt
        )


def photograph_codec() -> Codec:
    """Codec of ``StoredPhotograph`` for journals."""
    return Codec((*STORED_CLASSES, StoredPhotograph), FORMER_NAMES)


@dataclass(frozen=True, eq=False)
class Photograph:
    """Photograph with its own analysis.

    Attributes:
        name: as the caller named it.
        view: input of the rulers, without pixels.
        analysis: result of the rulers.
        features: for overlaps with other photographs; None if they are not needed.
        reduced: as in ``StoredPhotograph``.
    """

    name: str
    view: View
    analysis: ScaleAnalysis
    features: Features | None = None
    reduced: NDArray[np.uint8] | None = None

    @property
    def measured(self) -> Detections:
        """Its detections, rectified in a tilted view."""
        vehicles = self.analysis.vehicles
        return self.view.detections if vehicles is None else vehicles.fleet.detections

    @classmethod
    def of(
        cls,
        name: str,
        kept: StoredPhotograph,
        card: DetectorCard,
        options: ScaleOptions,
        features: Features | None = None,
    ) -> Photograph:
        """Analyse the search result of a photograph."""
        view = View(
            kept.image,
            kept.detections,
            card=card,
            options=options,
            measure_detail_share=lambda _centres, _scale: kept.detail_share,
            prior=kept.prior,
            tilt=kept.tilt,
        )
        return cls(name, view, analyse_view(view, kept.others), features, kept.reduced)


def chief_member(members: Sequence[Photograph]) -> int:
    """Find the index of the photograph with the most vehicles; the first of equals."""
    return int(np.argmax([member.analysis.estimate.n_vehicles or 0 for member in members]))


def of_photographs(witnesses: Iterable[Witness]) -> tuple[Witness, ...]:
    """Select the witnesses of rulers that measure each photograph, not the boxes of all together."""
    return tuple(each for each in witnesses if ruler_class(each.kind).pooling_gain is not None)
