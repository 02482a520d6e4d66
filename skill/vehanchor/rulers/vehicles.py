"""Vehicles as a ruler: the fleet among the detections, its votes for the scale, and its doubts.

1. ``vehanchor.rulers.fleet.select`` separates the fleet from things of other sizes: cars of one
   image differ by less than a factor of 1.5.
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
from vehanchor.rulers.fleet import select
from vehanchor.rulers.look_alikes import chance_of_look_alikes
from vehanchor.rulers.reference import country_in_words, reference_length, unmeasured_region
from vehanchor.rulers.ruler import Ruler, as_assumed
from vehanchor.rulers.vehicle_notices import (
    DOUBT_CODES,
    added_outliers,
    capped_tiles,
    copied_vehicles,
    detail_missing,
    doubts,
    nothing_detailed,
)
from vehanchor.scale.density import (
    UNCALIBRATED,
    blurred,
    credible_interval,
    lognormal,
    product,
    vehicle_likelihood,
)
from vehanchor.scale.lengths import (
    GROUP_LOG_REACH,
    guard_length,
    modal_length,
    statistical_log_sds,
)
from vehanchor.scale.paper import paper_interval, paper_scale
from vehanchor.scale.posterior import Lack, Witness
from vehanchor.scale.reliability import (
    POINTING,
    RELIABILITY,
    ROUGH,
    CoarseErrors,
    appearance_error,
    excess_scatter,
    log_odds_by_density,
    uncalibrated_wrong,
    unresolved,
)

if TYPE_CHECKING:
    from collections.abc import Iterable
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detections import Appearance
    from vehanchor.rulers.fleet import Fleet
    from vehanchor.rulers.reference import ReferenceLength
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.defaults import Aggregation, Reason
    from vehanchor.scale.density import Density, Votes
    from vehanchor.scale.lengths import Interval
    from vehanchor.scale.paper import PaperScale

    Boxes: TypeAlias = NDArray[np.float64]
    """``[n, 5]`` rows ``(x, y, length, width, angle)``, pixels and radians."""

    Scores: TypeAlias = NDArray[np.float64]
    """``[n]`` scores of all detections."""

    Lengths: TypeAlias = NDArray[np.float64]
    """``[n]`` lengths in metres, or errors of their logs."""

# Share of the fleet that fits a scale, below which the scale is that of other vehicles. A choice.
_FITTING_SHARE = 0.5
# Score of a car that is beyond doubt.
_CLEAR_SCORE = 1.0
# Log odds of a stretch from which one network's verdict counts.
_CLEAR_STRETCH = 1.0


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
        is_at_nadir: whether the view is, as far as is known: a tilted one is rectified.
        stretch_log_odds: as in ``vehanchor.detection.detections.Detections``; None in a tilted
            view, which foreshortens the vehicles.
    """

    fleet: Fleet
    card: DetectorCard
    reference: ReferenceLength
    mode_length_px: float | None
    aggregation: Aggregation
    detail_share: float
    only_kept: bool
    is_at_nadir: bool = True
    stretch_log_odds: float | None = None

    @property
    def guard_length_px(self) -> float:
        """``P_thresh`` of the resolution guard."""
        return guard_length(self.reference.length_m, self.card.min_length_px)

    @cached_property
    def paper(self) -> PaperScale:
        """Scale by the published method, computed on first use; a search does not need it."""
        reference = self.reference
        shortest_px, longest_px = self.card.length_range_px
        shortest_px = max(self.card.min_length_px, shortest_px)
        return paper_scale(
            self.fleet.lengths,
            self.fleet.scores,
            mode_px=self.mode_length_px,
            reference_length_m=reference.stated_m,
            reduction=self.fleet.main_reduction or 1.0,
            guard_length_px=self.guard_length_px,
            length_range_px=(shortest_px, longest_px),
        )

    @property
    def paper_interval(self) -> Interval:
        """Interval by the published method; the witness must have vehicles."""
        assert self.mode_length_px is not None
        reference = self.reference
        return paper_interval(
            self.fleet.lengths,
            self.fleet.scores,
            mode_px=self.mode_length_px,
            aggregation=self.aggregation,
            reference_length_m=reference.stated_m,
            reference_sd_m=reference.log_sd * reference.stated_m,
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

    @cached_property
    def p_look_alikes(self) -> float:
        """Chance, 0..1, that the vehicles are equal things that are not cars.

        Without a search over scales, the vehicles were not chosen by their length, and no doubt
        arises. A caller who states that most of the vehicles are cars resolves it.
        """
        fleet = self.fleet
        if fleet.detections.reductions is None or fleet.is_stated or not self.n:
            return 0.0
        chance = self._chance_of_look_alikes(fleet.detections.boxes[fleet.kept], fleet.appearance)
        repeating = fleet.detections.with_copies
        if repeating is None:
            return chance
        # What few distinct vehicles do not show, their copies do.
        with_copies = self._chance_of_look_alikes(repeating.boxes, repeating.appearance)
        return max(chance, with_copies)

    def _chance_of_look_alikes(self, boxes: Boxes, appearance: Appearance | None) -> float:
        """Compute the chance of look-alikes for boxes ``[n, 5]``, with an appearance of the first.

        Args:
            boxes: the vehicles.
            appearance: of those that have any.
        """
        # A stretch makes lengths depend on directions, too.
        is_stretched = self.stretch_log_odds is not None and self.stretch_log_odds > 0
        undistorted = self.is_at_nadir and not is_stretched
        return chance_of_look_alikes(boxes, appearance, self.card.errors, undistorted=undistorted)

    @property
    def doubted(self) -> bool:
        """Whether the vehicles may be look-alikes, stretched, or too coarse."""
        if self.coarseness > 1.0:
            return True
        return any(notice.code in DOUBT_CODES for notice in self.notices)

    def fitted_to(self, gsd_m_per_px: float) -> VehicleWitness:
        """Keep the vehicles whose lengths fit a scale, if most of the fleet does not.

        All boxes vote, and other rulers count, so that the scale can be that of other vehicles than
        the fleet. The kept vehicles follow the scale.

        Args:
            gsd_m_per_px: the decided scale.

        Returns:
            These vehicles, or the same with another fleet; the same if no vehicle fits.
        """
        lengths_m = self.fleet.detections.boxes[:, 2] * gsd_m_per_px
        log_ratios = np.log(lengths_m / self.reference.length_m)
        fits = np.abs(log_ratios) <= GROUP_LOG_REACH
        if not fits.any():
            return self
        fitting_share = fits[self.fleet.kept].mean()
        if fitting_share >= _FITTING_SHARE:
            return self
        fleet = replace(self.fleet, kept=fits)
        lengths_px = fleet.lengths
        mode_px, aggregation = modal_length(lengths_px, fleet.scores, self.aggregation)
        return replace(
            self,
            fleet=fleet,
            n=len(lengths_px),
            mode_length_px=mode_px,
            aggregation=aggregation,
            gsd_m_per_px=self.reference.stated_m / mode_px,
        )

    def with_votes(self) -> VehicleWitness:
        """Add the evidence: votes of all boxes, the chance that they are wrong, and the lacks.

        A reference length that the caller guesses is a guess beside them. The witness must have
        vehicles.
        """
        likelihood = self._likelihood(self.fleet.detections.scores)
        without_guess = replace(
            self,
            right=self._widened(likelihood),
            chance_wrong=self._chance_wrong,
            lacks=self._lacks(likelihood),
        )
        guess = self._guessed_length()
        if guess is None:
            return without_guess
        lacks = [Lack("assumed", without_guess)]
        for lack in without_guess.lacks:
            without = replace(lack.without, guess=guess)
            lacks.append(Lack(lack.reason, without))
        return replace(without_guess, guess=guess, lacks=tuple(lacks))

    def in_known_region(self) -> VehicleWitness:
        """Narrow the evidence as the name of a measured region would; there must be vehicles."""
        reference = self.reference.in_known_region(self.card)
        informed = replace(self, reference=reference)
        likelihood = self._likelihood(self.fleet.detections.scores)
        return replace(self, right=informed._widened(likelihood))

    def _likelihood(self, scores: Scores) -> Density:
        """Compute the density ``[g]`` of the scale for a known fleet.

        A box that is a car has the length of its appearance, or else the reference length.

        Args:
            scores: ``[n]`` scores of all detections.
        """
        boxes = self.fleet.detections.boxes
        lengths_m, log_sds = self._lengths_of_cars(scores)
        voting = self.fleet.kept if self.only_kept else slice(None)
        return vehicle_likelihood(
            boxes[voting, 2],
            scores[voting],
            lengths_m=lengths_m[voting],
            votes=self._votes,
            log_sds=log_sds[voting],
        )

    def _lengths_of_cars(self, scores: Scores) -> tuple[Lengths, Lengths]:
        """Collect the length of each detection if it is a car, and the error of its log.

        Args:
            scores: ``[n]`` scores of all detections.

        Returns:
            ``[n]`` metres, and ``[n]`` standard deviations of their logs.
        """
        detections = self.fleet.detections
        appearance = detections.appearance
        errors = self.card.errors
        reference = self.reference
        n_boxes = len(detections.boxes)
        lengths_m = np.full(n_boxes, reference.length_m)
        log_sds = np.full(n_boxes, errors.boxes.log_sd)
        if reference.by_appearance is not None and appearance is not None:
            # Only the first detections have an appearance.
            n = len(appearance)
            lengths_m[:n] = np.exp(appearance.log_lengths + reference.by_appearance)
            # The more certainly a box is a car, the smaller is the error of its length.
            factors = appearance_error(
                scores[:n],
                fair_odds=errors.appearance.fair_odds,
                doubt_power=errors.appearance.doubt_power,
            )
            log_sds[:n] = appearance.log_sds * factors
        if detections.corrections is not None:
            # Lengths of added vehicles have the error of the caller's pointing, too.
            log_sds = np.hypot(log_sds, detections.corrections.pointed_log_sds)
        return lengths_m, log_sds

    @cached_property
    def _excess_scatter(self) -> float:
        """Factor, at least 1, on the error of the fleet's length by appearance."""
        detections = self.fleet.detections
        appearance = detections.appearance
        if self.reference.by_appearance is None or appearance is None:
            return 1.0
        lengths_m, log_sds = self._lengths_of_cars(detections.scores)
        # Only the first detections have an appearance.
        seen = np.flatnonzero(self.fleet.kept[: len(appearance)])
        log_scales = np.log(lengths_m[seen] / detections.boxes[seen, 2])
        return excess_scatter(
            log_scales, log_sds[seen], usual_n=self.card.errors.appearance.scatter_cars
        )

    @property
    def _votes(self) -> Votes:
        """Votes of the detector; default votes if none are fitted to it."""
        return self.card.votes or UNCALIBRATED

    @property
    def _coarse_errors(self) -> CoarseErrors:
        """Further errors of vehicles that are too coarse; zero for others."""
        errors = self.card.errors.vehicles
        return unresolved(
            self.coarseness,
            log_sd_per_log=errors.coarse_log_sd,
            chance_wrong_per_log=errors.coarse_chance_wrong,
        )

    def _widened(self, likelihood: Density) -> Density:
        """Widen a likelihood ``[g]`` by the errors of the reference length and of coarseness."""
        reference = self.reference
        reference_log_sd = reference.log_sd * self._excess_scatter
        log_sd = math.hypot(reference_log_sd, self._coarse_errors.log_sd)
        return blurred(likelihood, log_sd, reference.log_mean)

    def _guessed_length(self) -> Witness | None:
        """Make the witness of a reference length that the caller guesses; None without one.

        It is a guess like others: it may be wrong by itself, or with all guesses of the caller.
        """
        guess_m = self.reference.guess_m
        if guess_m is None:
            return None
        assert self.mode_length_px is not None
        mode_log_sd, _ = self.statistical_log_sds
        log_sd = math.hypot(RELIABILITY["assumed"].log_sd, mode_log_sd)
        gsd_m_per_px = guess_m / self.mode_length_px
        guess = Witness(
            self.kind,
            gsd_m_per_px,
            right=lognormal(gsd_m_per_px, log_sd),
            chance_wrong=RELIABILITY["assumed"].chance_wrong,
            shared=(ROUGH,),
        )
        return as_assumed(guess)

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
        chance_of_rival = rival_odds / (1.0 + rival_odds)
        chance = max(chance, chance_of_rival)
        # Coarse vehicles can be wrong by themselves, independently of the other causes.
        fine_p_right = 1.0 - self._coarse_errors.chance_wrong
        return 1.0 - (1.0 - chance) * fine_p_right

    def _lacks(self, likelihood: Density) -> tuple[Lack, ...]:
        """Compute what the vehicles would be without each of their weaknesses.

        Args:
            likelihood: ``[g]`` density of the scale for a known fleet.
        """
        # With enough detail, coarse vehicles add no error.
        detailed = replace(self, detail_share=math.inf)
        # All vehicles of the fleet are cars beyond doubt.
        fleet = self.fleet
        certain_scores = np.where(fleet.kept, _CLEAR_SCORE, fleet.detections.scores)
        certain = self._likelihood(certain_scores)
        # No other group of lengths competes with the fleet.
        fleet_alone = replace(fleet, rival_share=0.0)
        unrivalled = replace(self, fleet=fleet_alone)
        # There is one more car, of the fleet's median length.
        another = vehicle_likelihood(
            [np.median(fleet.lengths)],
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
        """Name a lack that this copy of the vehicles does not have.

        Args:
            reason: name of the lack.
            likelihood: ``[g]`` density of the scale without the lack.
        """
        right = self._widened(likelihood)
        witness = Witness(self.kind, right=right, chance_wrong=self._chance_wrong)
        return Lack(reason, witness)


class Vehicles(Ruler):
    """The paper's ruler: cars are everywhere and about 5 m long."""

    kind = "vehicles"
    label = "vehicles"
    plural = True
    help = "cars"
    colour = "#0072B2"
    pooling_gain = None
    needs_search = True
    reads_scene = True
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
        is_paper = view.options.method.preset == "paper"
        trusts_caller = is_paper or not detections.were_searched
        votes = card.votes or UNCALIBRATED
        reference = reference_length(
            card,
            view.options.reference,
            fleet.appearance,
            n_cars=votes.expected_cars(fleet.scores),
            trusts_caller=trusts_caller,
        )
        mode_px = None
        aggregation = view.options.lengths.aggregation or card.aggregation
        if fleet.kept.any():
            mode_px, aggregation = modal_length(fleet.lengths, fleet.scores, aggregation)
        reduction = fleet.main_reduction or 1.0
        others_identify_cars = plane is not None and view.expected is not None
        vehicles = VehicleWitness(
            self.kind,
            n=len(fleet.lengths),
            # Cars that the caller points at are as wrong as the caller's other guesses.
            shared=(POINTING,) if fleet.is_stated else (),
            notices=(*capped_tiles(detections), *copied_vehicles(detections)),
            fleet=fleet,
            card=card,
            reference=reference,
            mode_length_px=mode_px,
            aggregation=aggregation,
            detail_share=view.measure_detail_share(fleet.centres, reduction),
            only_kept=fleet.is_stated or others_identify_cars,
            is_at_nadir=plane is None,
        )
        if mode_px is None:
            return replace(vehicles, notices=(*vehicles.notices, *nothing_detailed(view)))
        unmeasured = unmeasured_region(card, view.options.reference)
        statement = None
        if reference.source == "region":
            statement = country_in_words(card, view.options.reference)
        # A tilted view foreshortens the vehicles, so that their proportions prove no stretch.
        stretch = detections.stretch if plane is None else None
        log_odds = None
        if plane is None and detections.stretch_log_odds is not None:
            log_odds = detections.stretch_log_odds + log_odds_by_density(view.image.density_aspect)
            # One network's verdict is a doubt only if the odds by all witnesses are for it, too. Of
            # 1,081 stretched photographs 36 are then usable and wrong, and 35 with a limit of 0; of
            # 1,050 right scales three fewer are lost. The chance by the odds stays.
            if log_odds < _CLEAR_STRETCH:
                stretch = None
        voting = vehicles.with_votes()
        return replace(
            voting,
            stretch_log_odds=log_odds,
            gsd_m_per_px=reference.stated_m / mode_px,
            statement=statement,
            notices=(*voting.notices, *unmeasured, *_notices(voting, stretch)),
        )


def _notices(vehicles: VehicleWitness, stretch: float | None) -> tuple[Notice, ...]:
    """Warn of what may be wrong with the vehicles of a fleet.

    Args:
        vehicles: witness with vehicles.
        stretch: as in ``vehanchor.rulers.vehicle_notices.doubts``.
    """
    fleet = vehicles.fleet
    if fleet.detections.reductions is None:
        # Without a search over scales, the vehicles were not chosen by their length.
        stretch = None
    missing = detail_missing(
        vehicles.seen_length_px,
        guard_px=vehicles.guard_length_px,
        detail_share=vehicles.detail_share,
    )
    return (
        *_unlikely_guess(vehicles),
        *added_outliers(fleet),
        *missing,
        *doubts(stretch, vehicles.p_look_alikes),
    )


def _unlikely_guess(vehicles: VehicleWitness) -> tuple[Notice, ...]:
    """Warn of a reference length from the caller that the vehicles exclude."""
    mode_px = vehicles.mode_length_px
    guess_m = vehicles.reference.guess_m
    if guess_m is None or mode_px is None:
        return ()
    assert vehicles.right is not None
    low, high = credible_interval(vehicles.right)
    if low <= guess_m / mode_px <= high:
        return ()
    low_m = low * mode_px
    high_m = high * mode_px
    message = (
        f"The given reference length of {guess_m:g} m does not fit these vehicles, whose usual "
        f"length is between {low_m:.1f} and {high_m:.1f} m. It hardly changes the scale. If the "
        "fleet was measured, give its calibration."
    )
    return (Notice(code=NoticeCode.REFERENCE_LENGTH_UNLIKELY, message=message),)


def vehicle_witness(witnesses: Iterable[Witness]) -> VehicleWitness | None:
    """Find the witness of the vehicles; None if the caller excludes them."""
    for witness in witnesses:
        if witness.kind == Vehicles.kind:
            return cast("VehicleWitness", witness)
    return None
