"""The reference length ``L_ref``: the modal vehicle length in metres, and its source."""

from __future__ import annotations

from difflib import get_close_matches
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import InvalidParameterError
from vehanchor.scale.countries import COUNTRY_REGIONS, country_length

if TYPE_CHECKING:
    from vehanchor.detection.appearance import FleetAppearance
    from vehanchor.detection.card import DetectorCard
    from vehanchor.options import Reference
    from vehanchor.records import ReferenceSource

_SMALLER_LOG_SD = 0.12  # towards smaller cars: six unseen fleets were read 5 to 17 % too long, rendered 3.7 m 12 %
_LEFT_IN_REGION = 0.85  # 95 of 100 intervals hold the truth on the held-out tenth of train; 86 with 0.5


class ReferenceLength(NamedTuple):
    """Reference length of one image.

    Attributes:
        length_m: metres.
        sd_m: its standard deviation between places, metres.
        source: source of the length.
        smaller_sd_m: its standard deviation towards smaller cars, metres; None for the same.
        sampling_log_sd: standard error of its log from the spread of the vehicles' appearance, which more vehicles
            reduce.
    """

    length_m: float
    sd_m: float
    source: ReferenceSource
    smaller_sd_m: float | None = None
    sampling_log_sd: float = 0.0

    @property
    def log_sds(self) -> tuple[float, float]:
        """Standard deviations of its log, towards smaller and towards larger cars."""
        larger = self.sd_m / self.length_m
        return larger if self.smaller_sd_m is None else self.smaller_sd_m / self.length_m, larger


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
        return ReferenceLength(measured.reference_length_m, measured.reference_length_sd_m, "calibration")
    if given.reference_length_m is not None:
        return ReferenceLength(given.reference_length_m, card.reference_length_sd_m / 2, "given")
    if given.region is not None:
        length_m = _region_length(given.region, card)
        return ReferenceLength(length_m, _LEFT_IN_REGION * card.reference_length_sd_m, "region")
    if card.fleet_lengths is not None and appearance is not None:
        length_m = card.fleet_lengths.reference_length(appearance.log_lengths)
        sd_m = card.fleet_lengths.sd_m
        smaller_sd_m = max(_SMALLER_LOG_SD * length_m, sd_m)
        sampling = (
            card.fleet_lengths.sampling_log_sd(appearance.log_lengths) if len(appearance.log_lengths) > 1 else 0.0
        )
        return ReferenceLength(length_m, sd_m, "appearance", smaller_sd_m, sampling)
    return ReferenceLength(card.reference_length_m, card.reference_length_sd_m, "model")


def _region_length(name: str, card: DetectorCard) -> float:
    """Look up the reference length of a region or country, metres."""
    known = card.region_lengths_m
    length_m = known.get(name.lower()) or country_length(name, known)
    if length_m is not None:
        return length_m
    near = ", ".join(get_close_matches(name.lower(), known) or get_close_matches(name.upper(), COUNTRY_REGIONS))
    raise InvalidParameterError(
        f"region is {name!r}: this model knows {', '.join(sorted(known))}, and countries there by ISO code, such as FR"
        f"{near and f' (nearest: {near})'}; or give reference_length_m"
    )
