"""Vehicles as a ruler: the fleet among the detections, its votes for the scale, and doubts about it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, cast

import numpy as np

from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.camera_tilt import rectified
from vehanchor.rulers.reference import reference_length
from vehanchor.rulers.ruler import Ruler
from vehanchor.scale.defaults import CAR_LENGTH_M
from vehanchor.scale.density import GRID, UNCALIBRATED, blurred, product, vehicle_likelihood
from vehanchor.scale.lengths import (
    LEAST_SCORE,
    dominant_group,
    guard_length,
    inlier_mask,
    modal_length,
    statistical_log_sds,
)
from vehanchor.scale.paper import paper_scale
from vehanchor.scale.posterior import Lack, Witness
from vehanchor.scale.reliability import (
    CAR_LOG_SD,
    RELIABILITY,
    appearance_error,
    uncalibrated_wrong,
    unresolved,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detections import Appearance, Detections
    from vehanchor.options import Lengths
    from vehanchor.rulers.reference import ReferenceLength
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.defaults import Aggregation, Reason
    from vehanchor.scale.density import Votes
    from vehanchor.scale.paper import PaperScale

_CLEAR_SCORE = 1.0  # of a car that nobody doubts
_LEAST_ALIKE = 20  # vehicles with which the spread is known to a sixth
# spread of log lengths, as measured and by appearance; of 204 fleets 3 have less, none in both
_EQUAL = 0.045
_LEAST_LOGIT = 2.0  # mean; 203 of 204 fleets have more
_QUARTILES_PER_SD = 1.349  # of a normal distribution


@dataclass(frozen=True, eq=False)
class Fleet:
    """Vehicles behind the scale.

    Attributes:
        detections: all detections.
        kept: ``[n]`` bool, the detections of the fleet.
        main_reduction: reduction of the image copy with most of the fleet, by score; None without
            vehicles.
        rival_share: evidence of the strongest group of other lengths over the fleet's; 0 without
            any.
    """

    detections: Detections
    kept: NDArray[np.bool_]
    main_reduction: float | None
    rival_share: float = 0.0

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
    def appearance(self) -> Appearance | None:
        """Appearance of the vehicles that have any; None without such vehicles."""
        appearance = self.detections.appearance
        if appearance is None or not self.kept[: len(appearance)].any():
            return None
        return appearance.take(self.kept[: len(appearance)])


def select(
    detections: Detections, lengths: Lengths, expected: NDArray[np.float64] | None = None
) -> Fleet:
    """Select the fleet with the outlier filter and, after a search over scales, by lengths that fit one fleet.

    Vehicles that the caller states to be cars are always kept, and their lengths choose the fleet.

    Args:
        detections: vehicles in pixels of the image.
        lengths: options with the filter's factor.
        expected: ``[g]`` density of the scale to identify cars; None without any.

    Returns:
        The fleet, empty if nothing was found.
    """
    found = detections.boxes[:, 2]
    stated = detections.stated
    if detections.reductions is None or len(found) == 0:
        kept = inlier_mask(found, lengths.alpha)
        rival_share = 0.0
    else:
        weights = np.maximum(detections.scores, LEAST_SCORE) ** 2
        if expected is not None:  # how likely each box is as long as a car
            likely = np.interp(np.log(CAR_LENGTH_M / found), GRID, expected / expected.max())
            weights = np.where(stated, 1.0, likely) * weights
        kept, rival_share = dominant_group(found, weights, stated)
        kept[kept] = inlier_mask(found[kept], lengths.alpha)
    kept |= stated
    return Fleet(
        detections, kept, _main_reduction(detections, kept), 0.0 if stated.any() else rival_share
    )


def _main_reduction(detections: Detections, kept: NDArray[np.bool_]) -> float | None:
    """Find the scale with most of the kept vehicles, by score; the finer of equals."""
    if not kept.any():
        return None
    if detections.reductions is None:
        return 1.0
    reductions, which = np.unique(-detections.reductions[kept], return_inverse=True)
    return float(-reductions[np.argmax(np.bincount(which, weights=detections.scores[kept]))])


@dataclass(frozen=True, eq=False, kw_only=True)
class VehicleWitness(Witness):
    """Witness of the vehicles, with intermediate results.

    Attributes:
        fleet: the vehicles.
        card: of the detector.
        reference: ``L_ref`` and its source.
        mode_length_px: ``P_mode``; None without vehicles.
        aggregation: statistic of the lengths.
        detail_share: share of the pixels' resolution at which there is detail.
        only_kept: whether the fleet alone votes: in a tilted view, the other boxes are parts of
            cars.
    """

    fleet: Fleet
    card: DetectorCard
    reference: ReferenceLength
    mode_length_px: float | None
    aggregation: Aggregation
    detail_share: float
    only_kept: bool

    @property
    def guard_length_px(self) -> float:
        """``P_thresh`` of the resolution guard."""
        return guard_length(self.reference.length_m, self.card.min_length_px)

    @cached_property
    def paper(self) -> PaperScale:
        """Scale by the published method; a search needs none of it."""
        shortest_px, longest_px = self.card.length_range_px
        return paper_scale(
            self.fleet.lengths,
            self.fleet.scores,
            mode=(self.mode_length_px, self.aggregation),
            reference_m=(self.reference.length_m, self.reference.log_sd * self.reference.length_m),
            reduction=self.fleet.main_reduction or 1.0,
            guard_length_px=self.guard_length_px,
            length_range_px=(max(self.card.min_length_px, shortest_px), longest_px),
        )

    @property
    def statistical_log_sds(self) -> tuple[float, float]:
        """Log standard deviations of the mode under resampling and of the fleet's spread; there must be vehicles."""
        assert self.mode_length_px is not None
        return statistical_log_sds(
            self.fleet.lengths, self.fleet.scores, self.mode_length_px, self.aggregation
        )

    @property
    def seen_length_px(self) -> float:
        """Modal length in pixels of the copy that the model saw; there must be vehicles."""
        assert self.mode_length_px is not None
        return self.mode_length_px * (self.fleet.main_reduction or 1.0)

    @property
    def coarseness(self) -> float:
        """``P_thresh`` over the vehicles' length; above 1 they are too coarse."""
        return self.guard_length_px / (self.seen_length_px * self.detail_share)

    @property
    def doubted(self) -> bool:
        """Whether the vehicles may be look-alikes, the image stretched, or the vehicles too coarse."""
        return any(notice.code in _DOUBTS for notice in self.notices) or self.coarseness > 1.0

    def by_votes(self) -> VehicleWitness:
        """Weigh the votes of the boxes; their lacks are detail, cars without doubt, one car more, a known fleet."""
        model = self.card.votes or UNCALIBRATED
        scores = self.fleet.detections.scores
        likelihood = self._likelihood(scores, model)
        clear = self._likelihood(np.where(self.fleet.kept, _CLEAR_SCORE, scores), model)
        another = vehicle_likelihood(
            [np.median(self.fleet.lengths)],
            [_CLEAR_SCORE],
            lengths_m=self.reference.length_m,
            votes=model,
        )
        without: list[tuple[Reason, VehicleWitness, NDArray[np.float64]]] = [
            ("too_coarse", replace(self, detail_share=math.inf), likelihood),
            ("not_cars", self, clear),
            ("disagree", replace(self, fleet=replace(self.fleet, rival_share=0.0)), likelihood),
            ("too_few", self, product(likelihood, another)),
            (
                "imprecise",
                replace(self, reference=self.reference._replace(log_sd=0.0, log_mean=0.0)),
                likelihood,
            ),
        ]
        return replace(
            self,
            right=self._widened(likelihood),
            chance_wrong=self._chance_wrong,
            lacks=tuple(
                Lack(
                    reason,
                    Witness(
                        self.kind,
                        None,
                        right=each._widened(density),
                        chance_wrong=each._chance_wrong,
                    ),
                )
                for reason, each, density in without
            ),
        )

    def _likelihood(self, scores: NDArray[np.float64], votes: Votes) -> NDArray[np.float64]:
        """Compute the density ``[g]`` of the scale for a known fleet, with these scores ``[n]``.

        The boxes' lengths in metres, if they are cars, are those by their looks, or the reference.
        """
        found = self.fleet.detections
        lengths_m = np.full(len(found.boxes), self.reference.length_m)
        log_sds = np.full(len(found.boxes), CAR_LOG_SD)
        if self.reference.by_appearance is not None and found.appearance is not None:
            seen = len(found.appearance)
            lengths_m[:seen] = np.exp(found.appearance.log_lengths + self.reference.by_appearance)
            log_sds[:seen] = found.appearance.log_sds * appearance_error(scores[:seen])
        if found.corrections is not None:
            log_sds = np.hypot(log_sds, found.corrections.pointed_log_sds)
        voting = self.fleet.kept if self.only_kept else slice(None)
        return vehicle_likelihood(
            found.boxes[voting, 2],
            scores[voting],
            lengths_m=lengths_m[voting],
            votes=votes,
            log_sds=log_sds[voting],
        )

    def _widened(self, likelihood: NDArray[np.float64]) -> NDArray[np.float64]:
        """Widen a likelihood ``[g]`` by the errors of the fleet and of too coarse vehicles."""
        log_sd = math.hypot(self.reference.log_sd, unresolved(self.coarseness).log_sd)
        return blurred(likelihood, log_sd, self.reference.log_mean)

    @property
    def _chance_wrong(self) -> float:
        """0..1, chance that the vehicles do not tell the scale."""
        if self.card.votes is None:
            likely = UNCALIBRATED.log_odds(self.fleet.scores) > 0
            chance = uncalibrated_wrong(int(likely.sum()))
        else:
            chance = RELIABILITY["vehicles"].chance_wrong
        rival_odds = self.fleet.rival_share**2  # that the other group is the fleet; a choice
        chance = max(chance, rival_odds / (1.0 + rival_odds))
        return 1.0 - (1.0 - chance) * (1.0 - unresolved(self.coarseness).chance_wrong)


