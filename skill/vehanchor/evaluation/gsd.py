"""Error of the estimated scale on images of known scale."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.errors import InvalidParameterError
from vehanchor.perception import ScaleAnalysis, ScaleOptions, analyse_scale

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from vehanchor.detection import Detector

__all__ = ["ErrorSummary", "KnownScaleImage", "ScaleTrial", "read_table", "run_trials", "summarise"]


class KnownScaleImage(NamedTuple):
    """One row of a table of images whose scale is known.

    Attributes:
        path: the image.
        gsd_m_per_px: its true ground sampling distance.
        set: the set it belongs to, or an empty string.
        split: ``train``, ``val`` or an empty string.
        labelled_vehicles: number of labelled small vehicles, None where unknown.
    """

    path: Path
    gsd_m_per_px: float
    set: str = ""
    split: str = ""
    labelled_vehicles: int | None = None


def read_table(path: Path) -> list[KnownScaleImage]:
    """Read a CSV with the columns ``file`` (relative to the table) and ``gsd_m_per_px``; ``set``, ``split`` and
    ``labelled_small_vehicles`` are read where they are given.

    Raises:
        InvalidParameterError: a column is missing or a scale is not a positive number; the message names the line.
        OSError: the table cannot be read.
    """  # noqa: D205 - the columns belong together
    images = []
    with path.open(newline="", encoding="utf-8") as handle:
        for number, row in enumerate(csv.DictReader(handle), start=2):
            try:
                gsd = float(row["gsd_m_per_px"])
                file = row["file"]
                vehicles = row.get("labelled_small_vehicles")
                count = int(vehicles) if vehicles else None
            except (KeyError, TypeError, ValueError) as error:
                raise InvalidParameterError(f"{path}, line {number}: expected file,gsd_m_per_px ({error})") from None
            if not (math.isfinite(gsd) and gsd > 0):
                raise InvalidParameterError(f"{path}, line {number}: gsd_m_per_px is {gsd}, not a positive number")
            images.append(KnownScaleImage(path.parent / file, gsd, row.get("set") or "", row.get("split") or "", count))
    return images


@dataclass(frozen=True, eq=False)
class ScaleTrial:
    """What the pipeline said about one image of known scale."""

    image: KnownScaleImage
    analysis: ScaleAnalysis

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
    chosen = list(trials)
    if not chosen:
        return ErrorSummary(0, *(math.nan,) * 6)
    errors = np.array([trial.error for trial in chosen])
    signed = np.array([trial.signed_error for trial in chosen])
    known = np.isfinite(signed)
    return ErrorSummary(
        len(chosen),
        float(known.mean()),
        float(np.median(errors)),
        float(errors.mean()),
        float((errors < 0.10).mean()),
        float((errors < 0.20).mean()),
        float(np.median(signed[known])) if known.any() else math.nan,
    )
