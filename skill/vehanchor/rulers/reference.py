"""The reference length ``L_ref``: the modal vehicle length in metres, and its source."""

from __future__ import annotations

import math
from difflib import get_close_matches
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import InvalidParameterError
from vehanchor.scale.countries import COUNTRY_CODES, COUNTRY_REGIONS, country_length
from vehanchor.scale.reliability import FLEETS, KNOWN_REGION

if TYPE_CHECKING:
    from vehanchor.detection.appearance import FleetAppearance
    from vehanchor.detection.card import DetectorCard
    from vehanchor.options import Reference
    from vehanchor.records import ReferenceSource


_KNOWN_LENGTH = 0.5  # share of the spread that a length from the caller leaves; a choice


class ReferenceLength(NamedTuple):
    """Reference length of one image.

    Attributes:
        length_m: metres.
        source: source of the length.
        errors: of its log, a mixture of normals: weight, mean and standard deviation of each.
        sampling_log_sd: standard error of its log from the spread of the vehicles' appearance, which more vehicles
            reduce.
    """

    length_m: float
    source: ReferenceSource
    errors: tuple[tuple[float, float, float], ...]
    sampling_log_sd: float = 0.0

    @classmethod
    def of(cls, length_m: float, sd_m: float, source: ReferenceSource) -> ReferenceLength:
        """Make a reference length with a standard deviation between places, metres."""
        return cls(length_m, source, ((1.0, 0.0, sd_m / length_m),))

    @property
    def log_sd(self) -> float:
        """Standard deviation of its log between places."""
        mean = sum(weight * mean for weight, mean, _ in self.errors)
        return math.sqrt(sum(weight * (sd**2 + (each - mean) ** 2) for weight, each, sd in self.errors))


def reference_length(card: DetectorCard, given: Reference, appearance: FleetAppearance | None) -> ReferenceLength:
    """Choose the caller's reference length, else the fleet's by appearance, else the model's.

    A length from the caller removes half of the spread between regions. A region removes less, because a city differs
    from its region.

    Args:
        card: of the model that found the vehicles.
        given: source chosen by the caller.
        appearance: appearance of the vehicles; None if unknown.

    Returns:
        The length, its spread and its source.

    Raises:
        InvalidParameterError: the model knows neither the region nor the country.
        CalibrationMismatchError: the calibration was made for another model.
    """
    if given.calibration is not None:
        given.calibration.check_detector(card.name, card.sha256)
        measured = given.calibration
        return ReferenceLength.of(measured.reference_length_m, measured.reference_length_sd_m, "calibration")
    if given.reference_length_m is not None:
        return ReferenceLength.of(given.reference_length_m, _KNOWN_LENGTH * card.reference_length_sd_m, "given")
    if given.region is not None:
        length_m = _region_length(given.region, card)
        return ReferenceLength.of(length_m, KNOWN_REGION * card.reference_length_sd_m, "region")
    if card.fleet_lengths is not None and appearance is not None:
        length_m = card.fleet_lengths.reference_length(appearance.log_lengths)
        sampling = (
            card.fleet_lengths.sampling_log_sd(appearance.log_lengths) if len(appearance.log_lengths) > 1 else 0.0
        )
        return ReferenceLength(length_m, "appearance", FLEETS, sampling)
    return ReferenceLength.of(card.reference_length_m, card.reference_length_sd_m, "model")


def _region_length(name: str, card: DetectorCard) -> float:
    """Look up the reference length of a region or country, metres."""
    known, plain = card.region_lengths_m, " ".join(name.lower().replace("_", " ").replace("-", " ").split())
    length_m = known.get(plain.replace(" ", "_")) or country_length(COUNTRY_CODES.get(plain, name), known)
    if length_m is not None:
        return length_m
    near = ", ".join(get_close_matches(name.lower(), known) or get_close_matches(name.upper(), COUNTRY_REGIONS))
    raise InvalidParameterError(
        f"region is {name!r}: this model knows {', '.join(sorted(known))}, and countries there by name or ISO code, "
        f"such as FR{near and f' (nearest: {near})'}. For another place, leave region out"
    )