class Vehicles(Ruler):
    """The paper's ruler: cars are everywhere and about 5 m long."""

    kind = "vehicles"
    label = "vehicles"
    plural = True
    help = "cars"
    colour = "#0072B2"
    pooling_gain = None
    needs_search = True
    uses_plane = True

    def measure(self, view: View) -> VehicleWitness:
        """Measure the fleet in a view (paper, section III); its own scale is ``L_ref / P_mode``.

        Raises:
            InvalidParameterError: the model does not know the region.
            CalibrationMismatchError: the calibration was made for another model.
        """
        card = view.card
        plane = view.plane
        detections = view.detections if plane is None else rectified(view.detections, plane)
        expected = view.expected if view.prior is None or plane is not None else view.prior.density
        fleet = select(detections, view.options.lengths, expected)
        mode_px = None
        aggregation = view.options.lengths.aggregation or card.aggregation
        if fleet.kept.any():
            mode_px, aggregation = modal_length(fleet.lengths, fleet.scores, aggregation)
        found = VehicleWitness(
            self.kind,
            n=len(fleet.lengths),
            notices=_capped(detections),
            fleet=fleet,
            card=card,
            reference=reference_length(card, view.options.reference, fleet.appearance),
            mode_length_px=mode_px,
            aggregation=aggregation,
            detail_share=view.measure_detail_share(fleet.centres, fleet.main_reduction or 1.0),
            only_kept=fleet.is_stated or (plane is not None and view.expected is not None),
        )
        if mode_px is None:
            return found
        notices = (
            *found.notices,
            *_detail_missing(found),
            *_doubts(fleet, None if plane else detections.stretch),
        )
        return replace(
            found.by_votes(), gsd_m_per_px=found.reference.length_m / mode_px, notices=notices
        )


