"""Vehicles as a ruler: fleet among the detections, modal length, scale and confidence."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.detection.detections import NOT_SEARCHED
from vehanchor.records import Notice
from vehanchor.records.notices import FLEET_DOUBTS, NoticeCode
from vehanchor.rulers.confidence import composite, confidence_terms, fleet_doubts, largest_confidence
from vehanchor.rulers.evidence import Evidence
from vehanchor.rulers.lognormal import lognormal, on_grid
from vehanchor.rulers.reference import reference_length
from vehanchor.rulers.ruler import Ruler
from vehanchor.scale.defaults import CAR_LENGTH_M
from vehanchor.scale.fusion import GRID, credible_interval, flat, vehicle_density, with_outlier_floor
from vehanchor.scale.lengths import Z95, dominant_group, gsd_interval, guard_length, inlier_mask, modal_length
from vehanchor.tilt.rectified import rectified

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.detection.appearance import FleetAppearance
    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detections import Detections
    from vehanchor.options import Lengths, ScaleOptions
    from vehanchor.records import ConfidenceTerms
    from vehanchor.rulers.evidence import View
    from vehanchor.rulers.reference import ReferenceLength
    from vehanchor.scale.defaults import Aggregation
    from vehanchor.scale.lengths import Interval

_LEAST_SCORE = 1e-3  # floor of the scores, so that a detection counts
_MODE_REACH, _MODE_SHARE = 0.25, 0.3  # of log scale, and of the density
_DOUBTS_OF_KIND = frozenset(
    {
        NoticeCode.LENGTHS_ALIKE,
        NoticeCode.SCORES_UNCLEAR,
        NoticeCode.LOOKS_ALIKE,
        NoticeCode.LOOKS_UNLIKE_CARS,
    }
)
"""Doubts that a caller resolves who states that most of the vehicles are cars."""

_DOUBTS: dict[NoticeCode, str] = {
    NoticeCode.STRETCHED: "The vehicles have a car's proportions only if the image is made narrower or wider: it was "
    "stretched in one direction, or taken at a tilt, and its width and height have different scales.",
    NoticeCode.LENGTHS_DISAGREE: "Vehicles of two sizes were found, with nearly equal evidence. One group is not cars: "
    "the scale may be wrong by the ratio of the sizes.",
    NoticeCode.LENGTHS_ALIKE: "The vehicles have nearly equal lengths, unlike cars: they may be equal lorries, "
    "containers or roof units, and the scale wrong by the ratio of their length to a car's.",
    NoticeCode.SCORES_UNCLEAR: "None of the vehicles is clearly a car: they may be objects of similar shape at another "
    "scale.",
    NoticeCode.LOOKS_ALIKE: "The vehicles look more alike than cars of different makes and colours: they may be equal "
    "caravans, lorries or containers, and the scale wrong by the ratio of their length to a car's.",
    NoticeCode.LOOKS_UNLIKE_CARS: "The vehicles look unlike all known fleets of cars: they may be boats or other "
    "objects of a car's shape, and the scale wrong by the ratio of their length to a car's.",
}


@dataclass(frozen=True, eq=False)
class Fleet:
    """Vehicles behind the scale.

    Attributes:
        detections: all detections.
        kept: ``[n]`` bool, the detections of the fleet.
        rival_share: evidence of the strongest group of other lengths over the fleet's; 0 without any.
        working_scale: scale of the image copy with most of the fleet, by score; None without vehicles.
    """

    detections: Detections
    kept: NDArray[np.bool_]
    rival_share: float
    working_scale: float | None

    @property
    def is_stated(self) -> bool:
        """Whether the caller states that most of these vehicles are cars."""
        return bool(2 * self.detections.stated.sum() > self.kept.sum())

    @property
    def centres(self) -> NDArray[np.float64]:
        """``[m, 2]`` centres x, y in pixels of the image."""
        return np.asarray(self.detections.boxes[self.kept, :2])

    @property
    def lengths(self) -> NDArray[np.float64]:
        """``[m]`` lengths in pixels of the image."""
        return np.asarray(self.detections.boxes[self.kept, 2])

    @property
    def scores(self) -> NDArray[np.float64]:
        """``[m]`` detection scores."""
        return np.asarray(self.detections.scores[self.kept])

    @property
    def appearance(self) -> FleetAppearance | None:
        """Appearance of the embedded vehicles; None without any."""
        fleet = self.detections.fleet
        if fleet is None or not self.kept[: len(fleet.log_odds)].any():
            return None
        return fleet.take(self.kept[: len(fleet.log_odds)])


def select(detections: Detections, lengths: Lengths, expected: NDArray[np.float64] | None = None) -> Fleet:
    """Select the fleet with the outlier filter and, after a search over scales, by lengths that fit one fleet.

    Vehicles that the caller states to be cars are always kept, and their lengths choose the fleet.

    Args:
        detections: vehicles in pixels of the image.
        lengths: options with the filter's factor.
        expected: ``[g]`` density of the scale to identify cars; None without any.

    Returns:
        The fleet, empty if nothing was found.
    """
    found, stated = detections.boxes[:, 2], detections.stated
    if detections.scales is None or len(found) == 0:
        kept, rival_share = inlier_mask(found, lengths.alpha), 0.0
    else:
        weights = _expected_weights(found, expected)
        weights = np.where(stated, 1.0, weights) * np.maximum(detections.scores, _LEAST_SCORE) ** 2
        group = dominant_group(found, weights, stated)
        kept, rival_share = group.members.copy(), group.rival_share
        kept[kept] = inlier_mask(found[kept], lengths.alpha)
    kept |= stated
    return Fleet(detections, kept, rival_share, _working_scale(detections, kept))


def _expected_weights(lengths_px: NDArray[np.float64], density: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Weigh each box by its likelihood to be as long as a car, given a density of the scale; 1 without one."""
    if density is None:
        return np.ones(len(lengths_px))
    return np.asarray(np.interp(np.log(CAR_LENGTH_M / lengths_px), GRID, density / density.max()))


