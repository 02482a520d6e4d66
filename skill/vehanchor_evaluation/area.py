"""Error of measured areas on objects with true masks, split by its two sources.

One search for vehicles (``vehanchor_evaluation.search``) gives the scale of an image for all its
objects. Each object's box gives its mask. Scale and mask give three areas:

* **end to end**: the model's mask and the estimated scale, ``A = N_px * GSD^2``, as a user gets it;
* **true scale** (GT-GSD): the model's mask and the true scale, which isolates the segmenter's
  error;
* **true mask** (GT-mask): the true mask and the estimated scale, which isolates the scale's error.
"""

from __future__ import annotations

import itertools
from contextlib import closing
from functools import partial
from importlib.metadata import version
from typing import TYPE_CHECKING, TypeAlias

from pydantic import Field

from vehanchor.errors import VehAnchorError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.scale.defaults import USABLE_CHANCE
from vehanchor.segmentation.prompt import Prompt
from vehanchor.storage.journal import Journal, Key, Source
from vehanchor_evaluation.area_errors import AreaErrors, area_errors
from vehanchor_evaluation.known_scale import DATASET_READING, FileIssue
from vehanchor_evaluation.pool import finished
from vehanchor_evaluation.result_record import ResultRecord

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from vehanchor.models.runtime import Progress
    from vehanchor.records import GsdEstimate
    from vehanchor.segmentation.segmenter import Segmentation, Segmenter
    from vehanchor_evaluation.area_errors import AreaAnswer
    from vehanchor_evaluation.areas import AreaEntry


class MaskTrial(ResultRecord):
    """Figures of the segmenter's mask for one entry."""

    entry: str
    mask_area_px: int = Field(description="Pixels of the model's mask; 0 counts as no answer.")
    mask_score: float = Field(
        description="The segmenter's estimate of its overlap with the true mask."
    )
    mask_iou: float = Field(description="True overlap: intersection over union.")


class AreaTrial(ResultRecord):
    """Measured areas of one entry."""

    entry: str
    image: str
    category: str
    true_area_m2: float
    true_gsd_m_per_px: float
    true_mask_area_px: int
    gsd_m_per_px: float | None = Field(description="Estimated scale; null without one.")
    scale_confidence: float
    n_vehicles: int
    mask_area_px: int
    mask_score: float
    mask_iou: float
    end_to_end_m2: float | None = Field(description="The model's mask at the estimated scale.")
    true_scale_m2: float | None = Field(description="The model's mask at the true scale.")
    true_mask_m2: float | None = Field(description="The true mask at the estimated scale.")


MaskLog: TypeAlias = Journal[MaskTrial]


def open_mask_log(path: Path | None, segmenter_sha256: str) -> MaskLog:
    """Open the log of masks of earlier runs with the same segmenter.

    Args:
        path: path of the file; None keeps figures in memory only.
        segmenter_sha256: SHA-256 of the segmenter's files.

    Raises:
        InvalidParameterError: the file is not a log of these masks.
        OutputError: the file cannot be read or written.
    """
    # Another release or another segmenter can draw other masks, so its log is refused.
    settings = {
        "vehanchor": version("vehanchor"),
        "segmenter": segmenter_sha256,
    }
    return Journal(path, settings, dump=MaskTrial.model_dump, load=MaskTrial.model_validate)


def _key(entry: AreaEntry) -> Key:
    """Identify an entry and the current state of its image and mask."""
    image_source = Source.of(entry.image)
    mask_source = Source.of(entry.mask_file)
    return (entry.name, *image_source, *mask_source)


def segment_entries(
    entries: Sequence[AreaEntry],
    segmenter: Segmenter,
    log: MaskLog,
    *,
    workers: int = 1,
    progress: Progress | None = None,
) -> tuple[dict[str, MaskTrial], list[FileIssue]]:
    """Segment the entries that the log lacks, each prompted by its box, and add them to the log.

    Args:
        entries: entries to segment.
        segmenter: the segmenter, shared by all workers.
        log: log for this segmenter.
        workers: images in parallel, each held in memory.
        progress: called with (entries done, total).

    Returns:
        The masks' figures by entry, and issues of entries and images that could not be segmented.
    """
    keys = {entry.name: _key(entry) for entry in entries}
    # Entries of one image are segmented together, so that each image is opened once.
    missing = [entry for entry in entries if keys[entry.name] not in log]
    missing.sort(key=_image)
    groups = [list(group) for _, group in itertools.groupby(missing, key=_image)]
    segment = partial(_segment_image, segmenter)
    issues: list[FileIssue] = []
    n_done = len(entries) - len(missing)
    with closing(finished(workers, segment, groups)) as results:
        for group, future in results:
            trials, image_issues = future.result()
            for trial in trials:
                log.add(keys[trial.entry], trial)
            issues += image_issues
            n_done += len(group)
            if progress is not None:
                progress(n_done, len(entries))
    logged = [log.get(key) for key in keys.values()]
    return {trial.entry: trial for trial in logged if trial is not None}, issues


def _image(entry: AreaEntry) -> Path:
    return entry.image


