"""Error of the estimated scale on images of known scale: the paper's Table I."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from pydantic import Field

from vehanchor.analysis.pipeline import analyse_image, checked_detector
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.detection.detections import Detections
from vehanchor.imagery.facts import ImageFacts
from vehanchor.options import Reference, ScaleOptions
from vehanchor.scale.lengths import kde_mode
from vehanchor_evaluation.dota import SMALL_VEHICLE, labelled_boxes
from vehanchor_evaluation.known_scale import FileIssue, KnownScaleImage, KnownScaleSet, naming
from vehanchor_evaluation.result_record import ResultRecord
from vehanchor_evaluation.search import SearchedImage

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detector import Detector

    Numbers: TypeAlias = NDArray[np.float64]
    """Values ``[n]``, one for each estimate."""

    OptionsOf: TypeAlias = Callable[[KnownScaleImage], ScaleOptions]
    """Function that gives the options for an image."""

# The paper calls an image with an error above 20 % a high-error image (51 of 306).
HIGH_ERROR = 0.20


@dataclass(frozen=True, eq=False)
class ScaleTrial:
    """Estimate for one image of known scale.

    Attributes:
        image: the image.
        analysis: analysis of the estimate.
        searched: its detections, for further analyses; None if they were not kept.
    """

    image: KnownScaleImage
    analysis: ScaleAnalysis
    searched: SearchedImage | None = None

    @property
    def signed_error(self) -> float:
        """Signed relative error ``(GSD - truth) / truth``; NaN without an estimate."""
        gsd = self.analysis.estimate.gsd_m_per_px
        if gsd is None:
            return math.nan
        return gsd / self.image.gsd_m_per_px - 1.0

    @property
    def error(self) -> float:
        """Absolute relative error; 1 (100 %) without an estimate."""
        if math.isnan(self.signed_error):
            return 1.0
        return abs(self.signed_error)

    @property
    def estimated(self) -> bool:
        """Whether the image has an estimate."""
        return self.analysis.estimate.gsd_m_per_px is not None

    @property
    def usable(self) -> bool:
        """Whether the scale is usable: status ok."""
        return self.analysis.estimate.status == "ok"

    @property
    def confidence(self) -> float:
        """Confidence in the scale, 0..1."""
        return self.analysis.estimate.confidence

    @property
    def covered(self) -> bool | None:
        """Whether the true scale lies in the 95 % interval; None without an estimate."""
        low = self.analysis.estimate.gsd_ci95_low_m_per_px
        high = self.analysis.estimate.gsd_ci95_high_m_per_px
        if low is None or high is None:
            return None
        return low <= self.image.gsd_m_per_px <= high


def run_trials(
    images: Iterable[KnownScaleImage],
    detector: Detector,
    options: ScaleOptions | None = None,
) -> Iterator[ScaleTrial]:
    """Estimate the scale of each image in turn."""
    options = options or ScaleOptions()
    for image in images:
        analysis = analyse_image(image.path, detector, options)
        yield ScaleTrial(image, analysis)


class ErrorSummary(NamedTuple):
    """Columns of the paper's Table I.

    Attributes:
        images: number of images.
        coverage: share with an estimate.
        median: median absolute relative error.
        mean: mean absolute relative error.
        within_10: share of errors below 10 %.
        within_20: share of errors below 20 %.
        bias: median signed relative error of images with an estimate.
    """

    images: int
    coverage: float
    median: float
    mean: float
    within_10: float
    within_20: float
    bias: float


def summarise(trials: Iterable[ScaleTrial]) -> ErrorSummary:
    """Summarise trials; an image without an estimate counts as an error of 100 %."""
    return summarise_errors([trial.signed_error for trial in trials])


def summarise_errors(signed_errors: ArrayLike) -> ErrorSummary:
    """Summarise ``[n]`` signed relative errors; NaN, no estimate, counts as an error of 100 %."""
    signed = np.asarray(signed_errors, dtype=np.float64)
    if not len(signed):
        return ErrorSummary(0, *(math.nan,) * 6)
    is_estimated = np.isfinite(signed)
    errors = np.where(is_estimated, np.abs(signed), 1.0)
    bias = math.nan
    if is_estimated.any():
        bias = float(np.median(signed[is_estimated]))
    return ErrorSummary(
        len(signed),
        float(is_estimated.mean()),
        median=float(np.median(errors)),
        mean=float(errors.mean()),
        within_10=float((errors < 0.10).mean()),
        within_20=float((errors < 0.20).mean()),
        bias=bias,
    )


# --- The benchmark


@dataclass(frozen=True, eq=False)
class ScaleBenchmark:
    """Estimates on images of known scale, from detected and from labelled vehicles.

    Attributes:
        data: the images.
        detector: model card of the detector.
        trials: every searched image, with detected vehicles.
        baseline: every image with labels, with labelled vehicles and the same filter and mode.
        issues: files left out or used in part.
        options_of: gives the options for an image; the region can differ.
        label_options_of: gives the options for labelled vehicles.
    """

    data: KnownScaleSet
    detector: DetectorCard
    trials: tuple[ScaleTrial, ...]
    baseline: tuple[ScaleTrial, ...]
    issues: tuple[FileIssue, ...]
    options_of: OptionsOf
    label_options_of: OptionsOf


def check_options(
    detector: Detector,
    data: KnownScaleSet,
    options_of: OptionsOf,
) -> None:
    """Check, before the search, that a detector has every region and owns the calibration.

    Raises:
        InvalidParameterError: the detector lacks a region.
        CalibrationMismatchError: the calibration was made for another detector.
    """
    # Thousands of images share a few options.
    distinct = {id(options): options for options in map(options_of, data.images)}
    for options in distinct.values():
        checked_detector(detector, options)


def with_regions(options: ScaleOptions, regions: Mapping[str, str]) -> OptionsOf:
    """Choose the options of an image by its set.

    Args:
        options: options for all images.
        regions: region by set; it replaces the reference length.
    """
    options_by_set = {
        name: replace(options, reference=Reference(region=region))
        for name, region in regions.items()
    }

    def options_of(image: KnownScaleImage) -> ScaleOptions:
        return options_by_set.get(image.set, options)

    return options_of


def benchmark_scale(
    data: KnownScaleSet,
    searched: Mapping[Path, SearchedImage | FileIssue],
    detector: DetectorCard,
    options_of: OptionsOf,
    *,
    label_options_of: OptionsOf | None = None,
    label_classes: Sequence[str] = (SMALL_VEHICLE,),
) -> ScaleBenchmark:
    """Estimate scales from detected and from labelled vehicles.

    Args:
        data: images of known scale.
        searched: results of ``search_images`` by image.
        detector: model card of the detector.
        options_of: gives the options for an image.
        label_options_of: gives the options for labelled vehicles; default: the same.
        label_classes: label classes that count as vehicles.

    Returns:
        All trials; the issues list images and labels that could not be used.

    Raises:
        InvalidParameterError: the detector lacks a region.
    """
    label_options_of = label_options_of or options_of
    issues = list(data.issues)
    trials = []
    baseline = []
    for image in data.images:
        result = searched[image.path]
        if isinstance(result, FileIssue):
            issues.append(result)
            continue
        with naming(image.path):
            analysis = result.analysis(detector, options_of(image))
        trials.append(ScaleTrial(image, analysis, searched=result))

        if image.labels is None:
            continue
        labelled = _labelled_image(image.labels, label_classes, result.image)
        if isinstance(labelled, FileIssue):
            issues.append(labelled)
            continue
        with naming(image.labels):
            analysis = labelled.analysis(detector, label_options_of(image))
        baseline.append(ScaleTrial(image, analysis, searched=labelled))
    return ScaleBenchmark(
        data,
        detector,
        trials=tuple(trials),
        baseline=tuple(baseline),
        issues=tuple(issues),
        options_of=options_of,
        label_options_of=label_options_of,
    )


def _labelled_image(
    labels: Path,
    classes: Sequence[str],
    searched: ImageFacts,
) -> SearchedImage | FileIssue:
    """Make a search result from labels, which are analysed like detections with a score of 1."""
    try:
        boxes = labelled_boxes(labels, classes)
    except (OSError, ValueError) as error:
        # The image itself was searched, so only its labels are left out.
        return FileIssue(labels, "unreadable_labels", str(error), skipped=False)
    # Only the size of the image counts: its metadata would give another ruler than the labels.
    facts = ImageFacts(searched.width_px, searched.height_px)
    scores = np.ones(len(boxes))
    return SearchedImage(Detections(boxes, scores), facts)


class ErrorRow(ResultRecord):
    """Row of the table; errors cover images with an estimate, as in the paper."""

    name: str = Field(description="Kind of boxes, and images.")
    images: int = Field(ge=0, description="Images with an estimate; errors cover these.")
    of_images: int = Field(ge=0, description="Images tried.")
    coverage: float | None = Field(description="images / of_images.")
    median: float | None = Field(description="Median of the absolute relative error.")
    mean: float | None = Field(description="Mean of the absolute relative error.")
    within_10: float | None = Field(description="Share of errors below 10 %.")
    within_20: float | None = Field(description="Share of errors below 20 %.")
    bias: float | None = Field(description="Median of the signed relative error.")
    interval_coverage: float | None = Field(
        description="Share of true scales inside the 95 % interval."
    )
    usable: int = Field(ge=0, description="Images with a usable scale: status ok.")
    usable_share: float | None = Field(description="usable / of_images.")
    usable_wrong: int = Field(ge=0, description="Usable images with an error above 20 %.")

    @classmethod
    def of(cls, name: str, trials: Iterable[ScaleTrial]) -> ErrorRow:
        """Summarise trials."""
        tried = list(trials)
        estimated = [trial for trial in tried if trial.estimated]
        usable = [trial for trial in estimated if trial.usable]
        summary = summarise(estimated)
        interval_coverage = math.nan
        if estimated:
            is_covered = [bool(trial.covered) for trial in estimated]
            interval_coverage = float(np.mean(is_covered))
        coverage = None
        usable_share = None
        if tried:
            coverage = len(estimated) / len(tried)
            usable_share = len(usable) / len(tried)
        return cls(
            name=name,
            images=len(estimated),
            of_images=len(tried),
            coverage=coverage,
            median=_none_if_nan(summary.median),
            mean=_none_if_nan(summary.mean),
            within_10=_none_if_nan(summary.within_10),
            within_20=_none_if_nan(summary.within_20),
            bias=_none_if_nan(summary.bias),
            interval_coverage=_none_if_nan(interval_coverage),
            usable=len(usable),
            usable_share=usable_share,
            usable_wrong=sum(trial.error > HIGH_ERROR for trial in usable),
        )


def _none_if_nan(value: float) -> float | None:
    return None if math.isnan(value) else value


class ScaleReport(ResultRecord):
    """Table I on some data, with the paper's figures on confidence and resolution guard."""

    data: str = Field(description="Source of the images.")
    detector: str = Field(description="Name of the detector.")
    detector_sha256: str = Field(description="SHA-256 of its file.")
    reference_length_m: tuple[float, ...] = Field(
        description="Distinct L_ref of the estimates, metres, ascending."
    )
    label_reference_length_m: float | None = Field(
        description="KDE mode of the labelled lengths of these images, metres; null without labels."
    )
    rows: tuple[ErrorRow, ...] = Field(description="The table.")
    skipped: dict[str, int] = Field(description="Images left out, by reason.")
    noted: dict[str, int] = Field(description="Images or labels used in part, by reason.")
    no_vehicle_found: int = Field(
        description="Images without an estimate: the detector found nothing."
    )
    no_vehicle_labelled: int = Field(description="Images with labels, none of them a vehicle.")
    confidence_error_pearson: float | None = Field(
        description="Correlation of confidence and absolute error."
    )
    confidence_error_spearman: float | None = Field(
        description="Rank correlation of confidence and absolute error."
    )
    high_errors: int = Field(description="Estimates with an error above 20 %.")
    high_errors_guarded: int = Field(
        description="Of these, estimates that the resolution guard caps."
    )
    high_errors_low_confidence: int = Field(description="Of these, estimates that are not usable.")
    low_errors: int = Field(description="Estimates with an error of at most 20 %.")
    low_errors_guarded: int = Field(
        description="Of these, estimates that the resolution guard caps."
    )
    low_errors_low_confidence: int = Field(description="Of these, estimates that are not usable.")