def _working_scale(detections: Detections, kept: NDArray[np.bool_]) -> float | None:
    """Find the scale with most of the kept vehicles, by score; the finer of equals."""
    if not kept.any():
        return None
    if detections.scales is None:
        return 1.0
    scales, which = np.unique(-detections.scales[kept], return_inverse=True)
    return float(-scales[np.argmax(np.bincount(which, weights=detections.scores[kept]))])


@dataclass(frozen=True, eq=False, kw_only=True)
class VehicleEvidence(Evidence):
    """Evidence of vehicles, the paper's skill, with its intermediate results.

    Attributes:
        fleet: the vehicles.
        reference: ``L_ref`` and its source.
        mode_length_px: ``P_mode``; None without vehicles.
        aggregation: statistic of the lengths.
        terms: of the confidence.
        guard_length_px: ``P_thresh`` of the resolution guard.
        guarded: whether the guard caps the confidence.
        resolved: share of the pixels' resolution at which there is detail.
        sharpness: of the detector's votes, see ``vehanchor.scale.fusion.recalibrated``.
        exact: whether the confidence is the paper's, for any interval: in the preset ``paper``.
    """

    fleet: Fleet
    reference: ReferenceLength
    mode_length_px: float | None
    aggregation: Aggregation
    terms: ConfidenceTerms
    guard_length_px: float
    guarded: bool
    resolved: float
    sharpness: float = 1.0
    exact: bool = False

    @property
    def fusable_density(self) -> NDArray[np.float64] | None:
        """Vehicle density centred on the paper's GSD; lognormal if the votes are uncalibrated.

        If the votes are uncalibrated, the guard caps the confidence, or the vehicles may not be cars, the confidence is
        the density's weight over an outlier floor. Other rulers can then outvote any number of vehicles.
        """
        if self.gsd_m_per_px is None or self.interval is None:
            return None
        if self.density is not None:
            density = _recentred(self.density, self.gsd_m_per_px)
        else:
            log_sd = math.log(self.interval.high / self.interval.low) / (2 * Z95)
            density = lognormal(self.gsd_m_per_px, log_sd) if on_grid(self.gsd_m_per_px) else flat()
        doubted = self.density is None or self.guarded or self.disputed
        return with_outlier_floor(density, 1.0 - self.confidence) if doubted else density

    @property
    def disputed(self) -> bool:
        """Whether there are doubts that the vehicles are cars."""
        return any(each.code in FLEET_DOUBTS for each in self.notices)

    @property
    def stretched(self) -> bool:
        """Whether the image's width and height have different scales."""
        return any(each.code == NoticeCode.STRETCHED for each in self.notices)

    @property
    def largest_confidence(self) -> float:
        """Limit of the confidence of a scale from these vehicles alone."""
        return largest_confidence(guarded=self.guarded, disputed=self.disputed)


class Vehicles(Ruler):
    """The paper's ruler: cars are everywhere and about 5 m long."""

    kind = "vehicles"
    label = "vehicles"
    plural = True
    help = "cars"
    colour = "#0072B2"
    needs_search = True
    uses_plane = True

    def measure(self, view: View) -> VehicleEvidence:
        """Measure the fleet in a view (paper, section III).

        Raises:
            InvalidParameterError: the model does not know the region.
            CalibrationMismatchError: the calibration was made for another model.
        """
        card, plane = view.card, view.plane
        detections = view.detections if plane is None else rectified(view.detections, plane)
        fleet = select(detections, view.options.lengths, _expected(view))
        reference = reference_length(card, view.options.reference, fleet.appearance)
        mode_px, aggregation, gsd, interval = _scale(fleet, card, view.options, reference)
        guard_px = guard_length(reference.length_m, card.min_length_px)
        resolved = view.resolved_share(fleet.centres, fleet.working_scale or 1.0)
        seen_px = (mode_px or math.nan) * (fleet.working_scale or 1.0)  # in pixels of the copy that the model saw
        exact = view.options.method.preset == "paper"  # only what the paper has
        unresolved = not exact and seen_px >= guard_px > seen_px * resolved
        guarded = seen_px < guard_px or unresolved
        doubts = _doubts(fleet, card, None if plane else detections.stretch)
        terms = confidence_terms(
            fleet.lengths,
            fleet.scores,
            seen_px,
            (max(card.min_length_px, card.length_range_px[0]), card.length_range_px[1]),
        )
        return VehicleEvidence(
            kind=self.kind,
            gsd_m_per_px=gsd,
            interval=interval,
            n=len(fleet.lengths),
            confidence=composite(terms, guarded=guarded, disputed=bool(doubts)),
            notices=(
                *_capped(detections),
                *([_detail_missing(seen_px, resolved, guard_px)] if unresolved else []),
                *doubts,
            ),
            density=None if exact else _density(fleet, card, reference),
            fleet=fleet,
            reference=reference,
            mode_length_px=mode_px,
            aggregation=aggregation,
            terms=terms,
            guard_length_px=guard_px,
            guarded=guarded,
            resolved=resolved,
            sharpness=1.0 if card.votes is None else card.votes.sharpness,
            exact=exact,
        )

    def not_measured(self, view: View) -> VehicleEvidence:
        """Make the evidence without vehicles, for a caller who excludes them."""
        return self.measure(replace(view, detections=NOT_SEARCHED, tilt=None))


