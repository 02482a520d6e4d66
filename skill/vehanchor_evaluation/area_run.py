"""Run over objects of known area: masks, scales, trials and a report."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from vehanchor.analysis.pipeline import checked_detector
from vehanchor.records.text import count
from vehanchor_evaluation.area import area_trials, open_mask_log, segment_entries, summarise_area
from vehanchor_evaluation.area_report import area_report
from vehanchor_evaluation.known_scale import FileIssue, KnownScaleImage, KnownScaleSet
from vehanchor_evaluation.report import percent
from vehanchor_evaluation.search import default_workers, search_known_scale

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from vehanchor.detection.detector import Detector
    from vehanchor.engine import Engine
    from vehanchor.models.runtime import Progress
    from vehanchor.options import ScaleOptions
    from vehanchor.records import GsdEstimate
    from vehanchor.segmentation.segmenter import Segmenter
    from vehanchor_evaluation.area import AreaTrial
    from vehanchor_evaluation.area_report import AreaReport
    from vehanchor_evaluation.areas import AreaEntry, AreaSet
    from vehanchor_evaluation.search import SearchedImage

    NameStep: TypeAlias = Callable[[str], Progress | None]
    """Takes the name of the next step; returns a function of (done, total), or None."""


@dataclass(frozen=True)
class AreaRun:
    """Results of a run.

    Attributes:
        report: the table and its basis.
        trials: one for each entry with a mask and a searched image.
        issues: files and entries that were left out.
    """

    report: AreaReport
    trials: tuple[AreaTrial, ...]
    issues: tuple[FileIssue, ...]


def measure_areas(
    data: AreaSet,
    engine: Engine,
    *,
    logs: Path | None = None,
    limit: int | None = None,
    workers: int | None = None,
    progress: NameStep | None = None,
) -> AreaRun:
    """Measure objects of known area and separate the errors of masks and scales.

    Args:
        data: the objects.
        engine: finds the vehicles and the objects, with its options of the estimate.
        logs: folder for logs that let a later run resume; None keeps no logs.
        limit: measure only the first entries; categories alternate.
        workers: images in parallel, each held in memory; None chooses a number.
        progress: takes the name of the next step; returns a function of (done, total), or None.

    Raises:
        ModelError: a model cannot be used.
        InvalidParameterError: a file is not a log, or the detector lacks the region.
        OutputError: a log cannot be written.
    """
    options = engine.options
    detector = checked_detector(engine.detector, options)
    segmenter = engine.segmenter
    entries = data.entries[:limit]
    n_workers = workers or default_workers()
    step = progress or (lambda _: None)
    mask_file = None
    detections_file = None
    if logs is not None:
        mask_file = logs / "masks.sqlite"
        detections_file = logs / "detections.sqlite"

    mask_log = open_mask_log(mask_file, segmenter.card.sha256)
    masks, mask_issues = segment_entries(
        entries,
        segmenter,
        mask_log,
        workers=n_workers,
        progress=step(count(len(entries), "object")),
    )
    # Objects of one image share its search.
    images = {}
    for entry in entries:
        images[entry.image] = KnownScaleImage(entry.image, entry.gsd_m_per_px)
    known_scales = KnownScaleSet(str(data.source), tuple(images.values()))
    searched = search_known_scale(
        known_scales,
        detector,
        options,
        cache=detections_file,
        workers=n_workers,
        progress=step(count(len(images), "image")),
    )
    search_issues = [result for result in searched.values() if isinstance(result, FileIssue)]
    issues = [*data.issues, *mask_issues, *search_issues]

    scales = _scales(searched, detector, options)
    trials = area_trials(entries, masks, scales)
    run = _run_facts(detector, segmenter, options=options, limit=limit)
    facts = _facts(trials, entries, detector.card.name, segmenter.card.name)
    rows = summarise_area(trials)
    report = area_report(data, run, rows=rows, facts=facts, issues=issues)
    return AreaRun(report, tuple(trials), tuple(issues))


def _scales(
    searched: Mapping[Path, SearchedImage | FileIssue],
    detector: Detector,
    options: ScaleOptions,
) -> dict[Path, GsdEstimate]:
    """Estimate the scale of each image that could be searched."""
    return {
        image: result.analysis(detector.card, options).estimate
        for image, result in searched.items()
        if not isinstance(result, FileIssue)
    }


def _run_facts(
    detector: Detector,
    segmenter: Segmenter,
    options: ScaleOptions,
    limit: int | None,
) -> dict[str, Any]:
    """Describe models and options for the report."""
    calibration = options.reference.calibration
    calibration_facts = None
    if calibration is not None:
        calibration_facts = calibration.model_dump(mode="json")
    return {
        "detector": _model_facts(detector),
        "segmenter": _model_facts(segmenter),
        "reference_length_m": options.reference.reference_length_m,
        "region": options.reference.region,
        "calibration": calibration_facts,
        **asdict(options.search),
        **asdict(options.lengths),
        "bands": options.reading.bands,
        "limit": limit,
    }


def _model_facts(model: Detector | Segmenter) -> dict[str, str | None]:
    card = model.card
    return {"name": card.name, "sha256": card.sha256}


def _facts(
    trials: Sequence[AreaTrial],
    entries: Sequence[AreaEntry],
    detector: str,
    segmenter: str,
) -> list[str]:
    """Describe the basis of the table, one sentence each."""
    objects = count(len(entries), "object")
    measured_images = {trial.image for trial in trials}
    images = count(len(measured_images), "image")
    facts = [
        f"{len(trials)} of {objects} measured, in {images}",
        f"detector {detector}, segmenter {segmenter}; a missing scale or mask counts as an "
        "error of 100 %",
    ]
    if not trials:
        return facts
    iou = np.array([trial.mask_iou for trial in trials])
    median = np.median(iou)
    facts.append(f"masks: IoU median {median:.3f}, mean {iou.mean():.3f}")
    n_without = sum(trial.gsd_m_per_px is None for trial in trials)
    share = percent(n_without / len(trials), digits=0)
    facts.append(f"scale: none for {count(n_without, 'object')} ({share})")
    return facts
