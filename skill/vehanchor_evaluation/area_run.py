"""Run over objects of known area: masks, scales, trials and report."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

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
    from vehanchor.options import ScaleOptions
    from vehanchor.records import GsdEstimate
    from vehanchor.segmentation.segmenter import Segmenter
    from vehanchor_evaluation.area import AreaTrial
    from vehanchor_evaluation.area_report import AreaReport
    from vehanchor_evaluation.areas import AreaEntry, AreaSet
    from vehanchor_evaluation.search import SearchedImage


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
    detector: Detector,
    segmenter: Segmenter,
    options: ScaleOptions,
    *,
    logs: Path | None = None,
    classes: Sequence[str | int] | None = None,
    limit: int | None = None,
    workers: int | None = None,
    progress: Callable[[str], Callable[[int, int], None] | None] | None = None,
) -> AreaRun:
    """Measure objects of known area and separate the errors of masks and scales.

    Args:
        data: the objects.
        detector: finds the vehicles.
        segmenter: finds the objects.
        options: options of the estimate.
        logs: folder for logs that let a later run resume; None keeps no logs.
        classes: detector classes that count as vehicles, as when the detector was opened.
        limit: measure only the first entries; categories alternate.
        workers: images in parallel, each held in memory; None chooses a number.
        progress: takes the name of the next step and returns a function that is called with (done,
            total).

    Raises:
        InvalidParameterError: a file is not a log.
        OutputError: a log cannot be written.
    """
    entries = data.entries[:limit]
    n_workers = workers or default_workers()
    step = progress or (lambda _: None)
    masks, issues = segment_entries(
        entries,
        segmenter,
        open_mask_log(logs and logs / "masks.sqlite", segmenter.card.sha256),
        workers=n_workers,
        progress=step(count(len(entries), "object")),
    )
    images = {entry.image: KnownScaleImage(entry.image, entry.gsd_m_per_px) for entry in entries}
    searched = search_known_scale(
        KnownScaleSet(str(data.source), tuple(images.values())),
        detector,
        options,
        classes=classes,
        cache=logs and logs / "detections.sqlite",
        workers=n_workers,
        progress=step(count(len(images), "image")),
    )
    trials = area_trials(entries, masks, _scales(searched, detector, options))
    issues += [found for found in searched.values() if isinstance(found, FileIssue)]
    run = _run_facts(detector, segmenter, options=options, limit=limit)
    facts = _facts(trials, entries, detector.card.name, segmenter.card.name)
    issues = [*data.issues, *issues]
    report = area_report(data, run, rows=summarise_area(trials), facts=facts, issues=issues)
    return AreaRun(report, tuple(trials), tuple(issues))


def _scales(
    searched: Mapping[Path, SearchedImage | FileIssue], detector: Detector, options: ScaleOptions
) -> dict[Path, GsdEstimate]:
    return {
        image: found.analysis(detector.card, options).estimate
        for image, found in searched.items()
        if not isinstance(found, FileIssue)
    }


def _run_facts(
    detector: Detector, segmenter: Segmenter, options: ScaleOptions, limit: int | None
) -> dict[str, Any]:
    """Describe models and options for the report."""
    return {
        "detector": {"name": detector.card.name, "sha256": detector.card.sha256},
        "segmenter": {"name": segmenter.card.name, "sha256": segmenter.card.sha256},
        "reference_length_m": options.reference.reference_length_m,
        "region": options.reference.region,
        "calibration": options.reference.calibration
        and options.reference.calibration.model_dump(mode="json"),
        **asdict(options.search),
        **asdict(options.lengths),
        "bands": options.reading.bands,
        "limit": limit,
    }


def _facts(
    trials: Sequence[AreaTrial], entries: Sequence[AreaEntry], detector: str, segmenter: str
) -> list[str]:
    """Describe the basis of the table, one sentence each."""
    images = count(len({trial.image for trial in trials}), "image")
    facts = [
        f"{len(trials)} of {count(len(entries), 'object')} measured, in {images}",
        f"detector {detector}, segmenter {segmenter}; a missing scale or mask counts as an "
        "error of 100 %",
    ]
    if trials:
        iou = np.array([trial.mask_iou for trial in trials])
        n_without = sum(trial.gsd_m_per_px is None for trial in trials)
        facts.append(f"masks: IoU median {np.median(iou):.3f}, mean {iou.mean():.3f}")
        facts.append(
            f"scale: none for {count(n_without, 'object')} ({percent(n_without / len(trials), 0)})"
        )
    return facts