def _expected(view: View) -> NDArray[np.float64] | None:
    """Choose the density of the scale that identifies cars: the prior, or in a tilted view that of other rulers."""
    return view.expected if view.prior is None or view.plane is not None else view.prior.density


def _recentred(density: NDArray[np.float64], gsd_m_per_px: float) -> NDArray[np.float64]:
    """Shift a density so that its mode around a scale has its median there; unchanged without such a mode."""
    near = np.where(np.abs(GRID - math.log(gsd_m_per_px)) <= _MODE_REACH, density, 0.0)
    if near.sum() < _MODE_SHARE:
        return density
    median = credible_interval(near / near.sum(), probability=0.0).low
    moved = np.interp(GRID - math.log(gsd_m_per_px / median), GRID, density)
    return np.asarray(moved / moved.sum())


def _scale(
    fleet: Fleet, card: DetectorCard, options: ScaleOptions, reference: ReferenceLength
) -> tuple[float | None, Aggregation, float | None, Interval | None]:
    """Compute ``P_mode``, its aggregation, the GSD and its interval; None without vehicles."""
    aggregation = options.lengths.aggregation or card.aggregation
    if not len(fleet.lengths):
        return None, aggregation, None, None
    mode_px, aggregation = modal_length(fleet.lengths, fleet.scores, aggregation)
    weighted = fleet.scores if aggregation == "weighted_kde" else None
    interval = gsd_interval(fleet.lengths, mode_px, reference.length_m, reference.log_sds, scores=weighted)
    return mode_px, aggregation, reference.length_m / mode_px, interval


def _density(fleet: Fleet, card: DetectorCard, reference: ReferenceLength) -> NDArray[np.float64] | None:
    """Compute the density of all boxes, or of the fleet if the caller states it; None if the votes are uncalibrated."""
    if card.votes is None:
        return None
    found = fleet.detections
    voting = fleet.kept if fleet.is_stated else np.ones(len(fleet.kept), bool)
    pointed = 0.0 if found.corrections is None else found.corrections.pointed_log_sds[voting]
    return vehicle_density(
        found.boxes[voting, 2], found.scores[voting], reference.length_m, reference.log_sds, card.votes, pointed
    )


def _doubts(fleet: Fleet, card: DetectorCard, stretch: float | None) -> list[Notice]:
    """List doubts that the vehicles are cars, after a search over scales, which accepts objects of any size."""
    if fleet.detections.scales is None:
        return []
    doubts = fleet_doubts(
        fleet.lengths,
        fleet.scores,
        rival_share=fleet.rival_share,
        clear_score=card.clear_score,
        fleet_log_odds=None if fleet.appearance is None else fleet.appearance.log_odds,
        stretch=stretch,
        verified=fleet.detections.verified,
    )
    resolved = _DOUBTS_OF_KIND if fleet.is_stated else frozenset[NoticeCode]()
    return [Notice(code=doubt, message=_DOUBTS[doubt]) for doubt in doubts if doubt not in resolved]


def _capped(detections: Detections) -> list[Notice]:
    if not detections.n_capped_tiles:
        return []
    return [
        Notice(
            code=NoticeCode.DETECTIONS_CAPPED,
            message=f"{detections.n_capped_tiles} of {detections.n_tiles} tiles reached the model's largest "
            "number of boxes: vehicles may be missing. Export the model without nms=True, or use smaller tiles.",
        )
    ]


def _detail_missing(seen_px: float, resolved: float, guard_px: float) -> Notice:
    return Notice(
        code=NoticeCode.DETAIL_MISSING,
        message=f"The image has no detail finer than {1 / resolved:.2g} px, as after enlarging or blur: vehicles of "
        f"{seen_px:.1f} px have the detail of {seen_px * resolved:.1f} px, and {guard_px:.1f} px are needed. Give the "
        "original image.",
    )
