"""Fleet calibration: the reference length ``L_ref`` of a region's fleet, measured on images of known scale.

The paper's calibration (section III-F) computes ``L_i = P_i * GSD_i`` for every vehicle, and the
KDE mode of ``{L_i}``. The lengths ``P_i`` come from labels or from a detector's boxes.
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from vehanchor.errors import (
    CalibrationFileError,
    CalibrationMismatchError,
    CalibrationRefusedError,
    InvalidParameterError,
)
from vehanchor.scale.defaults import LARGEST_VEHICLE_M, LEAST_VEHICLE_M
from vehanchor.scale.lengths import Spread, guard_length, kde_mode, kernel_weights, resampled_modes

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

MIN_VEHICLES = 100
"""Least number of vehicles. Lengths of one fleet spread by about 9 %: the mode of 100 cars is known to 3 % (95 %)."""

# cars in one block (a car park, a street) are similar, so they are resampled together
_BLOCK_M = 50.0
_MIN_BLOCKS = 10  # with fewer, single vehicles are resampled
_MAX_FILE_BYTES = 1 << 20
_SHORT_SHA = 12

_VehicleLength = Annotated[float, Field(ge=LEAST_VEHICLE_M, le=LARGEST_VEHICLE_M)]


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
        le=LARGEST_VEHICLE_M,
        description="Standard deviation that an estimate reckons with, metres: of the "
        "bootstrap, and of what places of "
        "one region differ by (half of what regions differ by), and of what the images' scales "
        "may be off by.",
    )
    source: Literal["labels", "detections"] = Field(description="Whose boxes were measured.")
    n_vehicles: int = Field(gt=0, description="Vehicles measured.")
    n_images: int = Field(gt=0, description="Images with a vehicle.")
    mode_length_px: float = Field(gt=0, description="KDE mode of the vehicles' lengths in pixels.")
    median_gsd_m_per_px: float = Field(
        gt=0, description="Median over the vehicles of their image's true scale."
    )
    detector: str | None = Field(
        description="Name of the detector it is for; null where it fits any (labels alone)."
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
        """Refuse another detector than the calibration's: its boxes differ.

        Raises:
            CalibrationMismatchError: the checksums differ.
        """
        if self.detector_sha256 is not None and self.detector_sha256 != sha256:
            raise CalibrationMismatchError(
                f"the calibration was made for detector {self.detector!r} "
                f"({self.detector_sha256[:_SHORT_SHA]}), not "
                f"for {name!r} ({sha256[:_SHORT_SHA]}): calibrate again with this detector, or "
                "use the other one"
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
    """Compute the KDE mode of ``L_i = P_i * GSD_i`` (paper, section III-F) with a bootstrap interval from a fixed seed.

    The bootstrap resamples squares of 50 m on the ground with all their cars, because neighbouring
    cars are similar. With fewer than ten squares it resamples single vehicles.

    Args:
        images: images with at least one vehicle in total.

    Returns:
        The mode, its 95 % interval and its standard deviation, metres.

    Raises:
        InvalidParameterError: there is no vehicle.
    """
    metres, weights, smoothing = weighted_lengths_m(images)
    mode = kde_mode(metres, weights, smoothing=smoothing)
    modes = resampled_modes(metres, weights, smoothing=smoothing, block=_blocks(images))
    low, high = np.percentile(modes, [2.5, 97.5])
    spread = float(np.sqrt(np.mean(np.log(modes / mode) ** 2))) * mode
    return ModalLength(mode, min(float(low), mode), high_m=max(float(high), mode), sd_m=spread)


def weighted_lengths_m(
    images: Sequence[SurveyedImage],
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Collect the lengths ``[n]`` in metres, their weights ``[n]``, and the factor on the bandwidth of the density."""
    metres = np.concatenate(
        [np.zeros(0), *(image.boxes[:, 2] * image.gsd_m_per_px for image in images)]
    )
    return metres, *_weights(images, metres)