def report_scale(benchmark: ScaleBenchmark) -> ScaleReport:
    """Summarise a benchmark."""
    estimated = [trial for trial in benchmark.trials if trial.estimated]
    confidence = np.array([trial.confidence for trial in estimated])
    errors = np.array([trial.error for trial in estimated])
    high = [trial for trial in estimated if trial.error > HIGH_ERROR]
    low = [trial for trial in estimated if trial.error <= HIGH_ERROR]
    n_unlabelled = sum(not trial.estimated for trial in benchmark.baseline)
    return ScaleReport(
        data=benchmark.data.source,
        detector=benchmark.detector.name,
        detector_sha256=benchmark.detector.sha256,
        reference_length_m=_reference_lengths(benchmark.trials),
        label_reference_length_m=_mode_of_labels(benchmark.baseline),
        rows=tuple(_rows(benchmark)),
        skipped=_reasons(benchmark.issues, skipped=True),
        noted=_reasons(benchmark.issues, skipped=False),
        no_vehicle_found=len(benchmark.trials) - len(estimated),
        no_vehicle_labelled=n_unlabelled,
        confidence_error_pearson=_pearson(confidence, errors),
        confidence_error_spearman=_spearman(confidence, errors),
        high_errors=len(high),
        high_errors_guarded=_guarded(high),
        high_errors_low_confidence=_low_confidence(high),
        low_errors=len(low),
        low_errors_guarded=_guarded(low),
        low_errors_low_confidence=_low_confidence(low),
    )


