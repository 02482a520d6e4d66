"""The reference length ``L_ref``: the modal vehicle length in metres, and its source."""

from __future__ import annotations

import math
from dataclasses import replace
from difflib import get_close_matches
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import InvalidParameterError
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.scale.countries import (
    COUNTRIES,
    COUNTRY_REGIONS,
    country_code,
    country_length,
    uses_published_mean,
)
from vehanchor.scale.reliability import KNOWN_REGION

if TYPE_CHECKING:
    from collections.abc import Mapping

    from vehanchor.detection.card import BodyLengths, DetectorCard
    from vehanchor.detection.detections import Appearance
    from vehanchor.detection.detector_errors import AppearanceErrors
    from vehanchor.options import Reference
    from vehanchor.records import ReferenceSource

# Share of the model's spread that remains if the caller's length replaces it. A choice.
_KNOWN_LENGTH = 0.5
# Number of cars of the usual length that stand for those out of sight: about (0.09 / 0.06)**2, the
# squared ratio of the spreads of log lengths within fleets and between them.
_USUAL_CARS = 2.0


class ReferenceLength(NamedTuple):
    """Reference length of one image.

    Attributes:
        length_m: metres.
        source: source of the length.
        log_sd: standard deviation of its log between places.
        log_mean: mean error of its log.
        by_appearance: log of the factor on the vehicles' lengths by their appearance; None if the
            lengths by appearance are not used.
        guess_m: length that the caller states without a calibration, metres; None without one. It
            is a guess beside this length.
    """

    length_m: float
    source: ReferenceSource
    log_sd: float
    log_mean: float = 0.0
    by_appearance: float | None = None
    guess_m: float | None = None

    @property
    def stated_m(self) -> float:
        """``L_ref`` of the record, metres: the caller's, or else this length."""
        return self.length_m if self.guess_m is None else self.guess_m

    @property
    def stated_source(self) -> ReferenceSource:
        """Source of ``stated_m``."""
        return self.source if self.guess_m is None else "given"

    def in_known_region(self, card: DetectorCard) -> ReferenceLength:
        """Narrow the length as a region would whose cars have this length."""
        if self.by_appearance is None or card.bodies is None:
            return self._replace(log_sd=KNOWN_REGION * self.log_sd)
        bodies = card.bodies
        region_log_sd = KNOWN_REGION * bodies.reference_length_sd_m / bodies.reference_length_m
        precision = self.log_sd**-2 + region_log_sd**-2
        return self._replace(log_sd=precision**-0.5)


def reference_length(
    card: DetectorCard,
    reference: Reference,
    appearance: Appearance | None,
    *,
    n_cars: float = math.inf,
    trusts_caller: bool = False,
) -> ReferenceLength:
    """Choose the length of a calibration, else the fleet's by appearance, else the model's.

    A length that the caller states without a calibration is a guess beside it. Of the spread
    between regions, a region leaves a part, because a city differs from its region; it moves
    lengths by appearance towards its own by the precisions of both.

    Args:
        card: card of the model that found the vehicles.
        reference: the caller's options for the reference length.
        appearance: appearance of the vehicles of the fleet; None if unknown.
        n_cars: expected number of cars in the fleet; few cars err more by their appearance.
        trusts_caller: whether a length of the caller replaces all others, as in the paper.

    Returns:
        The length, its spread and its source.

    Raises:
        InvalidParameterError: the region is neither of the model nor a country.
        CalibrationMismatchError: the calibration was made for another model.
    """
    calibration = reference.calibration
    if calibration is not None:
        calibration.check_detector(card.name, card.sha256)
        length_m = calibration.reference_length_m
        log_sd = calibration.reference_length_sd_m / length_m
        return ReferenceLength(length_m, "calibration", log_sd)
    sd_m = card.reference_length_sd_m
    guess_m = reference.reference_length_m
    if guess_m is not None:
        if trusts_caller:
            log_sd = _KNOWN_LENGTH * sd_m / guess_m
            return ReferenceLength(guess_m, "given", log_sd)
        without_guess = replace(reference, reference_length_m=None)
        length = reference_length(card, without_guess, appearance, n_cars=n_cars)
        return length._replace(guess_m=guess_m)
    if card.bodies is not None and appearance is not None:
        errors = card.errors.appearance
        return _by_appearance(
            card.bodies,
            appearance,
            errors=errors,
            log_sd=errors.fleet_log_sd(n_cars, _work_share(appearance)),
            region=reference.region,
        )
    if reference.region is not None:
        region_length_m = _region_length(reference.region, _box_lengths_m(card))
        if region_length_m is not None:
            log_sd = KNOWN_REGION * sd_m / region_length_m
            return ReferenceLength(region_length_m, "region", log_sd)
    length_m = card.reference_length_m
    return ReferenceLength(length_m, "model", sd_m / length_m)


def _work_share(appearance: Appearance) -> float:
    """Compute the expected share of work vehicles in a fleet; 0 if nobody has looked for them."""
    if appearance.work_chances is None or len(appearance) == 0:
        return 0.0
    return float(appearance.work_chances.mean())


