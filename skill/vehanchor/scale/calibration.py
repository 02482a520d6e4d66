"""Fleet calibration: ``L_ref`` of a region's fleet, measured on images of known scale.

The paper's calibration (section III-F) computes ``L_i = P_i * GSD_i`` for every vehicle, and the
KDE mode of ``{L_i}``. The lengths ``P_i`` come from labels or from a detector's boxes.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple, Self, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from vehanchor.errors import (
    CalibrationFileError,
    CalibrationMismatchError,
    CalibrationRefusedError,
    InvalidParameterError,
)
from vehanchor.scale.defaults import MAX_VEHICLE_M, MIN_VEHICLE_M, SHORT_SHA
from vehanchor.scale.lengths import Spread, guard_length, kde_mode, kernel_weights, resampled_modes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Lengths: TypeAlias = NDArray[np.float64]
    """``[n]`` lengths of vehicles, pixels or metres."""

    Weights: TypeAlias = NDArray[np.float64]
    """``[n]`` weights of vehicles."""

MIN_VEHICLES = 100
"""Least number of vehicles. Lengths of one fleet spread by about 9 %, so that the mode of 100 cars
is known to 3 % (95 % interval)."""

# Side of a block. Cars in one block (a car park, a street) are similar, so that they are resampled
# together.
_BLOCK_M = 50.0
# With fewer blocks, single vehicles are resampled.
_MIN_BLOCKS = 10
_MAX_FILE_BYTES = 1 << 20

_VehicleLength = Annotated[float, Field(ge=MIN_VEHICLE_M, le=MAX_VEHICLE_M)]


class Calibration(BaseModel):
    """Reference length with its source and its detector."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    kind: Literal["vehanchor.calibration.v1"] = Field(
        default="vehanchor.calibration.v1",
        description="What this file is, and the version of its fields.",
    )
    reference_length_m: _VehicleLength = Field(
        description="L_ref: KDE mode of the vehicles' lengths, metres."
    )
    reference_length_ci95_low_m: float = Field(
        gt=0, description="Lower end of its 95 % interval (bootstrap), metres."
    )
    reference_length_ci95_high_m: float = Field(
        gt=0, description="Upper end of its 95 % interval, metres."
    )
    reference_length_sd_m: float = Field(
        ge=0,
        le=MAX_VEHICLE_M,
        description="Standard deviation used by estimates, in metres: bootstrap error, spread "
        "within the region (half of the spread between regions), and error of the images' scales.",
    )
    source: Literal["labels", "detections"] = Field(description="Origin of the measured boxes.")
    n_vehicles: int = Field(gt=0, description="Number of measured vehicles.")
    n_images: int = Field(gt=0, description="Number of images with a vehicle.")
    mode_length_px: float = Field(gt=0, description="KDE mode of the vehicles' lengths in pixels.")
    median_gsd_m_per_px: float = Field(
        gt=0, description="Median over the vehicles of their image's true scale."
    )
    detector: str | None = Field(
        description="Name of the calibration's detector; null for any detector (labels alone)."
    )
    detector_sha256: str | None = Field(description="SHA-256 of that detector's file.")

    @model_validator(mode="after")
    def _interval_holds_its_value(self) -> Self:
        low = self.reference_length_ci95_low_m
        value = self.reference_length_m
        high = self.reference_length_ci95_high_m
        if not low <= value <= high:
            raise ValueError(
                f"the 95 % interval {low:g} to {high:g} m does not hold the length {value:g} m"
            )
        if self.reference_length_sd_m > value:
            raise ValueError(
                f"the standard deviation {self.reference_length_sd_m:g} m is more than the "
                "length itself"
            )
        return self

    def check_detector(self, name: str, sha256: str) -> None:
        """Refuse another detector than the calibration's, because its boxes differ.

        Raises:
            CalibrationMismatchError: the checksums differ.
        """
        if self.detector_sha256 is not None and self.detector_sha256 != sha256:
            raise CalibrationMismatchError(
                f"the calibration was made for detector {self.detector!r} "
                f"({self.detector_sha256[:SHORT_SHA]}), not for {name!r} "
                f"({sha256[:SHORT_SHA]}): calibrate again with this detector, or use the other one"
            )


class SurveyedImage(NamedTuple):
    """Vehicles of an image of known scale.

    Attributes:
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)`` in pixels and radians.
        gsd_m_per_px: true ground sampling distance of the image.
        scores: ``[n]`` 0..1, scores of a detector with ``weighted_kde``; None for equal weights, as
            for labels.
        gsd_log_sd: standard deviation of the log of that scale; 0 if the scale is exact.
    """

    boxes: NDArray[np.float64]
    gsd_m_per_px: float
    scores: NDArray[np.float64] | None = None
    gsd_log_sd: float = 0.0