def _segment_image(
    segmenter: Segmenter, entries: Sequence[AreaEntry]
) -> tuple[list[MaskTrial], list[FileIssue]]:
    """Segment all entries of one image."""
    trials = []
    issues = []
    image = entries[0].image
    limits = DATASET_READING.limits
    try:
        with open_raster(image, DATASET_READING) as raster:
            for entry in entries:
                prompt = Prompt(box=entry.corners)
                try:
                    segmentation = segmenter.segment(raster, prompt, limits=limits, copy_px=0.0)
                except VehAnchorError as error:
                    message = f"{entry.name}: {error}"
                    issues.append(FileIssue(image, error.code, message))
                else:
                    trials.append(_mask_trial(entry, segmentation))
    except VehAnchorError as error:
        issues.append(FileIssue(image, error.code, str(error)))
    return trials, issues


def _mask_trial(entry: AreaEntry, segmentation: Segmentation) -> MaskTrial:
    return MaskTrial(
        entry=entry.name,
        mask_area_px=int(segmentation.mask.sum()),
        mask_score=segmentation.score,
        mask_iou=_iou(entry, segmentation),
    )


def _iou(entry: AreaEntry, segmentation: Segmentation) -> float:
    """Compute intersection over union of the true mask and the model's mask."""
    # The model's window and the entry's box can each extend beyond the other, so the masks are
    # compared where the two overlap.
    window = segmentation.window
    left = entry.left_px
    top = entry.top_px
    height, width = entry.mask.shape
    window_left = window.x_px
    window_top = window.y_px
    x1 = max(left, window_left)
    x2 = min(left + width, window_left + window.width_px)
    y1 = max(top, window_top)
    y2 = min(top + height, window_top + window.height_px)
    if x2 <= x1 or y2 <= y1:
        return 0.0
    true_rows = slice(y1 - top, y2 - top)
    true_columns = slice(x1 - left, x2 - left)
    model_rows = slice(y1 - window_top, y2 - window_top)
    model_columns = slice(x1 - window_left, x2 - window_left)
    true_part = entry.mask[true_rows, true_columns]
    model_part = segmentation.mask[model_rows, model_columns]
    n_both = int((model_part & true_part).sum())
    n_model = int(segmentation.mask.sum())
    n_either = n_model + entry.mask_area_px - n_both
    return n_both / n_either


def area_trials(
    entries: Sequence[AreaEntry],
    masks: Mapping[str, MaskTrial],
    scales: Mapping[Path, GsdEstimate],
) -> list[AreaTrial]:
    """Join masks and scales.

    Args:
        entries: the entries.
        masks: masks' figures by entry.
        scales: scales by image.

    Returns:
        Trials of the entries that have both, in the order of ``entries``.
    """
    trials = []
    for entry in entries:
        mask = masks.get(entry.name)
        scale = scales.get(entry.image)
        if mask is not None and scale is not None:
            trials.append(_area_trial(entry, mask, scale))
    return trials


def _area_trial(entry: AreaEntry, mask: MaskTrial, scale: GsdEstimate) -> AreaTrial:
    gsd = scale.gsd_m_per_px
    n_px = mask.mask_area_px
    # Without a mask or a scale, the areas that need it have no value, and count as errors of 100 %.
    end_to_end_m2 = None
    true_scale_m2 = None
    true_mask_m2 = None
    if n_px:
        true_scale_m2 = n_px * entry.gsd_m_per_px**2
    if gsd is not None:
        true_mask_m2 = entry.mask_area_px * gsd**2
        if n_px:
            end_to_end_m2 = n_px * gsd**2
    return AreaTrial(
        **mask.model_dump(),
        image=str(entry.image),
        category=entry.category,
        true_area_m2=entry.area_m2,
        true_gsd_m_per_px=entry.gsd_m_per_px,
        true_mask_area_px=entry.mask_area_px,
        gsd_m_per_px=gsd,
        scale_confidence=scale.confidence,
        n_vehicles=scale.n_vehicles or 0,
        end_to_end_m2=end_to_end_m2,
        true_scale_m2=true_scale_m2,
        true_mask_m2=true_mask_m2,
    )


def summarise_area(trials: Sequence[AreaTrial]) -> list[AreaErrors]:
    """Summarise trials as rows: end to end (all, scaled, confident), and each source of error."""
    scaled = [trial for trial in trials if trial.gsd_m_per_px is not None]
    usable = [trial for trial in trials if trial.scale_confidence >= USABLE_CHANCE]
    # With the true scale only the mask can be wrong, and with the true mask only the scale.
    true_scale = [(trial.category, trial.true_scale_m2, trial.true_area_m2) for trial in trials]
    true_mask = [(trial.category, trial.true_mask_m2, trial.true_area_m2) for trial in trials]
    return [
        area_errors("end to end", _end_to_end(trials)),
        area_errors("end to end, with a scale", _end_to_end(scaled)),
        area_errors(f"end to end, confidence >= {USABLE_CHANCE:g}", _end_to_end(usable)),
        area_errors("true scale (GT-GSD)", true_scale),
        area_errors("true mask (GT-mask)", true_mask),
    ]


def _end_to_end(trials: Sequence[AreaTrial]) -> list[AreaAnswer]:
    """List category, end-to-end area and true area."""
    return [(trial.category, trial.end_to_end_m2, trial.true_area_m2) for trial in trials]
