"""Photographs of a flight after their search: results and evidence, without the pixels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from vehanchor.analysis.journal_classes import FORMER_NAMES, STORED_CLASSES
from vehanchor.analysis.pipeline import analyse_view
from vehanchor.detection.detections import Detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.rulers.active import ruler_class
from vehanchor.rulers.ruler import View
from vehanchor.storage.codec import Codec

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from numpy.typing import NDArray

    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.options import ScaleOptions
    from vehanchor.rulers.camera_tilt import CameraTilt
    from vehanchor.scale.posterior import Witness
    from vehanchor_flight.features import Features

    Points: TypeAlias = NDArray[np.float64]
    """Points x, y ``[n, 2]`` in pixels."""

    MeasureDetailShare: TypeAlias = Callable[[Points, float], float]
    """Measures the share of the resolution with detail around points, at a scale."""


@dataclass(frozen=True, eq=False)
class StoredPhotograph:
    """Search result and evidence of one photograph, as the journal keeps them.

    Attributes:
        image: facts of the image.
        detections: result of the search, in pixels of the image.
        detail_share: share of the pixels' resolution at which there is detail around its vehicles.
        others: witnesses of the rulers that measure photographs one by one, in view of the tilt;
            None if they have not measured.
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
        return cls(
            view.image,
            view.detections,
            detail_share=analysis.detail_share,
            others=per_photograph_witnesses(analysis.witnesses),
            prior=view.prior,
            tilt=view.tilt,
        )


def photograph_codec() -> Codec:
    """Make the codec of ``StoredPhotograph`` for journals."""
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
        is_frame: whether it is a frame of a video.
    """

    name: str
    view: View
    analysis: ScaleAnalysis
    features: Features | None = None
    reduced: NDArray[np.uint8] | None = None
    is_frame: bool = False

    @property
    def centre_px(self) -> NDArray[np.float64]:
        """Its centre ``[2]``, x and y."""
        image = self.view.image
        return np.array([image.width_px, image.height_px]) / 2

    @property
    def rectified_detections(self) -> Detections:
        """Its detections, rectified in a tilted view."""
        vehicles = self.analysis.vehicles
        if vehicles is None:
            return self.view.detections
        return vehicles.fleet.detections

    @classmethod
    def of(
        cls,
        name: str,
        stored: StoredPhotograph,
        card: DetectorCard,
        options: ScaleOptions,
        features: Features | None = None,
    ) -> Photograph:
        """Analyse the search result of a photograph."""
        view = View(
            stored.image,
            stored.detections,
            card=card,
            options=options,
            measure_detail_share=constant_detail_share(stored.detail_share),
            prior=stored.prior,
            tilt=stored.tilt,
        )
        analysis = analyse_view(view, stored.others)
        return cls(name, view, analysis=analysis, features=features, reduced=stored.reduced)


def constant_detail_share(share: float) -> MeasureDetailShare:
    """Make a function for ``View.measure_detail_share`` that returns a known share."""

    def detail_share(_centres: Points, _gsd_m_per_px: float) -> float:
        return share

    return detail_share


def reference_member(members: Sequence[Photograph]) -> int:
    """Find the index of the photograph with the most vehicles; the first of equals."""
    n_vehicles = [member.analysis.estimate.n_vehicles or 0 for member in members]
    return int(np.argmax(n_vehicles))


def per_photograph_witnesses(witnesses: Iterable[Witness]) -> tuple[Witness, ...]:
    """Select the witnesses of rulers that measure photographs one by one.

    The other rulers measure the boxes of all photographs together.
    """
    return tuple(
        witness for witness in witnesses if ruler_class(witness.kind).pooling_gain is not None
    )