def _mode_of_labels(baseline: Iterable[ScaleTrial]) -> float | None:
    """Find the mode of the labelled lengths in metres: the L_ref that would fit these images."""
    lengths_m = []
    for trial in baseline:
        if trial.estimated:
            lengths_px = trial.analysis.detections.boxes[:, 2]
            lengths_m.append(lengths_px * trial.image.gsd_m_per_px)
    if not lengths_m:
        return None
    return kde_mode(np.concatenate(lengths_m))


def _rows(benchmark: ScaleBenchmark) -> Iterator[ErrorRow]:
    """Summarise all images, those with both kinds of estimate, and each set."""
    trials = benchmark.trials
    baseline = benchmark.baseline
    yield ErrorRow.of("detector", trials)
    if baseline:
        # Detector and labels compare fairly only on the same images.
        both = _estimated_images(trials) & _estimated_images(baseline)
        yield ErrorRow.of("labels", baseline)
        yield ErrorRow.of("detector, intersection", _of_images(trials, both))
        yield ErrorRow.of("labels, intersection", _of_images(baseline, both))
    # With one set, its rows would repeat those above.
    sets = sorted({trial.image.set for trial in trials})
    if len(sets) < 2:
        return
    for name in sets:
        in_set = [trial for trial in trials if trial.image.set == name]
        yield ErrorRow.of(f"detector, {name or 'no set'}", in_set)
        labelled_in_set = [trial for trial in baseline if trial.image.set == name]
        if labelled_in_set:
            yield ErrorRow.of(f"labels, {name or 'no set'}", labelled_in_set)