def _box_lengths_m(card: DetectorCard) -> Mapping[str, float]:
    """Collect the lengths of boxes by region; lengths of bodies stand in for missing regions."""
    lengths_m: dict[str, float] = {}
    if card.bodies is not None:
        lengths_m.update(card.bodies.region_lengths_m)
    lengths_m.update(card.region_lengths_m)
    return lengths_m


def _by_appearance(
    bodies: BodyLengths,
    appearance: Appearance,
    *,
    errors: AppearanceErrors,
    log_sd: float,
    region: str | None,
) -> ReferenceLength:
    """Read the reference length from appearances, and move it towards that of a region.

    Args:
        bodies: lengths of vehicle bodies, to which appearances refer.
        appearance: appearance of the vehicles of the fleet.
        errors: errors of a fleet's mean length by appearance.
        log_sd: standard deviation of its log, for the fleet's number of cars.
        region: name of a region or country; None if unknown.

    Raises:
        InvalidParameterError: there is no such region or country.
    """
    log_length = float(appearance.log_lengths.mean())
    region_length_m = None
    if region is not None:
        region_length_m = _region_length(region, bodies.region_lengths_m)
    if region_length_m is None:
        return ReferenceLength(
            math.exp(log_length),
            "appearance",
            log_sd=log_sd,
            log_mean=errors.log_mean,
            by_appearance=0.0,
        )
    # The region is about the whole fleet. Cars out of sight are taken to have the usual length, so
    # that few unusual cars do not count as an unusual fleet.
    n = len(appearance)
    usual_log_length = math.log(bodies.reference_length_m)
    log_total = n * log_length + _USUAL_CARS * usual_log_length
    fleet_log_length = log_total / (n + _USUAL_CARS)

    # Precision-weighted mean of both lengths: variances of the appearance and within the region.
    region_log_sd = KNOWN_REGION * bodies.reference_length_sd_m / bodies.reference_length_m
    variance = log_sd**2
    region_share = variance / (variance + region_log_sd**2)
    moved = region_share * (math.log(region_length_m) - fleet_log_length)
    return ReferenceLength(
        math.exp(log_length + moved),
        "region",
        log_sd=math.sqrt(1 - region_share) * log_sd,
        log_mean=(1 - region_share) * errors.log_mean,
        by_appearance=moved,
    )


def unmeasured_region(card: DetectorCard, reference: Reference) -> tuple[Notice, ...]:
    """Warn of a country whose cars nobody has measured: the vehicles do without it."""
    region = reference.region
    if region is None or _region_length(region, _box_lengths_m(card)) is not None:
        return ()
    message = (
        f"Nobody has measured the cars of {region}: their lengths are those of an unknown region, "
        "and there is nothing to do about it. Things of known size there keep their sizes."
    )
    return (Notice(code=NoticeCode.REGION_UNMEASURED, message=message),)


def country_in_words(card: DetectorCard, reference: Reference) -> str | None:
    """State where the usual length of a country's cars is from, in a sentence.

    Returns:
        None without a country, and for one whose cars nobody has measured.
    """
    region = reference.region
    lengths_m = _box_lengths_m(card)
    if region is None or _own_region_length(region, lengths_m) is not None:
        return None
    code = country_code(region)
    if code is None or country_length(code, lengths_m) is None:
        return None
    if uses_published_mean(code, lengths_m):
        return f"The usual length of cars in {code} is from a published mean."
    return f"Cars in {code} are taken to be as long as those measured in {COUNTRY_REGIONS[code]}."


def _own_region_length(name: str, lengths_m: Mapping[str, float]) -> float | None:
    """Look up the length of a region of the model, by its name in any spelling."""
    words = _spaced(name).split()
    return lengths_m.get("_".join(words))


def _spaced(name: str) -> str:
    """Write the name of a place in lower case, with blanks between its words."""
    return name.lower().replace("_", " ").replace("-", " ")


def _region_length(name: str, lengths_m: Mapping[str, float]) -> float | None:
    """Look up the reference length of a region or country.

    Args:
        name: name of a region or country in any spelling, or code of a country.
        lengths_m: reference lengths by region, metres.

    Returns:
        Metres; None for a country whose cars nobody has measured.

    Raises:
        InvalidParameterError: there is no such place; the message names the nearest ones.
    """
    length_m = _own_region_length(name, lengths_m)
    if length_m is not None:
        return length_m
    code = country_code(name)
    if code is not None:
        return country_length(code, lengths_m)
    nearest = get_close_matches(_spaced(name), _place_names(lengths_m))
    hint = f" (nearest: {', '.join(nearest)})" if nearest else ""
    regions = ", ".join(sorted(lengths_m))
    raise InvalidParameterError(
        f"region is {name!r}: this model knows {regions}, and every country by its English name or "
        f"ISO code, such as FR{hint}. If the place is unknown, leave region out"
    )


def _place_names(lengths_m: Mapping[str, float]) -> list[str]:
    """List the names of regions and countries."""
    names = list(lengths_m)
    for country in COUNTRIES.values():
        names += country.names
    return names
