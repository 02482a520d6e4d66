"""One detection pass over many images, kept on disk: an interrupted pass goes on where it stopped, and every table and
figure is made from the same boxes.
"""  # noqa: D205 - one sentence

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, fields
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.detection.detector import Detections
from vehanchor.errors import OutputError, VehAnchorError
from vehanchor.estimate import ScaleAnalysis, ScaleOptions, analyse_raster, raster_notices, scale_from_detections
from vehanchor.imagery.raster import open_raster
from vehanchor.records import Notice
from vehanchor_evaluation.known_scale import FileIssue

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from pathlib import Path

    from vehanchor.detection.detector import Detector, DetectorCard

__all__ = ["DetectionLog", "SearchedImage", "search_images", "search_settings"]

_AFTER_SEARCH = {  # options that only the second half of the skill reads: one search serves all their values
    "alpha", "aggregation", "reference_length_m", "region", "calibration", "frame_width_px", "frame_height_px",
    "limits",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class SearchedImage:
    """What the first half of the skill found in one image.

    Attributes:
        detections: the vehicles.
        width_px: width of the image.
        height_px: its height.
        georeference_gsd_m_per_px: the scale that the file carries.
        notices: what opening it had to tell.
        resolved: share of the pixels' resolution at which there is detail around the vehicles.
    """

    detections: Detections
    width_px: int
    height_px: int
    georeference_gsd_m_per_px: float | None = None
    notices: tuple[Notice, ...] = ()
    resolved: float = 1.0

    def analysis(self, card: DetectorCard, options: ScaleOptions) -> ScaleAnalysis:
        """The second half of the skill on these vehicles."""
        return scale_from_detections(
            self.detections,
            card,
            options,
            image_width_px=self.width_px,
            image_height_px=self.height_px,
            georeference_gsd_m_per_px=self.georeference_gsd_m_per_px,
            notices=self.notices,
            resolved=self.resolved,
        )


def search_settings(detector: Detector, options: ScaleOptions, classes: Sequence[str] | None = None) -> str:
    """A hash of all that the vehicles found depend on, but for the image."""
    chosen = {field.name: getattr(options, field.name) for field in fields(options) if field.name not in _AFTER_SEARCH}
    facts = {"version": version("vehanchor"), "model": detector.card.sha256, "classes": classes, **chosen}
    return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()[:16]


class DetectionLog:
    """Searched images on disk, one JSON object a line, keyed by file and settings.

    A line that was cut short by an interruption is ignored, and so is one whose file has changed since.

    Args:
        path: of the file; None keeps nothing.
        settings: what ``search_settings`` gave.

    Raises:
        OutputError: the file cannot be read or written.
    """

    def __init__(self, path: Path | None, settings: str) -> None:
        self._path, self._settings = path, settings
        self._known: dict[tuple[str, int, int], SearchedImage] = {}
        if path is None:
            return
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("a+b") as handle:
                handle.seek(0)
                complete = True
                for line in handle:
                    complete = line.endswith(b"\n")
                    self._take(line)
                if not complete:
                    handle.write(b"\n")
        except OSError as error:
            raise OutputError(f"cannot use {str(path)!r}: {error.strerror or error}") from error

    def __len__(self) -> int:
        return len(self._known)

    def _take(self, line: bytes) -> None:
        with contextlib.suppress(ValueError, KeyError, TypeError):
            record = json.loads(line)
            if record["settings"] == self._settings:
                self._known[record["file"], record["bytes"], record["modified_ns"]] = _searched(record)

    def get(self, image: Path) -> SearchedImage | None:
        """What is known of an image as it is now."""
        try:
            return self._known.get(_key(image))
        except OSError:
            return None

    def add(self, image: Path, searched: SearchedImage) -> None:
        """Keep what was found in an image.

        Raises:
            OutputError: the file cannot be written.
        """
        key = _key(image)
        self._known[key] = searched
        if self._path is None:
            return
        record = {"file": key[0], "bytes": key[1], "modified_ns": key[2], "settings": self._settings}
        try:
            with self._path.open("a", encoding="utf-8") as handle:
                handle.write(json.dumps(record | _record(searched)) + "\n")
        except OSError as error:
            raise OutputError(f"cannot write {str(self._path)!r}: {error.strerror or error}") from error


def _key(image: Path) -> tuple[str, int, int]:
    facts = image.stat()
    return str(image.resolve()), facts.st_size, facts.st_mtime_ns


def _record(searched: SearchedImage) -> dict[str, Any]:
    found = searched.detections
    return {
        "boxes": found.boxes.tolist(),
        "scores": found.scores.tolist(),
        "n_tiles": found.n_tiles,
        "n_capped_tiles": found.n_capped_tiles,
        "scales": None if found.scales is None else found.scales.tolist(),
        "fleet_log_odds": None if found.fleet_log_odds is None else found.fleet_log_odds.tolist(),
        "width_px": searched.width_px,
        "height_px": searched.height_px,
        "georeference_gsd_m_per_px": searched.georeference_gsd_m_per_px,
        "resolved": searched.resolved,
        "notices": [notice.model_dump() for notice in searched.notices],
    }


def _searched(record: dict[str, Any]) -> SearchedImage:
    return SearchedImage(
        Detections(
            np.array(record["boxes"], dtype=np.float64).reshape(-1, 5),
            np.array(record["scores"], dtype=np.float64),
            record["n_tiles"],
            record["n_capped_tiles"],
            None if record["scales"] is None else np.array(record["scales"], dtype=np.float64),
            None if record["fleet_log_odds"] is None else np.array(record["fleet_log_odds"], dtype=np.float64),
        ),
        record["width_px"],
        record["height_px"],
        record["georeference_gsd_m_per_px"],
        tuple(Notice(**notice) for notice in record["notices"]),
        record["resolved"],
    )


def search_images(
    images: Iterable[Path],
    detector: Detector,
    options: ScaleOptions,
    *,
    log: DetectionLog | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[tuple[Path, SearchedImage | FileIssue]]:
    """Search images that the log does not know yet; an image that cannot be used never stops the pass.

    Args:
        images: the files, each once.
        detector: the model, shared by all workers.
        options: of the search; what only the second half reads does not matter.
        log: takes what is found, at once.
        workers: images searched at the same time, each held in memory.
        progress: called with (images done, images in all).

    Yields:
        Each file with what was found, in order; or with why it could not be searched.
    """
    files = list(images)
    if log is None:
        log = DetectionLog(None, "")
    waiting: dict[Future[SearchedImage | FileIssue], Path] = {}
    issues: dict[Path, FileIssue] = {}
    with ThreadPoolExecutor(max_workers=workers) as pool:
        try:
            for file in files:
                if log.get(file) is None:
                    waiting[pool.submit(_search, file, detector, options)] = file
            done = len(files) - len(waiting)
            while waiting:
                if progress:
                    progress(done, len(files))
                finished, _ = wait(waiting, return_when=FIRST_COMPLETED)
                for future in finished:
                    file, result = waiting.pop(future), future.result()
                    done += 1
                    if isinstance(result, FileIssue):
                        issues[file] = result
                    else:
                        log.add(file, result)
        finally:
            pool.shutdown(cancel_futures=True)
    if progress:
        progress(len(files), len(files))
    for file in files:
        known = issues.get(file) or log.get(file)
        yield file, known or FileIssue(file, "image_changed", "the file was changed or removed during the search")


def _search(file: Path, detector: Detector, options: ScaleOptions) -> SearchedImage | FileIssue:
    try:
        with open_raster(os.fspath(file), bands=options.bands, limits=options.limits) as raster:
            analysis = analyse_raster(raster, detector, options)
            notices = raster_notices(raster)
    except VehAnchorError as error:
        return FileIssue(file, error.code, str(error))
    estimate = analysis.estimate
    return SearchedImage(
        analysis.detections,
        estimate.image_width_px,
        estimate.image_height_px,
        estimate.georeference_gsd_m_per_px,
        notices,
        analysis.resolved,
    )
