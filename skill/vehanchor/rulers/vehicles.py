"""Vehicles as a ruler: the fleet among the detections, its votes for the scale, and its doubts.

1. ``select`` separates the fleet (cars of one image differ by less than a factor of 1.5) from
   things of other sizes.
2. The ruler's own scale is the paper's: ``L_ref / P_mode``, the reference length in metres over the
   modal length in pixels.
3. The evidence for the posterior is not that single number, but the votes of all boxes: each is a
   car with a chance that depends on its score, and a car has a known length. The votes are widened
   by the error of the reference length.
4. The vehicles are wrong with a small chance, which grows with doubts: vehicles that are too coarse
   to measure, and a rival group of other lengths. Notices name doubts that concern other rulers,
   too (a stretched image, look-alikes); ``vehanchor.rulers.witnesses.with_doubts`` counts them.
"""

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
from vehanchor.scale.density import (
    GRID,
    UNCALIBRATED,
    blurred,
    credible_interval,
    flat,
    lognormal,
    product,
    vehicle_likelihood,
)
from vehanchor.scale.lengths import (
    MIN_SCORE,
    dominant_group,
    guard_length,
    inlier_mask,
    modal_length,
    statistical_log_sds,
)
from vehanchor.scale.paper import paper_scale
from vehanchor.scale.posterior import Lack, Witness
from vehanchor.scale.reliability import (
    CALLER,
    POINTING,
    RELIABILITY,
    CoarseErrors,
    appearance_error,
    uncalibrated_wrong,
    unresolved,
)

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detections import Appearance, Detections
    from vehanchor.detection.detector_errors import LookAlikeLimits
    from vehanchor.options import Lengths
    from vehanchor.rulers.reference import ReferenceLength
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.defaults import Aggregation, Reason
    from vehanchor.scale.density import Density, Votes
    from vehanchor.scale.paper import PaperScale

# Score of a car that is beyond doubt.
_CLEAR_SCORE = 1.0
# Interquartile range of a normal distribution, in standard deviations.
_QUARTILES_PER_SD = 1.349


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
        n_stated = int((self.detections.stated & self.kept).sum())
        return bool(2 * n_stated > self.kept.sum())

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
        if appearance is None:
            return None
        # Only the first detections have an appearance.
        kept = self.kept[: len(appearance)]
        if not kept.any():
            return None
        return appearance.take(kept)


def select(detections: Detections, lengths: Lengths, expected: Density | None = None) -> Fleet:
    """Select the fleet by the outlier filter and, after a search over scales, by one modal length.

    A vehicle that the caller adds is one clear vote: it joins the fleet, or is an outlier like
    others.

    Args:
        detections: vehicles in pixels of the image.
        lengths: options with the filter's factor.
        expected: ``[g]`` density of the scale to identify cars; None without any.

    Returns:
        The fleet, empty if nothing was found.
    """
    lengths_px = detections.boxes[:, 2]
    rival_share = 0.0
    if detections.reductions is None or len(lengths_px) == 0:
        kept = inlier_mask(lengths_px, lengths.alpha)
    else:
        # A search over scales also finds things of a car's shape that are larger or smaller.
        weights = _evidence_of_cars(detections, expected)
        kept, rival_share = dominant_group(lengths_px, weights)
        kept[kept] = inlier_mask(lengths_px[kept], lengths.alpha)
    return Fleet(detections, kept, _main_reduction(detections, kept), rival_share)


def _evidence_of_cars(detections: Detections, expected: Density | None) -> NDArray[np.float64]:
    """Weigh each box ``[n]`` by its squared score, and by how likely it is as long as a car.

    The square reduces the weight of false alarms, most of which have low scores.

    Args:
        detections: vehicles in pixels of the image.
        expected: as in ``select``.
    """
    weights = np.maximum(detections.scores, MIN_SCORE) ** 2
    if expected is None:
        return np.asarray(weights)
    # The scale at which each box would be as long as a car, and how likely that scale is.
    log_scales = np.log(CAR_LENGTH_M / detections.boxes[:, 2])
    likely = np.interp(log_scales, GRID, expected / expected.max())
    return np.asarray(np.where(detections.stated, 1.0, likely) * weights)


