"""Error of the estimated scale on images of known scale: the paper's Table I."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from vehanchor.analysis.scale import ScaleAnalysis
from vehanchor.detection.detections import Detections
from vehanchor.estimate import analyse_scale, open_detector
from vehanchor.imagery.facts import ImageFacts
from vehanchor.options import Reference, ScaleOptions
from vehanchor.scale.lengths import kde_mode
from vehanchor.scale.thresholds import FALLBACK_CONFIDENCE
from vehanchor_evaluation.dota import SMALL_VEHICLE, labelled_boxes
from vehanchor_evaluation.known_scale import FileIssue, KnownScaleImage, KnownScaleSet, naming
from vehanchor_evaluation.search import SearchedImage

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import ArrayLike

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detector import Detector

HIGH_ERROR = 0.20  # paper: 51 of 306 "high-error images" is what an error above 20 % gives


@dataclass(frozen=True, eq=False)
class ScaleTrial:
    """The pipeline's answer for one image of known scale.

    Attributes:
        image: the image.
        analysis: the answer.
        searched: the vehicles it was made from, for another look at them; None where they were not kept.
    """

    image: KnownScaleImage
    analysis: ScaleAnalysis
    searched: SearchedImage | None = None

    @property
    def signed_error(self) -> float:
        """``(GSD - truth) / truth``; NaN without an estimate."""
        gsd = self.analysis.estimate.gsd_m_per_px
        return math.nan if gsd is None else gsd / self.image.gsd_m_per_px - 1.0

    @property
    def error(self) -> float:
        """Absolute relative error; 1 (100 %) without an estimate."""
        return 1.0 if math.isnan(self.signed_error) else abs(self.signed_error)

    @property
    def estimated(self) -> bool:
        """Whether there is an estimate."""
        return self.analysis.estimate.gsd_m_per_px is not None

    @property
    def covered(self) -> bool | None:
        """Whether the true scale lies in the 95 % interval; None without an estimate."""
        estimate = self.analysis.estimate
        if estimate.gsd_ci95_low_m_per_px is None or estimate.gsd_ci95_high_m_per_px is None:
            return None
        return estimate.gsd_ci95_low_m_per_px <= self.image.gsd_m_per_px <= estimate.gsd_ci95_high_m_per_px


def run_trials(
    images: Iterable[KnownScaleImage], detector: Detector, options: ScaleOptions | None = None
) -> Iterator[ScaleTrial]:
    """Estimate the scale of each image in turn."""
    for image in images:
        yield ScaleTrial(image, analyse_scale(image.path, options, detector=detector))


class ErrorSummary(NamedTuple):
    """The columns of the paper's Table I.

    Attributes:
        images: number of images.
        coverage: share with an estimate.
        median: of the absolute relative error.
        mean: of the absolute relative error.
        within_10: share of errors below 10 %.
        within_20: share of errors below 20 %.
        bias: median of the signed relative error where there is an estimate.
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
    known = np.isfinite(signed)
    errors = np.where(known, np.abs(signed), 1.0)
    return ErrorSummary(
        len(signed),
        float(known.mean()),
        float(np.median(errors)),
        float(errors.mean()),
        float((errors < 0.10).mean()),
        float((errors < 0.20).mean()),
        float(np.median(signed[known])) if known.any() else math.nan,
    )


# --- The benchmark ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ScaleBenchmark:
    """The pipeline on images of known scale, with found and with labelled vehicles.

    Attributes:
        data: the images.
        detector: card of the model.
        trials: every image that could be searched, with the detector's vehicles.
        baseline: those with labels, with the labelled vehicles through the same filter and mode.
        issues: files left out, or not used whole.
        options_of: the method's choices for one image; the region may differ.
        label_options_of: the same for labelled vehicles.
    """

    data: KnownScaleSet
    detector: DetectorCard
    trials: tuple[ScaleTrial, ...]
    baseline: tuple[ScaleTrial, ...]
    issues: tuple[FileIssue, ...]
    options_of: Callable[[KnownScaleImage], ScaleOptions]
    label_options_of: Callable[[KnownScaleImage], ScaleOptions]


def check_options(
    detector: Detector, data: KnownScaleSet, options_of: Callable[[KnownScaleImage], ScaleOptions]
) -> None:
    """Check, before the work, that a model knows the region of every image, and the calibration is its own.

    Raises:
        InvalidParameterError: it does not know one of the regions.
        CalibrationMismatchError: the calibration was made for another model.
    """
    for options in {id(options): options for options in map(options_of, data.images)}.values():
        open_detector(detector, options)