def _estimated_images(trials: Iterable[ScaleTrial]) -> set[Path]:
    return {trial.image.path for trial in trials if trial.estimated}


def _of_images(trials: Iterable[ScaleTrial], images: set[Path]) -> list[ScaleTrial]:
    return [trial for trial in trials if trial.image.path in images]


def _reasons(issues: Iterable[FileIssue], *, skipped: bool) -> dict[str, int]:
    reasons = [issue.reason for issue in issues if issue.skipped == skipped]
    counts = Counter(reasons)
    return dict(sorted(counts.items()))


def _reference_lengths(trials: Iterable[ScaleTrial]) -> tuple[float, ...]:
    details = [trial.analysis.estimate.details for trial in trials]
    lengths = {own.reference_length_m for own in details}
    return tuple(sorted(length for length in lengths if length is not None))


def _guarded(trials: Iterable[ScaleTrial]) -> int:
    details = [trial.analysis.estimate.details for trial in trials]
    return sum(bool(own.resolution_guard) for own in details)


def _low_confidence(trials: Iterable[ScaleTrial]) -> int:
    return sum(not trial.usable for trial in trials)


def _ranks(values: Numbers) -> Numbers:
    from scipy.stats import rankdata

    return np.asarray(rankdata(values))


def _spearman(first: Numbers, second: Numbers) -> float | None:
    """Compute Spearman's correlation: Pearson's of the ranks."""
    return _pearson(_ranks(first), _ranks(second))


def _pearson(first: Numbers, second: Numbers) -> float | None:
    """Compute Pearson's correlation; None with fewer than three values or without spread."""
    if len(first) < 3:
        return None
    is_constant = np.ptp(first) == 0 or np.ptp(second) == 0
    if is_constant:
        return None
    correlations = np.corrcoef(first, second)
    return float(correlations[0, 1])