def _main_reduction(detections: Detections, kept: NDArray[np.bool_]) -> float | None:
    """Find the reduction with most of the kept vehicles, by score; the finer of equals."""
    if not kept.any():
        return None
    if detections.reductions is None:
        return 1.0
    # Negative reductions sort finer copies first; argmax takes the first of equals.
    negative, inverse = np.unique(-detections.reductions[kept], return_inverse=True)
    scores = np.bincount(inverse, weights=detections.scores[kept])
    return float(-negative[np.argmax(scores)])


@dataclass(frozen=True, eq=False, kw_only=True)
class VehicleWitness(Witness):
    """Witness of the vehicles, with intermediate results.

    Attributes:
        fleet: the vehicles.
        card: card of the detector.
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
        """Scale by the published method, computed on first use; a search does not need it."""
        reference = self.reference
        shortest_px, longest_px = self.card.length_range_px
        return paper_scale(
            self.fleet.lengths,
            self.fleet.scores,
            mode_px=self.mode_length_px,
            aggregation=self.aggregation,
            reference_length_m=reference.stated_m,
            reference_sd_m=reference.log_sd * reference.stated_m,
            reduction=self.fleet.main_reduction or 1.0,
            guard_length_px=self.guard_length_px,
            length_range_px=(max(self.card.min_length_px, shortest_px), longest_px),
        )

    @property
    def statistical_log_sds(self) -> tuple[float, float]:
        """Log standard deviations of the mode under resampling and of the fleet's spread.

        The witness must have vehicles.
        """
        assert self.mode_length_px is not None
        return statistical_log_sds(
            self.fleet.lengths,
            self.fleet.scores,
            mode_px=self.mode_length_px,
            aggregation=self.aggregation,
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
        """Whether the vehicles may be look-alikes, stretched, or too coarse."""
        return self.coarseness > 1.0 or any(notice.code in _DOUBT_CODES for notice in self.notices)

    def with_votes(self) -> VehicleWitness:
        """Add the evidence: votes of all boxes, the chance that they are wrong, and the lacks."""
        likelihood = self._likelihood(self.fleet.detections.scores)
        return replace(
            self,
            right=self._widened(likelihood),
            chance_wrong=self._chance_wrong,
            lacks=self._lacks(likelihood),
        )

    def _likelihood(self, scores: NDArray[np.float64]) -> Density:
        """Compute the density ``[g]`` of the scale for a known fleet.

        A box that is a car has the length of its appearance, or else the reference length.

        Args:
            scores: ``[n]`` scores of all detections.
        """
        detections = self.fleet.detections
        appearance = detections.appearance
        errors = self.card.errors
        lengths_m = np.full(len(detections.boxes), self.reference.length_m)
        log_sds = np.full(len(detections.boxes), errors.boxes.log_sd)
        if self.reference.by_appearance is not None and appearance is not None:
            n = len(appearance)
            lengths_m[:n] = np.exp(appearance.log_lengths + self.reference.by_appearance)
            log_sds[:n] = appearance.log_sds * appearance_error(
                scores[:n],
                fair_odds=errors.appearance.fair_odds,
                doubt_power=errors.appearance.doubt_power,
            )
        if detections.corrections is not None:
            # Lengths of added vehicles have the error of the caller's pointing, too.
            log_sds = np.hypot(log_sds, detections.corrections.pointed_log_sds)
        voting = self.fleet.kept if self.only_kept else slice(None)
        return vehicle_likelihood(
            detections.boxes[voting, 2],
            scores[voting],
            lengths_m=lengths_m[voting],
            votes=self._votes,
            log_sds=log_sds[voting],
        )

    @property
    def _votes(self) -> Votes:
        """Votes of the detector; a default if nobody has fitted any."""
        return self.card.votes or UNCALIBRATED

    @property
    def _coarse_errors(self) -> CoarseErrors:
        """Errors of the vehicles in addition, if they are too coarse."""
        errors = self.card.errors.vehicles
        return unresolved(
            self.coarseness,
            log_sd_per_log=errors.coarse_log_sd,
            chance_wrong_per_log=errors.coarse_chance_wrong,
        )

    def _widened(self, likelihood: Density) -> Density:
        """Widen a likelihood ``[g]`` by the errors of the fleet and of too coarse vehicles.

        A reference length that the caller guesses narrows it, where the vehicles allow it.
        """
        log_sd = math.hypot(self.reference.log_sd, self._coarse_errors.log_sd)
        widened = blurred(likelihood, log_sd, self.reference.log_mean)
        if self.reference.guess_m is None:
            return widened
        return product(widened, self._density_of_guess(self.reference.guess_m))

    def _density_of_guess(self, guess_m: float) -> Density:
        """Compute the density ``[g]`` of the scale by a reference length that the caller guesses.

        It is a guess like others: it may be wrong by itself, or with all guesses of the caller.
        """
        assert self.mode_length_px is not None
        mode_log_sd, _ = self.statistical_log_sds
        log_sd = math.hypot(self.reference.guess_log_sd, mode_log_sd)
        p_right = (1.0 - RELIABILITY["assumed"].chance_wrong) * (1.0 - CALLER.chance_wrong)
        right = lognormal(guess_m / self.mode_length_px, log_sd)
        return p_right * right + (1.0 - p_right) * flat()

    @property
    def _chance_wrong(self) -> float:
        """Chance, 0..1, that the vehicles do not show the scale."""
        if self.card.votes is None:
            likely = UNCALIBRATED.log_odds(self.fleet.scores) > 0
            chance = uncalibrated_wrong(int(likely.sum()))
        else:
            chance = self.card.errors.vehicles.chance_wrong
        # The rival group is the fleet with these odds: its share of evidence, squared. A choice.
        rival_odds = self.fleet.rival_share**2
        chance = max(chance, rival_odds / (1.0 + rival_odds))
        return 1.0 - (1.0 - chance) * (1.0 - self._coarse_errors.chance_wrong)

    def _lacks(self, likelihood: Density) -> tuple[Lack, ...]:
        """Compute what the vehicles would be without each of their weaknesses.

        Args:
            likelihood: ``[g]`` density of the scale for a known fleet.
        """
        # With enough detail, coarse vehicles add no error.
        detailed = replace(self, detail_share=math.inf)
        # All vehicles of the fleet are cars beyond doubt.
        certain_scores = np.where(self.fleet.kept, _CLEAR_SCORE, self.fleet.detections.scores)
        certain = self._likelihood(certain_scores)
        # No other group of lengths competes with the fleet.
        unrivalled = replace(self, fleet=replace(self.fleet, rival_share=0.0))
        # There is one more car, of the fleet's median length.
        another = vehicle_likelihood(
            [np.median(self.fleet.lengths)],
            [_CLEAR_SCORE],
            lengths_m=self.reference.length_m,
            votes=self._votes,
            log_sds=self.card.errors.boxes.log_sd,
        )
        # The fleet's reference length is known exactly.
        exact_length = self.reference._replace(log_sd=0.0, log_mean=0.0)
        known_fleet = replace(self, reference=exact_length)
        return (
            detailed._lack("too_coarse", likelihood),
            self._lack("not_cars", certain),
            unrivalled._lack("disagree", likelihood),
            self._lack("too_few", product(likelihood, another)),
            known_fleet._lack("imprecise", likelihood),
        )

    def _lack(self, reason: Reason, likelihood: Density) -> Lack:
        """Name a lack that this copy of the vehicles does not have."""
        right = self._widened(likelihood)
        return Lack(reason, Witness(self.kind, right=right, chance_wrong=self._chance_wrong))


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
        detections = view.detections
        # In a tilted view, other rulers identify the cars; at nadir, the scene-scale prior.
        expected = view.expected
        if plane is not None:
            detections = rectified(detections, plane, card.errors)
        elif view.prior is not None:
            expected = view.prior.density
        fleet = select(detections, view.options.lengths, expected)

        # The paper takes the caller's length as it is. So do boxes that no search found, such as
        # labels: the model's own length is that of its boxes.
        trusts_caller = view.options.method.preset == "paper" or detections.stopped_because is None
        mode_px = None
        aggregation = view.options.lengths.aggregation or card.aggregation
        if fleet.kept.any():
            mode_px, aggregation = modal_length(fleet.lengths, fleet.scores, aggregation)
        vehicles = VehicleWitness(
            self.kind,
            n=len(fleet.lengths),
            # Cars that the caller points at are as wrong as the caller's other guesses.
            shared=(POINTING,) if fleet.is_stated else (),
            notices=_capped(detections),
            fleet=fleet,
            card=card,
            reference=reference_length(
                card,
                view.options.reference,
                fleet.appearance,
                trusts_caller=trusts_caller,
            ),
            mode_length_px=mode_px,
            aggregation=aggregation,
            detail_share=view.measure_detail_share(fleet.centres, fleet.main_reduction or 1.0),
            only_kept=fleet.is_stated or (plane is not None and view.expected is not None),
        )
        if mode_px is None:
            return vehicles
        stretch = detections.stretch if plane is None else None
        return replace(
            vehicles.with_votes(),
            gsd_m_per_px=vehicles.reference.stated_m / mode_px,
            notices=(
                *vehicles.notices,
                *_unlikely_guess(vehicles),
                *_added_outliers(fleet),
                *_detail_missing(vehicles),
                *_doubts(fleet, stretch, card.errors.look_alikes),
            ),
        )


def _unlikely_guess(vehicles: VehicleWitness) -> tuple[Notice, ...]:
    """Warn of a reference length from the caller that the vehicles exclude."""
    guess_m = vehicles.reference.guess_m
    if guess_m is None or vehicles.mode_length_px is None:
        return ()
    without = replace(vehicles, reference=vehicles.reference._replace(guess_m=None)).with_votes()
    assert without.right is not None
    low, high = credible_interval(without.right)
    if low <= guess_m / vehicles.mode_length_px <= high:
        return ()
    low_m = low * vehicles.mode_length_px
    high_m = high * vehicles.mode_length_px
    message = (
        f"The given reference length of {guess_m:g} m does not fit these vehicles, whose usual "
        f"length is between {low_m:.1f} and {high_m:.1f} m. It hardly changes the scale. If the "
        "fleet was measured, give its calibration."
    )
    return (Notice(code=NoticeCode.REFERENCE_LENGTH_UNLIKELY, message=message),)


def _added_outliers(fleet: Fleet) -> tuple[Notice, ...]:
    """Warn of vehicles that the caller added, and whose lengths do not fit the fleet."""
    outliers = fleet.detections.stated & ~fleet.kept
    if not outliers.any():
        return ()
    ratio = float(np.median(fleet.detections.boxes[outliers, 2]) / np.median(fleet.lengths))
    cause = "a lorry?" if ratio > 1 else "only a part of one?"
    message = (
        f"A vehicle that you added is {ratio:.1f} times as long as the {fleet.kept.sum()} others: "
        f"{cause} It does not count. If the others are not cars, drop them."
    )
    return (Notice(code=NoticeCode.ADDED_VEHICLE_UNLIKE, message=message),)


_STRETCHED = Notice(
    code=NoticeCode.STRETCHED,
    message=(
        "The vehicles would have a car's proportions only if the image were narrower or wider. It "
        "was stretched in one direction or taken at a tilt, so that its width and height have "
        "different scales."
    ),
)
_LOOK_ALIKES = Notice(
    code=NoticeCode.LOOK_ALIKES,
    message=(
        "The vehicles are more alike than cars of different makes, or unlike any known car. They "
        "may be lorries, caravans or containers of one model, roof units or boats. The scale is "
        "then wrong by the ratio of their length to a car's."
    ),
)
_DOUBT_CODES = (_STRETCHED.code, _LOOK_ALIKES.code)


def _doubts(fleet: Fleet, stretch: float | None, limits: LookAlikeLimits) -> tuple[Notice, ...]:
    """Doubt that the vehicles are cars of true proportions, after a search over scales.

    Without such a search, the vehicles were not chosen by their length, and no doubt arises. A
    caller who states that most of the vehicles are cars resolves the doubt that they are
    look-alikes.

    Args:
        fleet: the vehicles.
        stretch: see ``vehanchor.detection.detections.Detections``; None if it is not doubted.
        limits: of look-alikes.
    """
    if fleet.detections.reductions is None:
        return ()
    doubts = []
    if stretch is not None and abs(stretch) > 1.0:
        doubts.append(_STRETCHED)
    if not fleet.is_stated and look_alikes(fleet.lengths, fleet.appearance, limits):
        doubts.append(_LOOK_ALIKES)
    return tuple(doubts)


def look_alikes(lengths: ArrayLike, appearance: Appearance | None, limits: LookAlikeLimits) -> bool:
    """Test whether vehicles may be equal things, such as lorries, caravans or boats in rows.

    One of two signs is enough. Either their lengths and their appearances
    spread less than those of cars of different makes (interquartile range over 1.349), or they look
    less like cars than any fleet.

    Args:
        lengths: ``[n]`` pixels.
        appearance: appearance of the vehicles that have any; None without a chip network.
        limits: the detector's limits, among them the least number of vehicles.
    """
    lengths_px = np.asarray(lengths, dtype=np.float64)
    if len(lengths_px) < limits.min_vehicles:
        return False
    equal_lengths = _spread(np.log(lengths_px)) < limits.log_sd
    if appearance is None or len(appearance) < limits.min_vehicles:
        return equal_lengths
    if appearance.logits.mean() < limits.min_mean_logit:
        return True
    return equal_lengths and _spread(appearance.log_lengths) < limits.log_sd


def _spread(values: NDArray[np.float64]) -> float:
    """Estimate the standard deviation by the quartiles, which outliers hardly move."""
    low, high = np.percentile(values, [25, 75])
    return float(high - low) / _QUARTILES_PER_SD


def _capped(detections: Detections) -> tuple[Notice, ...]:
    """Warn of tiles in which the model returned its largest number of boxes."""
    if not detections.n_capped_tiles:
        return ()
    message = (
        f"{detections.n_capped_tiles} of {detections.n_tiles} tiles reached the model's largest "
        "number of boxes: vehicles may be missing. Export the model without nms=True, or use "
        "smaller tiles."
    )
    return (Notice(code=NoticeCode.DETECTIONS_CAPPED, message=message),)


def _detail_missing(vehicles: VehicleWitness) -> tuple[Notice, ...]:
    """Warn of vehicles that have enough pixels, but not enough detail."""
    length_px = vehicles.seen_length_px
    guard_px = vehicles.guard_length_px
    detailed_px = length_px * vehicles.detail_share
    if length_px < guard_px or detailed_px >= guard_px:
        return ()
    finest_px = 1 / vehicles.detail_share
    message = (
        f"The image has no detail finer than {finest_px:.2g} px, perhaps because it was enlarged "
        f"or blurred: vehicles of {length_px:.1f} px have the detail of {detailed_px:.1f} px, and "
        f"{guard_px:.1f} px are needed. Give the original image."
    )
    return (Notice(code=NoticeCode.DETAIL_MISSING, message=message),)


def vehicle_witness(witnesses: Iterable[Witness]) -> VehicleWitness | None:
    """Find the witness of the vehicles; None if the caller excludes them."""
    for witness in witnesses:
        if witness.kind == Vehicles.kind:
            return cast("VehicleWitness", witness)
    return None