def with_regions(options: ScaleOptions, regions: Mapping[str, str]) -> Callable[[KnownScaleImage], ScaleOptions]:
    """Choose the options of an image by its set.

    Args:
        options: of all images.
        regions: by set, whose reference length is taken instead.
    """
    chosen = {name: replace(options, reference=Reference(region=region)) for name, region in regions.items()}
    return lambda image: chosen.get(image.set, options)


def benchmark_scale(
    data: KnownScaleSet,
    searched: Mapping[Path, SearchedImage | FileIssue],
    detector: DetectorCard,
    options_of: Callable[[KnownScaleImage], ScaleOptions],
    *,
    label_options_of: Callable[[KnownScaleImage], ScaleOptions] | None = None,
    label_classes: Sequence[str] = (SMALL_VEHICLE,),
) -> ScaleBenchmark:
    """Turn vehicles found and vehicles labelled into scales.

    Args:
        data: images of known scale.
        searched: what ``search_images`` found in each.
        detector: card of the model.
        options_of: the method's choices for an image.
        label_options_of: those for labelled vehicles; default the same.
        label_classes: classes of labels that count as vehicles.

    Returns:
        All trials; images and labels that could not be used are among the issues.

    Raises:
        InvalidParameterError: the model does not know a region.
    """
    label_options_of = label_options_of or options_of
    issues = list(data.issues)
    trials, baseline = [], []
    for image in data.images:
        found = searched[image.path]
        if isinstance(found, FileIssue):
            issues.append(found)
            continue
        with naming(image.path):
            trials.append(ScaleTrial(image, found.analysis(detector, options_of(image)), found))
        if image.labels is None:
            continue
        try:
            boxes = labelled_boxes(image.labels, label_classes)
        except (OSError, ValueError) as error:
            issues.append(FileIssue(image.labels, "unreadable_labels", str(error), skipped=False))
            continue
        facts = ImageFacts(found.image.width_px, found.image.height_px)
        labelled = SearchedImage(Detections(boxes, np.ones(len(boxes))), facts)
        with naming(image.labels):
            baseline.append(ScaleTrial(image, labelled.analysis(detector, label_options_of(image)), labelled))
    return ScaleBenchmark(data, detector, tuple(trials), tuple(baseline), tuple(issues), options_of, label_options_of)