class ModalLength(NamedTuple):
    """Modal vehicle length with its uncertainty, metres.

    Attributes:
        mode_m: KDE mode of the lengths, ``L_ref``.
        low_m: lower end of its 95 % interval.
        high_m: upper end.
        sd_m: standard deviation under resampling.
    """

    mode_m: float
    low_m: float
    high_m: float
    sd_m: float


def modal_length_m(images: Sequence[SurveyedImage]) -> ModalLength:
    """Compute the KDE mode of ``L_i = P_i * GSD_i`` (paper, section III-F), with its interval.

    The bootstrap, from a fixed seed, resamples squares of 50 m on the ground with all their cars,
    because neighbouring cars are similar. With fewer than ten squares it resamples single vehicles.

    Args:
        images: images with at least one vehicle in total.

    Returns:
        The mode, its 95 % interval and its standard deviation, metres.

    Raises:
        InvalidParameterError: there is no vehicle.
    """
    lengths_m, weights, smoothing = weighted_lengths_m(images)
    mode_m = kde_mode(lengths_m, weights, smoothing=smoothing)
    block = _blocks(images)
    modes_m = resampled_modes(lengths_m, weights, smoothing=smoothing, block=block)
    low_m, high_m = np.percentile(modes_m, [2.5, 97.5])
    log_errors = np.log(modes_m / mode_m)
    log_sd = float(np.sqrt(np.mean(log_errors**2)))
    return ModalLength(
        mode_m,
        low_m=min(float(low_m), mode_m),
        high_m=max(float(high_m), mode_m),
        sd_m=log_sd * mode_m,
    )


def weighted_lengths_m(
    images: Sequence[SurveyedImage],
) -> tuple[Lengths, Weights, float]:
    """Collect the lengths of all vehicles with the parameters of their density.

    Returns:
        ``[n]`` lengths in metres, their weights ``[n]``, and the factor on the bandwidth.
    """
    by_image = [image.boxes[:, 2] * image.gsd_m_per_px for image in images]
    lengths_m = np.concatenate([np.zeros(0), *by_image])
    weights, smoothing = _weights(images, lengths_m)
    return lengths_m, weights, smoothing


def _weights(images: Sequence[SurveyedImage], lengths: Lengths) -> tuple[Weights, float]:
    """Choose each vehicle's weight and the factor on the bandwidth, as in estimates.

    Vehicles are weighted by their scores only if all images have scores.
    """
    scores = [image.scores for image in images if image.scores is not None]
    if len(scores) < len(images):
        return kernel_weights(lengths, (), "kde")
    return kernel_weights(lengths, np.concatenate(scores), "weighted_kde")


def _blocks(images: Sequence[SurveyedImage]) -> NDArray[np.intp]:
    """Number the squares of all images, and return each vehicle's number ``[n]``."""
    rows = []
    for index, image in enumerate(images):
        image_numbers = np.full(len(image.boxes), index)
        squares = image.boxes[:, :2] * image.gsd_m_per_px // _BLOCK_M
        rows.append(np.column_stack([image_numbers, squares]))
    vehicles = np.concatenate(rows)
    blocks, block = np.unique(vehicles, axis=0, return_inverse=True)
    if len(blocks) < _MIN_BLOCKS:
        return np.arange(len(vehicles), dtype=np.intp)
    return np.asarray(block.ravel(), dtype=np.intp)


def _with_vehicles(images: Sequence[SurveyedImage], source: str) -> list[SurveyedImage]:
    """Select the images with vehicles; refuse too few vehicles."""
    with_vehicles = [image for image in images if len(image.boxes)]
    n_vehicles = sum(len(image.boxes) for image in with_vehicles)
    if n_vehicles < MIN_VEHICLES:
        origin = "labelled" if source == "labels" else "found"
        raise CalibrationRefusedError(
            f"vehicles {origin} for a reference length: {n_vehicles}; at least {MIN_VEHICLES} "
            "are needed. Add images of the same region with more cars"
        )
    return with_vehicles


def _check_lengths(mode_m: float, spread_m: float) -> None:
    """Refuse implausible fleet lengths."""
    plausible = MIN_VEHICLE_M <= mode_m <= MAX_VEHICLE_M
    if not plausible or spread_m > mode_m:
        raise CalibrationRefusedError(
            f"the vehicles are {mode_m:.3g} m long (sd {spread_m:.3g} m), but fleets "
            f"are {MIN_VEHICLE_M:g} to {MAX_VEHICLE_M:g} m long. Check the images' scales, "
            "and what the labels show"
        )