def _weights(
    images: Sequence[SurveyedImage], lengths: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Choose each vehicle's weight and the factor on the bandwidth, as in estimates with this calibration."""
    scores = [image.scores for image in images if image.scores is not None]
    weighted = len(scores) == len(images)
    return kernel_weights(
        lengths, np.concatenate(scores) if weighted else (), "weighted_kde" if weighted else "kde"
    )


def _blocks(images: Sequence[SurveyedImage]) -> NDArray[np.intp]:
    """Number the squares of all images, and return each vehicle's number ``[n]``."""
    places = np.concatenate(
        [
            np.column_stack(
                [
                    np.full(len(image.boxes), index),
                    image.boxes[:, :2] * image.gsd_m_per_px // _BLOCK_M,
                ]
            )
            for index, image in enumerate(images)
        ]
    )
    squares, block = np.unique(places, axis=0, return_inverse=True)
    return np.asarray(
        block.ravel() if len(squares) >= _MIN_BLOCKS else np.arange(len(places)), dtype=np.intp
    )


def _with_vehicles(images: Sequence[SurveyedImage], source: str) -> list[SurveyedImage]:
    """Select the images with vehicles; refuse too few vehicles."""
    with_vehicles = [image for image in images if len(image.boxes)]
    n_vehicles = sum(len(image.boxes) for image in with_vehicles)
    if n_vehicles < MIN_VEHICLES:
        found = "labelled" if source == "labels" else "found"
        raise CalibrationRefusedError(
            f"vehicles {found} for a reference length: {n_vehicles}; at least {MIN_VEHICLES} "
            "are needed. Add images of "
            "the same region with more cars"
        )
    return with_vehicles


def _check_lengths(mode_m: float, spread_m: float) -> None:
    """Refuse implausible fleet lengths."""
    if not LEAST_VEHICLE_M <= mode_m <= LARGEST_VEHICLE_M or spread_m > mode_m:
        raise CalibrationRefusedError(
            f"the vehicles are {mode_m:.3g} m long (sd {spread_m:.3g} m), as no fleet is: "
            f"{LEAST_VEHICLE_M:g} "
            f"to {LARGEST_VEHICLE_M:g} m. Check the images' scales, and what the labels are of"
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
    counts = [len(image.boxes) for image in with_vehicles]
    median_gsd = float(
        np.median(np.repeat([image.gsd_m_per_px for image in with_vehicles], counts))
    )
    truth_log_sd = float(
        np.median(np.repeat([image.gsd_log_sd for image in with_vehicles], counts))
    )
    length = modal_length_m(with_vehicles)
    spread_m = math.hypot(length.sd_m, region_sd_m / 2, truth_log_sd * length.mode_m)
    _check_lengths(length.mode_m, spread_m)
    lengths_px = np.concatenate([image.boxes[:, 2] for image in with_vehicles])
    weights, smoothing = _weights(with_vehicles, lengths_px)
    mode_px = kde_mode(lengths_px, weights, smoothing=smoothing)
    shortest_px = guard_length(length.mode_m, min_length_px)
    if mode_px < shortest_px:
        raise CalibrationRefusedError(
            f"the imagery is too coarse: vehicles are {mode_px:.1f} px long at {median_gsd:.3g} "
            "m/px, below the "
            f"resolution guard of {shortest_px:.1f} px, where lengths come out too short. Use "
            "images of "
            f"{length.mode_m / shortest_px:.2f} m/px or finer"
        )
    low_m, high_m = Spread.of_interval(*length[:3]).plus(truth_log_sd).around(length.mode_m)
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
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = error.strerror if isinstance(error, OSError) else error
        raise CalibrationFileError(f"cannot read calibration {str(path)!r}: {reason}") from None
    try:
        return Calibration.model_validate_json(text)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        raise CalibrationFileError(
            f"{str(path)!r} is not a calibration ({where}: {first['msg']}); make one with "
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