class _Row(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ErrorRow(_Row):
    """One row of the table: errors where there is an estimate, as the paper counts."""

    name: str = Field(description="Which boxes, on which images.")
    images: int = Field(ge=0, description="Images with an estimate; all errors are over these.")
    of_images: int = Field(ge=0, description="Images tried.")
    coverage: float | None = Field(description="images / of_images.")
    median: float | None = Field(description="Median of the absolute relative error.")
    mean: float | None = Field(description="Mean of the absolute relative error.")
    within_10: float | None = Field(description="Share of errors below 10 %.")
    within_20: float | None = Field(description="Share of errors below 20 %.")
    bias: float | None = Field(description="Median of the signed relative error.")
    interval_coverage: float | None = Field(description="Share of true scales inside the 95 % interval.")
    usable: int = Field(ge=0, description="Images whose scale may be used: status ok.")
    usable_share: float | None = Field(description="usable / of_images.")
    usable_wrong: int = Field(ge=0, description="Of the usable ones, those with an error above 20 %.")

    @classmethod
    def of(cls, name: str, trials: Iterable[ScaleTrial]) -> ErrorRow:
        """Summarise trials."""
        tried = list(trials)
        known = [trial for trial in tried if trial.estimated]
        usable = [trial for trial in known if trial.analysis.estimate.status == "ok"]
        summary = summarise(known)
        numbers = {
            "median": summary.median,
            "mean": summary.mean,
            "within_10": summary.within_10,
            "within_20": summary.within_20,
            "bias": summary.bias,
            "interval_coverage": float(np.mean([bool(trial.covered) for trial in known])) if known else math.nan,
        }
        return cls(
            name=name,
            images=len(known),
            of_images=len(tried),
            coverage=len(known) / len(tried) if tried else None,
            usable=len(usable),
            usable_share=len(usable) / len(tried) if tried else None,
            usable_wrong=sum(trial.error > HIGH_ERROR for trial in usable),
            **{key: None if math.isnan(value) else value for key, value in numbers.items()},
        )


class ScaleReport(_Row):
    """Table I, and what the paper says of confidence and guard, on some data."""

    data: str = Field(description="Where the images come from.")
    detector: str = Field(description="Name of the detector.")
    detector_sha256: str = Field(description="SHA-256 of its file.")
    reference_length_m: tuple[float, ...] = Field(
        description="L_ref of the estimates, metres, each once, shortest first."
    )
    label_reference_length_m: float | None = Field(
        description="KDE mode of the labelled lengths of these very images, metres; null without labels."
    )
    rows: tuple[ErrorRow, ...] = Field(description="The table.")
    skipped: dict[str, int] = Field(description="Images left out, by reason.")
    noted: dict[str, int] = Field(description="Images used in part or with labels in part, by reason.")
    no_vehicle_found: int = Field(description="Images without an estimate: the detector found nothing.")
    no_vehicle_labelled: int = Field(description="Images with labels, none of them a vehicle.")
    confidence_error_pearson: float | None = Field(description="Correlation of confidence and absolute error.")
    confidence_error_spearman: float | None = Field(description="The same of their ranks.")
    high_errors: int = Field(description="Estimates with an error above 20 %.")
    high_errors_guarded: int = Field(description="Of these, those that the resolution guard caps.")
    high_errors_low_confidence: int = Field(description="Of these, those with a confidence below 0.5.")
    low_errors: int = Field(description="Estimates with an error of at most 20 %.")
    low_errors_guarded: int = Field(description="Of these, those that the resolution guard caps.")
    low_errors_low_confidence: int = Field(description="Of these, those with a confidence below 0.5.")


def report_scale(benchmark: ScaleBenchmark) -> ScaleReport:
    """Summarise a benchmark."""
    known = [trial for trial in benchmark.trials if trial.estimated]
    confidence = np.array([trial.analysis.estimate.confidence for trial in known])
    errors = np.array([trial.error for trial in known])
    high = [trial for trial in known if trial.error > HIGH_ERROR]
    low = [trial for trial in known if trial.error <= HIGH_ERROR]
    labelled = [
        trial.analysis.detections.boxes[:, 2] * trial.image.gsd_m_per_px
        for trial in benchmark.baseline
        if trial.estimated
    ]
    return ScaleReport(
        data=benchmark.data.source,
        detector=benchmark.detector.name,
        detector_sha256=benchmark.detector.sha256,
        reference_length_m=tuple(sorted({trial.analysis.estimate.reference_length_m for trial in benchmark.trials})),
        label_reference_length_m=kde_mode(np.concatenate(labelled)) if labelled else None,
        rows=tuple(_rows(benchmark)),
        skipped=_reasons(benchmark.issues, skipped=True),
        noted=_reasons(benchmark.issues, skipped=False),
        no_vehicle_found=len(benchmark.trials) - len(known),
        no_vehicle_labelled=sum(not trial.estimated for trial in benchmark.baseline),
        confidence_error_pearson=_pearson(confidence, errors),
        confidence_error_spearman=_pearson(_ranks(confidence), _ranks(errors)),
        high_errors=len(high),
        high_errors_guarded=_guarded(high),
        high_errors_low_confidence=_unsure(high),
        low_errors=len(low),
        low_errors_guarded=_guarded(low),
        low_errors_low_confidence=_unsure(low),
    )


def _rows(benchmark: ScaleBenchmark) -> Iterator[ErrorRow]:
    trials, baseline = benchmark.trials, benchmark.baseline
    yield ErrorRow.of("detector", trials)
    if baseline:
        both = {t.image.path for t in trials if t.estimated} & {t.image.path for t in baseline if t.estimated}
        yield ErrorRow.of("labels", baseline)
        yield ErrorRow.of("detector, intersection", [t for t in trials if t.image.path in both])
        yield ErrorRow.of("labels, intersection", [t for t in baseline if t.image.path in both])
    sets = sorted({trial.image.set for trial in trials})
    if len(sets) > 1:
        for name in sets:
            yield ErrorRow.of(f"detector, {name or 'no set'}", [t for t in trials if t.image.set == name])
            some = [t for t in baseline if t.image.set == name]
            if some:
                yield ErrorRow.of(f"labels, {name or 'no set'}", some)


def _reasons(issues: Iterable[FileIssue], *, skipped: bool) -> dict[str, int]:
    return dict(sorted(Counter(issue.reason for issue in issues if issue.skipped == skipped).items()))


def _guarded(trials: Iterable[ScaleTrial]) -> int:
    return sum(trial.analysis.estimate.resolution_guard for trial in trials)


def _unsure(trials: Iterable[ScaleTrial]) -> int:
    return sum(trial.analysis.estimate.confidence < FALLBACK_CONFIDENCE for trial in trials)


def _ranks(values: np.ndarray) -> np.ndarray:
    from scipy.stats import rankdata

    return np.asarray(rankdata(values))


def _pearson(first: np.ndarray, second: np.ndarray) -> float | None:
    """None where it is not defined: fewer than three values, or no spread."""
    if len(first) < 3 or np.ptp(first) == 0 or np.ptp(second) == 0:
        return None
    return float(np.corrcoef(first, second)[0, 1])