def calibrate(
    images: Sequence[SurveyedImage],
    *,
    source: Literal["labels", "detections"],
    region_sd_m: float,
    min_length_px: float = 0.0,
    detector: str | None = None,
    detector_sha256: str | None = None,
) -> Calibration:
    """Measure a fleet's reference length.

    The scale errors of the images are treated as fully correlated: photographs of one flight share
    their take-off height and their lens.

    Args:
        images: vehicles and true scales.
        source: origin of the boxes.
        region_sd_m: standard deviation of reference lengths between regions, metres; half of it
            remains within one.
        min_length_px: shortest vehicle that the detector measures without bias; 0 for labels.
        detector: name of the calibration's detector; None for any.
        detector_sha256: checksum of the detector's file.

    Returns:
        The calibration, for ``ScaleOptions(calibration=...)``.

    Raises:
        CalibrationRefusedError: there are fewer than 100 vehicles, the lengths are implausible, or
            the modal length is below the resolution guard (paper, equation 6), where measured
            lengths are too short.
    """
    with_vehicles = _with_vehicles(images, source)
    # Medians over vehicles, not over images.
    counts = [len(image.boxes) for image in with_vehicles]
    gsds = [image.gsd_m_per_px for image in with_vehicles]
    gsd_log_sds = [image.gsd_log_sd for image in with_vehicles]
    median_gsd = float(np.median(np.repeat(gsds, counts)))
    gsd_log_sd = float(np.median(np.repeat(gsd_log_sds, counts)))

    length = modal_length_m(with_vehicles)
    gsd_sd_m = gsd_log_sd * length.mode_m
    spread_m = math.hypot(length.sd_m, region_sd_m / 2, gsd_sd_m)
    _check_lengths(length.mode_m, spread_m)

    lengths_px = np.concatenate([image.boxes[:, 2] for image in with_vehicles])
    weights, smoothing = _weights(with_vehicles, lengths_px)
    mode_px = kde_mode(lengths_px, weights, smoothing=smoothing)
    guard_px = guard_length(length.mode_m, min_length_px)
    if mode_px < guard_px:
        raise CalibrationRefusedError(
            f"the imagery is too coarse: vehicles are {mode_px:.1f} px long at {median_gsd:.3g} "
            f"m/px, below the resolution guard of {guard_px:.1f} px, where lengths come out too "
            f"short. Use images of {length.mode_m / guard_px:.2f} m/px or finer"
        )
    bootstrap = Spread.of_interval(length.mode_m, length.low_m, length.high_m)
    with_scale_error = bootstrap.plus(gsd_log_sd)
    low_m, high_m = with_scale_error.around(length.mode_m)
    return Calibration(
        reference_length_m=length.mode_m,
        reference_length_ci95_low_m=low_m,
        reference_length_ci95_high_m=high_m,
        reference_length_sd_m=spread_m,
        source=source,
        n_vehicles=len(lengths_px),
        n_images=len(with_vehicles),
        mode_length_px=mode_px,
        median_gsd_m_per_px=median_gsd,
        detector=detector,
        detector_sha256=detector_sha256,
    )


def load_calibration(path: str | os.PathLike[str]) -> Calibration:
    """Read a calibration file of ``vehanchor calibrate --out``.

    Raises:
        CalibrationFileError: there is no such file, or it is not a calibration; the message names
            the field.
    """
    try:
        with Path(path).open("rb") as handle:
            text = handle.read(_MAX_FILE_BYTES)
    except OSError as error:
        message = f"cannot read calibration {str(path)!r}: {error.strerror}"
        raise CalibrationFileError(message) from None
    except ValueError as error:
        # Python refuses a NUL in a file name.
        raise CalibrationFileError(f"cannot read calibration {str(path)!r}: {error}") from None
    try:
        return Calibration.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        field = ".".join(map(str, first["loc"])) or "the file"
        raise CalibrationFileError(
            f"{str(path)!r} is not a calibration ({field}: {first['msg']}); make one with "
            "'vehanchor calibrate'"
        ) from None


def as_calibration(calibration: Calibration | str | os.PathLike[str] | None) -> Calibration | None:
    """Resolve a calibration from an object or from the path of its file; see ``load_calibration``.

    Raises:
        CalibrationFileError: the file is not a calibration.
        InvalidParameterError: the argument is neither a calibration nor a path.
    """
    if isinstance(calibration, (str, os.PathLike)):
        return load_calibration(calibration)
    if calibration is not None and not isinstance(calibration, Calibration):
        raise InvalidParameterError(
            f"calibration is a {type(calibration).__name__}: give a Calibration or a path"
        )
    return calibration
