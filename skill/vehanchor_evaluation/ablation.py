"""The paper's Table III: one option of the method changed at a time, on the same boxes."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

from pydantic import Field

from vehanchor.detection.card import REFERENCE_LENGTH_M
from vehanchor.errors import InvalidParameterError
from vehanchor.options import Reference
from vehanchor.options.method import Method
from vehanchor.scale.defaults import Aggregation
from vehanchor.scale.lengths import MIN_KDE_VEHICLES
from vehanchor_evaluation.gsd import ErrorRow, ScaleTrial
from vehanchor_evaluation.result_record import ResultRecord
from vehanchor_evaluation.search import ABLATION_ALPHAS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.options import ScaleOptions
    from vehanchor_evaluation.gsd import OptionsOf, ScaleBenchmark

Boxes = Literal["detector", "labels"]
_Setting = tuple[str, str, Boxes]
_Group = tuple[str, str, list[ScaleTrial]]
_Range = tuple[str, float, float]

# Reference lengths in the paper: European, DOTA's, North American.
_LENGTHS_M = (4.5, REFERENCE_LENGTH_M, 5.5)
# Limit of the paper's group of many vehicles.
_MANY_VEHICLES = 20
# The paper reports the groups below 0.3 and above 0.7 m/px.
_GSD_GROUPS = (
    ("< 0.3 m/px", 0.0, 0.3),
    ("0.3 to 0.5 m/px", 0.3, 0.5),
    ("0.5 to 0.7 m/px", 0.5, 0.7),
    ("> 0.7 m/px", 0.7, math.inf),
)
# Median error and share below 20 % in the paper, by choice, setting and boxes.
_PAPER: dict[_Setting, tuple[float, float | None]] = {
    ("aggregation", "kde", "detector"): (0.0687, 0.833),
    ("aggregation", "median", "detector"): (0.0731, 0.840),
    ("aggregation", "mean", "detector"): (0.0827, 0.837),
    ("reference length", "4.5 / 5.045", "labels"): (0.1059, 0.803),
    ("reference length", "1", "labels"): (0.0688, 0.926),
    ("reference length", "5.5 / 5.045", "labels"): (0.1071, 0.799),
    ("alpha", "1", "labels"): (0.0727, 0.877),
    ("alpha", "1.5", "labels"): (0.0688, 0.926),
    ("alpha", "none", "labels"): (0.0674, 0.926),
    ("vehicles", "N >= 20", "detector"): (0.0612, None),
    ("vehicles", "N < 5", "detector"): (0.1347, None),
    ("true scale", "< 0.3 m/px", "detector"): (0.0610, None),
    ("true scale", "> 0.7 m/px", "detector"): (0.6719, None),
}


class AblationRow(ResultRecord):
    """Error with one option changed."""

    choice: str = Field(description="The option that varies.")
    setting: str = Field(
        description="Its value; a reference length is a factor of the current one."
    )
    boxes: Boxes = Field(description="Source of the vehicles: detector or labels.")
    errors: ErrorRow = Field(description="The errors.")
    paper_median: float | None = Field(description="Median error in the paper.")
    paper_within_20: float | None = Field(description="Share of errors below 20 % in the paper.")

    def flat(self) -> dict[str, object]:
        """Flatten the row to values by column."""
        return {
            "choice": self.choice,
            "setting": self.setting,
            "boxes": self.boxes,
            **self.errors.model_dump(exclude={"name"}),
            "paper_median": self.paper_median,
            "paper_within_20": self.paper_within_20,
        }


class AblationReport(ResultRecord):
    """Table III on some data."""

    data: str = Field(description="Source of the images.")
    detector: str = Field(description="Name of the detector.")
    detector_sha256: str = Field(description="SHA-256 of its file.")
    rows: tuple[AblationRow, ...] = Field(description="The table.")


class _Side(NamedTuple):
    """Trials with one kind of boxes, and the options that they were made with."""

    boxes: Boxes
    trials: tuple[ScaleTrial, ...]
    options_of: OptionsOf


class _Variant(NamedTuple):
    choice: str
    setting: str
    changed: Callable[[ScaleAnalysis, ScaleOptions], ScaleOptions]


def ablate(benchmark: ScaleBenchmark) -> AblationReport:
    """Repeat the estimates on the benchmark's boxes with one option changed at a time.

    Aggregation, reference length and outlier filter vary for detected and for labelled vehicles.
    Number of vehicles and true GSD split the estimates from detections.

    Args:
        benchmark: detected and labelled vehicles.

    Returns:
        A row for each setting and kind of boxes, with the paper's number if it has one.
    """
    sides = [_Side("detector", benchmark.trials, benchmark.options_of)]
    if benchmark.baseline:
        labels = _Side("labels", benchmark.baseline, benchmark.label_options_of)
        sides.append(labels)
    rows = []
    for variant in _variants():
        for side in sides:
            repeated = [
                _repeat(trial, side.options_of, variant=variant, benchmark=benchmark)
                for trial in side.trials
            ]
            row = _row(variant.choice, variant.setting, boxes=side.boxes, trials=repeated)
            rows.append(row)
    # These groups are subsets of the same estimates, so nothing is estimated again.
    for choice, setting, group in _splits(benchmark.trials):
        row = _row(choice, setting, boxes="detector", trials=group)
        rows.append(row)
    return AblationReport(
        data=benchmark.data.source,
        detector=benchmark.detector.name,
        detector_sha256=benchmark.detector.sha256,
        rows=tuple(rows),
    )


def _variants() -> Iterator[_Variant]:
    for aggregation in get_args(Aggregation):
        changed = partial(_with_lengths, aggregation=aggregation)
        yield _Variant("aggregation", aggregation, changed)
    for length in _LENGTHS_M:
        factor = length / REFERENCE_LENGTH_M
        setting = f"{length:g} / {REFERENCE_LENGTH_M:g}"
        if factor == 1:
            setting = "1"
        changed_length = partial(_with_reference, factor=factor)
        yield _Variant("reference length", setting, changed_length)
    for alpha in ABLATION_ALPHAS:
        setting = "none" if alpha is None else f"{alpha:g}"
        changed = partial(_with_lengths, alpha=alpha)
        yield _Variant("alpha", setting, changed)


def _with_lengths(_: ScaleAnalysis, options: ScaleOptions, **changes: Any) -> ScaleOptions:
    lengths = replace(options.lengths, **changes)
    return replace(options, lengths=lengths)


def _with_reference(analysis: ScaleAnalysis, options: ScaleOptions, factor: float) -> ScaleOptions:
    length_m = analysis.estimate.details.reference_length_m
    # Without a reference length in the estimate there is nothing to multiply.
    if length_m is None:
        return options
    reference = Reference(length_m * factor)
    return replace(options, reference=reference)


def _repeat(
    trial: ScaleTrial,
    options_of: OptionsOf,
    variant: _Variant,
    benchmark: ScaleBenchmark,
) -> ScaleTrial:
    """Repeat a trial with one option changed, on the same vehicles."""
    if trial.searched is None:
        raise InvalidParameterError(
            f"the trial of {trial.image.path} lacks its vehicles: use benchmark_scale"
        )
    own_options = options_of(trial.image)
    options = variant.changed(trial.analysis, own_options)
    # The table is about the published scale, L_ref / P_mode.
    options = replace(options, method=Method(preset="paper"))
    analysis = trial.searched.analysis(benchmark.detector, options)
    return replace(trial, analysis=analysis)


def _splits(trials: Sequence[ScaleTrial]) -> Iterator[_Group]:
    """Split the trials by number of vehicles and by true GSD: choice, setting, trials."""
    few = MIN_KDE_VEHICLES
    many = _MANY_VEHICLES
    # Name, least number and end of each range.
    counts: tuple[_Range, ...] = (
        (f"N < {few}", 1, few),
        (f"{few} <= N < {many}", few, many),
        (f"N >= {many}", many, math.inf),
    )
    for name, low, high in counts:
        group = [trial for trial in trials if low <= _n_detections(trial) < high]
        yield "vehicles", name, group
    for name, low, high in _GSD_GROUPS:
        group = [trial for trial in trials if low <= trial.image.gsd_m_per_px < high]
        yield "true scale", name, group


def _n_detections(trial: ScaleTrial) -> int:
    return trial.analysis.estimate.details.n_detections or 0


def _row(
    choice: str,
    setting: str,
    boxes: Boxes,
    trials: Sequence[ScaleTrial],
) -> AblationRow:
    # The paper reports only some settings, and those for one kind of boxes.
    setting_in_paper = (choice, setting, boxes)
    median, within_20 = _PAPER.get(setting_in_paper, (None, None))
    return AblationRow(
        choice=choice,
        setting=setting,
        boxes=boxes,
        errors=ErrorRow.of(f"{choice} {setting}", trials),
        paper_median=median,
        paper_within_20=within_20,
    )