_DOUBTS = {
    NoticeCode.STRETCHED: Notice(
        code=NoticeCode.STRETCHED,
        message="The vehicles have a car's proportions only if the image is made narrower or "
        "wider: it was stretched "
        "in one direction, or taken at a tilt, and its width and height have different scales.",
    ),
    NoticeCode.LOOK_ALIKES: Notice(
        code=NoticeCode.LOOK_ALIKES,
        message="The vehicles are more alike than cars of different makes, or unlike all known "
        "cars: they may be equal "
        "lorries, caravans, containers, roof units or boats, and the scale wrong by the ratio "
        "of their length to a "
        "car's.",
    ),
}


def _doubts(fleet: Fleet, stretch: float | None) -> tuple[Notice, ...]:
    """Doubt that the vehicles are cars of true proportions, after a search over scales.

    A caller who states that most of the vehicles are cars resolves the doubt that they are
    look-alikes.
    """
    if fleet.detections.reductions is None:
        return ()
    stretched = stretch is not None and abs(stretch) > 1.0
    alike = not fleet.is_stated and look_alikes(fleet.lengths, fleet.appearance)
    return tuple(
        each for each, doubted in zip(_DOUBTS.values(), (stretched, alike), strict=True) if doubted
    )


def look_alikes(lengths: ArrayLike, appearance: Appearance | None) -> bool:
    """Test whether vehicles may be equal things that are no cars, such as lorries, caravans and boats in rows.

    One of two signs is enough, from 20 vehicles on: their lengths and their looks spread less than
    those of cars of different makes (interquartile range over 1.349), or they look less like cars
    than any fleet.

    Args:
        lengths: ``[n]`` pixels.
        appearance: of the vehicles that have any; None without a chip network.
    """
    values = np.asarray(lengths, dtype=np.float64)
    if len(values) < _LEAST_ALIKE:
        return False
    equal = _spread(np.log(values)) < _EQUAL
    if appearance is None or len(appearance) < _LEAST_ALIKE:
        return bool(equal)
    return bool(
        appearance.logits.mean() < _LEAST_LOGIT
        or (equal and _spread(appearance.log_lengths) < _EQUAL)
    )


