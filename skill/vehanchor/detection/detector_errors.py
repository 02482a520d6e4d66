"""Errors of a detector and of its auxiliary models, measured on images of known scale.

They stand in ``<stem>.errors.toml`` beside the detector's file. Numbers that this file does not
state have the defaults of the classes below. These are the numbers of the bundled detector, each a
choice for any other one, except for the spread of one car's box: nobody has measured it, so that
the default is the upper end of the bundled detector's range by place.
"""

from __future__ import annotations

import hashlib
import json
import math
import tomllib
from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from vehanchor.errors import ModelContractError

if TYPE_CHECKING:
    from pathlib import Path

_MAX_FILE_BYTES = 1 << 20
# The smallest spread: its square must not vanish in a denominator.
_MIN_SD = 0.001

_Spread = Annotated[float, Field(ge=_MIN_SD, le=2.0)]
_Chance = Annotated[float, Field(ge=0.0, le=1.0)]
_Ratio = Annotated[float, Field(ge=1.0, le=10.0)]
_LogOdds = Annotated[float, Field(ge=-50.0, le=50.0)]
# Limit or spread of differences of logits.
_Difference = Annotated[float, Field(ge=_MIN_SD, le=50.0)]


class _Errors(BaseModel):
    """Frozen record of finite numbers; a field that does not exist is refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class BoxErrors(_Errors):
    """Errors of the detector's boxes.

    Attributes:
        length_over_width: proportions of boxes at nadir.
        log_sd: standard deviation of the log length of one car's box around its fleet, if its
            appearance is not used.
        log_size_sd: standard deviation of the log of the square root of box areas within one fleet.
    """

    length_over_width: _Ratio = 2.21
    log_sd: _Spread = 0.145
    log_size_sd: _Spread = 0.11


class VehicleErrors(_Errors):
    """Errors of all vehicles of an image as a ruler.

    Attributes:
        chance_wrong: chance that the vehicles do not show the scale; used with calibrated votes.
        coarse_log_sd: standard deviation of the log scale of too coarse vehicles, per log of their
            coarseness.
        coarse_chance_wrong: chance that their scale is wrong, per log of their coarseness.
    """

    chance_wrong: _Chance = 0.01
    coarse_log_sd: Annotated[float, Field(ge=0.0, le=2.0)] = 0.5
    coarse_chance_wrong: _Chance = 0.33


class VoteOdds(_Errors):
    """Log odds that a box is a car, by its score; see ``vehanchor.scale.density.Votes``.

    Attributes:
        at_zero: log odds at a score of 0.
        slope: their increase from score 0 to 1.
    """

    at_zero: _LogOdds
    slope: Annotated[float, Field(ge=0.0, le=100.0)]


class AppearanceErrors(_Errors):
    """Errors of the chip network.

    Attributes:
        length_over_width: proportions of bodies at nadir.
        log_sd: standard deviation, between places, of the log of a fleet's length by its
            appearance.
        log_mean: mean error of that log.
        kind_log_sd: further standard deviation of that log for a fleet of one kind of car, such as
            golf carts. It falls with the number of cars, which are of more and more kinds.
        kind_cars: number of cars at which half of the variance of ``kind_log_sd`` is left.
        work_log_sd: standard deviation that is added to ``kind_log_sd``, as independent errors add,
            if all vehicles are vans, lorries or other work vehicles; of fewer, in proportion.
        scatter_cars: number of cars that stand for the usual scatter of lengths by appearance; the
            more it is, the less a larger scatter widens the fleet's error.
        fair_odds: odds of a car at which its length by appearance errs as the network states.
        doubt_power: power of that error at other odds.
    """

    length_over_width: _Ratio = 2.6
    log_sd: _Spread = 0.055
    log_mean: Annotated[float, Field(ge=-1.0, le=1.0)] = -0.015
    kind_log_sd: Annotated[float, Field(ge=0.0, le=2.0)] = 0.06
    kind_cars: Annotated[float, Field(ge=0.1, le=1000.0)] = 2.0
    work_log_sd: Annotated[float, Field(ge=0.0, le=2.0)] = 0.28
    scatter_cars: Annotated[float, Field(ge=0.1, le=1000.0)] = 10.0
    fair_odds: Annotated[float, Field(ge=0.001, le=1e6)] = 20.0
    doubt_power: Annotated[float, Field(ge=0.0, le=2.0)] = 0.125

    def fleet_log_sd(self, n_cars: float, work_share: float = 0.0) -> float:
        """Compute the error of a fleet's log length by appearance.

        Args:
            n_cars: expected number of cars in the fleet.
            work_share: expected share of vans, lorries and other work vehicles among them, 0..1.
        """
        kind_share = self.kind_cars / (self.kind_cars + n_cars)
        of_one_kind = math.hypot(self.kind_log_sd, self.work_log_sd * work_share)
        return math.hypot(self.log_sd, of_one_kind * math.sqrt(kind_share))


class SpreadErrors(_Errors):
    """Usual spreads of one measurement of the vehicles of an image.

    Attributes:
        cars: median standard deviation among cars.
        cars_log_sd: standard deviation of its log between images.
        things: median standard deviation among equal things.
        things_log_sd: standard deviation of its log between images.
    """

    cars: Annotated[float, Field(ge=_MIN_SD, le=255.0)]
    cars_log_sd: _Spread
    things: Annotated[float, Field(ge=_MIN_SD, le=255.0)]
    things_log_sd: _Spread


class HeadingErrors(_Errors):
    """How much the lengths of the vehicles of an image depend on their directions.

    Attributes:
        cars: standard deviation, between images, of the amplitude in the log lengths of cars.
        things: the same for things whose boxes include their shadow.
        spread: median standard deviation of the log lengths around that trend.
        spread_log_sd: standard deviation of its log between images.
    """

    cars: _Spread = 0.02
    things: _Spread = 0.15
    spread: _Spread = 0.09
    spread_log_sd: _Spread = 0.5


class ProportionErrors(_Errors):
    """Proportions of the bodies of an image, relative to those in ``AppearanceErrors``.

    Attributes:
        image_sd: standard deviation of the mean log of length over width between images of cars.
        vehicle_sd: standard deviation of that log within an image.
        outliers: share of images of cars whose mean is something else.
        outlier_sd: its standard deviation there.
        things: length over width of small vehicles that are not cars.
        things_log_sd: standard deviation of the mean log between images of these.
    """

    image_sd: _Spread = 0.03
    vehicle_sd: _Spread = 0.055
    outliers: _Chance = 0.002
    outlier_sd: _Spread = 0.25
    things: _Ratio = 2.34
    things_log_sd: _Spread = 0.12


class EndErrors(_Errors):
    """Spread of the colours of bodies near one end, given that near the other end.

    Attributes:
        cars: median spread among cars, in CIELAB from 0 to 255.
        shared: how far the log of that spread follows the log of the one near the other end, 0..1.
        log_sd: standard deviation of the rest between images of many cars.
        vehicle_log_sd: what a single vehicle adds, as independent errors add; less with more.
        outliers: share of images of cars with any other spread.
        outlier_log_sd: standard deviation of its log there.
        things: median spread near an end that is a shadow.
        things_log_sd: standard deviation of its log between images.
        things_vehicle_log_sd: what a single vehicle adds.
    """

    cars: Annotated[float, Field(ge=_MIN_SD, le=255.0)] = 45.0
    shared: _Chance = 0.5
    log_sd: _Spread = 0.45
    vehicle_log_sd: Annotated[float, Field(ge=0.0, le=10.0)] = 1.73
    outliers: _Chance = 0.01
    outlier_log_sd: _Spread = 1.56
    things: Annotated[float, Field(ge=_MIN_SD, le=255.0)] = 5.0
    things_log_sd: _Spread = 0.45
    things_vehicle_log_sd: Annotated[float, Field(ge=0.0, le=10.0)] = 0.71


class LookAlikeErrors(_Errors):
    """How equal things that are not cars differ from cars; see ``vehanchor.rulers.look_alikes``.

    Attributes:
        log_odds: log odds of look-alikes for a single vehicle with the mean logit of cars.
        log_odds_per_log_n: their rise per log of the number of vehicles, which saturates:
            look-alikes come in numbers.
        spread_power: power of the evidence from spreads, directions, proportions and ends.
        lengths: spread of the log lengths.
        appearance: spread of the log lengths by appearance.
        tones: spread of the colours of bodies, the root of the summed variances in CIELAB.
        headings: dependence of the lengths on the directions.
        proportions: length over width of bodies.
        ends: spread of the colours near both ends of bodies.
        mean_logit: mean logit of the chip network over cars.
        log_odds_per_logit: log odds of look-alikes per logit below that mean.
        logit_half_n: number of vehicles at which their mean logit counts half.
    """

    log_odds: _LogOdds = -13.0
    log_odds_per_log_n: Annotated[float, Field(ge=0.0, le=10.0)] = 3.5
    spread_power: Annotated[float, Field(ge=0.0, le=2.0)] = 1.6
    lengths: SpreadErrors = SpreadErrors(
        cars=0.106, cars_log_sd=0.3, things=0.04, things_log_sd=0.5
    )
    appearance: SpreadErrors = SpreadErrors(
        cars=0.07, cars_log_sd=0.33, things=0.035, things_log_sd=0.5
    )
    tones: SpreadErrors = SpreadErrors(cars=41.0, cars_log_sd=0.45, things=8.0, things_log_sd=0.9)
    headings: HeadingErrors = HeadingErrors()
    proportions: ProportionErrors = ProportionErrors()
    ends: EndErrors = EndErrors()
    mean_logit: _LogOdds = 3.4
    log_odds_per_logit: Annotated[float, Field(ge=0.0, le=50.0)] = 10.0
    logit_half_n: Annotated[float, Field(ge=0.0, le=100_000.0)] = 4.0


class StretchLimits(_Errors):
    """Limits from which the networks' preference for other proportions shows a stretched image.

    Attributes:
        vehicle_sd: least standard deviation of the verifier's preferences of single vehicles.
        image_sd: standard deviation of their mean between images of true proportions.
        limit_sds: standard deviations of the mean from which an image is stretched.
        few_parallel_limit: preference of the chip network from which an image with few parallel
            vehicles is stretched.
        few_crossed_limit: the same for vehicles that are not parallel.
    """

    vehicle_sd: _Difference = 0.7
    image_sd: _Difference = 0.55
    limit_sds: _Difference = 2.75
    few_parallel_limit: _Difference = 0.7
    few_crossed_limit: _Difference = 0.28


class StretchOdds(_Errors):
    """Distribution of the networks' preference for a narrower image over a wider one.

    Attributes:
        mean: mean preference of a vehicle at 45 degrees, in an image of true proportions.
        mean_along: what is added for one along the rows, and subtracted for one along the columns.
        vehicle_sd: standard deviation of one vehicle's preference at 45 degrees.
        vehicle_sd_along: what is added to it for one along the rows or the columns, whose length
            alone changes.
        image_sd: standard deviation of the mean preference between images.
        shift: shift of the mean by a stretch of 1.25 to 1.6.
        shift_sd: standard deviation of that shift.
        outliers: share of images of true proportions whose vehicles are something else.
        outlier_sd: standard deviation of their mean preference.
    """

    mean: float = 0.637
    mean_along: float = 0.933
    vehicle_sd: _Difference = 1.92
    vehicle_sd_along: _Difference = 1.293
    image_sd: _Difference = 0.661
    shift: _Difference = 7.745
    shift_sd: _Difference = 2.757
    outliers: _Difference = 0.03
    outlier_sd: _Difference = 9.0


class TilePriorOdds(_Errors):
    """Odds that a part of an image shows cars, by its edges; the search begins where they are high.

    Attributes:
        log_odds_at_one: log odds at a mean gradient of 1 grey level per pixel.
        log_odds_slope: their slope over the log of the gradient.
    """

    log_odds_at_one: _LogOdds = -7.2
    log_odds_slope: _LogOdds = 3.08


class DetectorErrors(_Errors):
    """Errors of a detector and of its auxiliary models.

    Attributes:
        boxes: errors of the detector's boxes.
        vehicles: errors of all vehicles of an image as a ruler.
        votes: odds that its boxes are cars, in place of those in the model's metadata; None for
            these.
        appearance: errors of the chip network.
        look_alikes: how equal things that are not cars differ from cars.
        stretch: limits from which the networks show a stretched image.
        stretch_odds: how the networks' preferences are distributed.
        tile_prior: odds that a part of an image shows cars.
    """

    boxes: BoxErrors = BoxErrors()
    vehicles: VehicleErrors = VehicleErrors()
    votes: VoteOdds | None = None
    appearance: AppearanceErrors = AppearanceErrors()
    look_alikes: LookAlikeErrors = LookAlikeErrors()
    stretch: StretchLimits = StretchLimits()
    stretch_odds: StretchOdds = StretchOdds()
    tile_prior: TilePriorOdds = TilePriorOdds()

    @property
    def sha256(self) -> str:
        """SHA-256 of the numbers, whatever file states them."""
        numbers = json.dumps(self.model_dump(), sort_keys=True)
        return hashlib.sha256(numbers.encode()).hexdigest()

    def length_over_width(self, *, of_bodies: bool) -> float:
        """Return the proportions of the boxes of bodies, or of the detector's own boxes."""
        if of_bodies:
            return self.appearance.length_over_width
        return self.boxes.length_over_width


def read_detector_errors(path: Path) -> DetectorErrors:
    """Read a file of errors; numbers that it does not state have their defaults.

    Raises:
        ModelContractError: the file cannot be read, or a number is invalid; the message names it.
    """
    try:
        with path.open("rb") as stream:
            content = stream.read(_MAX_FILE_BYTES + 1)
    except OSError as error:
        raise _refusal(path, f"it cannot be read ({error.strerror})") from None
    if len(content) > _MAX_FILE_BYTES:
        raise _refusal(path, f"it is larger than {_MAX_FILE_BYTES} bytes")
    try:
        table = tomllib.loads(content.decode())
    # Too many brackets raise the last one; the others are ValueErrors.
    except (ValueError, RecursionError) as error:
        raise _refusal(path, f"it is not TOML ({error})") from None
    try:
        return DetectorErrors.model_validate(table)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(map(str, first["loc"]))
        raise _refusal(path, f"{field}: {first['msg']}") from None


def _refusal(path: Path, problem: str) -> ModelContractError:
    """Create the error of a file that does not state a detector's errors."""
    return ModelContractError(
        f"the detector's errors in {path} cannot be used: {problem}. Correct the file, or remove "
        "it to use the defaults"
    )
