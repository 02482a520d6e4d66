"""The reference length ``L_ref``: the modal vehicle length in metres, and its source."""

from __future__ import annotations

import math
from difflib import get_close_matches
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import InvalidParameterError
from vehanchor.scale.countries import COUNTRY_CODES, COUNTRY_REGIONS, country_length
from vehanchor.scale.reliability import APPEARANCE_LOG_MEAN, APPEARANCE_LOG_SD, KNOWN_REGION

if TYPE_CHECKING:
    from collections.abc import Mapping

    from vehanchor.detection.card import BodyLengths, DetectorCard
    from vehanchor.detection.detections import Appearance
    from vehanchor.options import Reference
    from vehanchor.records import ReferenceSource


_KNOWN_LENGTH = 0.5  # share of the spread that a length from the caller leaves; a choice
# cars of the usual length that stand for those which are not in sight: (0.09 / 0.06)**2, the
# spreads
_USUAL_CARS = 2.0
# of lengths within fleets and between them


class ReferenceLength(NamedTuple):
    """Reference length of one image.

    Attributes:
        length_m: metres.
        source: source of the length.
        log_sd: standard deviation of its log between places.
        log_mean: mean error of its log.
        by_appearance: log of the factor on the vehicles' lengths by their appearance; None if these
            are not used.
    """

    length_m: float
    source: ReferenceSource
    log_sd: float
    log_mean: float = 0.0
    by_appearance: float | None = None


def reference_length(
    card: DetectorCard, given: Reference, appearance: Appearance | None
) -> ReferenceLength:
    """Choose the caller's reference length, else the fleet's by appearance, else the model's.

    A length from the caller removes half of the spread between regions. A region removes less,
    because a city differs from its region; it moves lengths by appearance towards its own by the
    precisions of both.

    Args:
        card: of the model that found the vehicles.
        given: source chosen by the caller.
        appearance: of the vehicles of the fleet; None if unknown.

    Returns:
        The length, its spread and its source.

    Raises:
        InvalidParameterError: the model knows neither the region nor the country.
        CalibrationMismatchError: the calibration was made for another model.
    """
    if given.calibration is not None:
        given.calibration.check_detector(card.name, card.sha256)
        length_m = given.calibration.reference_length_m
        sd_m = given.calibration.reference_length_sd_m
        return ReferenceLength(length_m, "calibration", sd_m / length_m)
    sd_m = card.reference_length_sd_m
    if given.reference_length_m is not None:
        return ReferenceLength(
            given.reference_length_m, "given", _KNOWN_LENGTH * sd_m / given.reference_length_m
        )
    if card.bodies is not None and appearance is not None:
        return _by_appearance(card.bodies, appearance, given.region)
    if given.region is not None:
        # where nobody measured boxes
        of_bodies = {} if card.bodies is None else card.bodies.region_lengths_m
        length_m = _region_length(given.region, {**of_bodies, **card.region_lengths_m})
        return ReferenceLength(length_m, "region", KNOWN_REGION * sd_m / length_m)
    return ReferenceLength(card.reference_length_m, "model", sd_m / card.reference_length_m)


def _by_appearance(
    bodies: BodyLengths, appearance: Appearance, region: str | None
) -> ReferenceLength:
    """Read the reference length from appearances, and move it towards that of a region."""
    log_length = float(appearance.log_lengths.mean())
    if region is None:
        return ReferenceLength(
            math.exp(log_length),
            "appearance",
            log_sd=APPEARANCE_LOG_SD,
            log_mean=APPEARANCE_LOG_MEAN,
            by_appearance=0.0,
        )
    usual = math.log(bodies.reference_length_m)
    fleet = (len(appearance) * log_length + _USUAL_CARS * usual) / (len(appearance) + _USUAL_CARS)
    spread = KNOWN_REGION * bodies.reference_length_sd_m / bodies.reference_length_m
    share = APPEARANCE_LOG_SD**2 / (APPEARANCE_LOG_SD**2 + spread**2)
    moved = share * (math.log(_region_length(region, bodies.region_lengths_m)) - fleet)
    log_sd = math.sqrt(1 - share) * APPEARANCE_LOG_SD
    log_mean = (1 - share) * APPEARANCE_LOG_MEAN
    return ReferenceLength(
        math.exp(log_length + moved),
        "region",
        log_sd=log_sd,
        log_mean=log_mean,
        by_appearance=moved,
    )


def _region_length(name: str, known: Mapping[str, float]) -> float:
    """Look up the reference length of a region or country, metres."""
    plain = " ".join(name.lower().replace("_", " ").replace("-", " ").split())
    length_m = known.get(plain.replace(" ", "_")) or country_length(
        COUNTRY_CODES.get(plain, name), known
    )
    if length_m is not None:
        return length_m
    near = ", ".join(
        get_close_matches(name.lower(), known) or get_close_matches(name.upper(), COUNTRY_REGIONS)
    )
    raise InvalidParameterError(
        f"region is {name!r}: this model knows {', '.join(sorted(known))}, and countries there "
        "by name or ISO code, "
        f"such as FR{near and f' (nearest: {near})'}. For another place, leave region out"
    )