def _spread(values: NDArray[np.float64]) -> float:
    low, high = np.percentile(values, [25, 75])
    return float(high - low) / _QUARTILES_PER_SD


def _capped(detections: Detections) -> tuple[Notice, ...]:
    if not detections.n_capped_tiles:
        return ()
    message = (
        f"{detections.n_capped_tiles} of {detections.n_tiles} tiles reached the model's largest "
        "number of boxes: "
        "vehicles may be missing. Export the model without nms=True, or use smaller tiles."
    )
    return (Notice(code=NoticeCode.DETECTIONS_CAPPED, message=message),)


def _detail_missing(found: VehicleWitness) -> tuple[Notice, ...]:
    """Warn of vehicles that have enough pixels, but not enough detail."""
    seen_px = found.seen_length_px
    guard_px = found.guard_length_px
    if not seen_px >= guard_px > seen_px * found.detail_share:
        return ()
    message = (
        f"The image has no detail finer than {1 / found.detail_share:.2g} px, as after "
        "enlarging or "
        "blur: vehicles of "
        f"{seen_px:.1f} px have the detail of {seen_px * found.detail_share:.1f} px, and "
        f"{guard_px:.1f} px are needed. "
        "Give the original image."
    )
    return (Notice(code=NoticeCode.DETAIL_MISSING, message=message),)


def measured_vehicles(witnesses: Iterable[Witness]) -> VehicleWitness | None:
    """Find the witness of the vehicles; None if the caller excludes them."""
    return cast(
        "VehicleWitness | None",
        next((each for each in witnesses if each.kind == Vehicles.kind), None),
    )
