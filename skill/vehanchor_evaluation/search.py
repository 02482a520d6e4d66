"""Search for vehicles in many images, kept on disk.

An interrupted search resumes, and every table and figure uses the same boxes.
"""

from __future__ import annotations

import os
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, TypeAlias

from vehanchor.analysis.journal_classes import FORMER_NAMES, STORED_CLASSES
from vehanchor.analysis.pipeline import analyse_view, search_raster
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.detection.detections import Detections
from vehanchor.detection.detector import networks_sha256
from vehanchor.errors import InvalidParameterError, VehAnchorError
from vehanchor.imagery.detail import measure_detail_share
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import Lengths, ScaleOptions, Search
from vehanchor.rulers.active import needs_search
from vehanchor.rulers.camera_tilt import metadata_tilt
from vehanchor.rulers.ruler import View
from vehanchor.rulers.vehicles import select
from vehanchor.scale.defaults import OUTLIER_ALPHA
from vehanchor.storage.codec import Codec
from vehanchor.storage.journal import Journal, Source
from vehanchor_evaluation.known_scale import DATASET_READING, FileIssue
from vehanchor_evaluation.pool import finished

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detector import Detector
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.imagery.raster import Raster
    from vehanchor_evaluation.known_scale import KnownScaleSet

ABLATION_ALPHAS = (1.0, OUTLIER_ALPHA, None)  # paper, Table III
MAX_WORKERS = 4  # default; each holds an image in memory


@dataclass(frozen=True, eq=False)
class SearchedImage:
    """Search results for one image.

    Attributes:
        detections: the vehicles.
        image: size, own scale and notices of the file.
        detail_share: share of the pixels' resolution at which there is detail around the vehicles that
            the outlier filter keeps, by its factor; vehicles that nobody has looked for, as labels,
            need none.
        prior: the scene-scale prior; None without one.
    """

    detections: Detections
    image: ImageFacts
    detail_share: Mapping[float | None, float] = field(default_factory=dict)
    prior: SceneScalePrior | None = None

    def analysis(self, card: DetectorCard, options: ScaleOptions) -> ScaleAnalysis:
        """Estimate the scale from these vehicles.

        Raises:
            InvalidParameterError: the search did not measure the detail for this alpha.
            KnownLengthError: a line of known length leaves the image.
        """
        options = options.in_pixels(self.image.width_px, self.image.height_px)
        share = self.detail_share.get(options.lengths.alpha) if self.detail_share else 1.0
        if share is None:
            raise InvalidParameterError(
                f"searched without alpha {options.lengths.alpha}: search with these options"
            )
        tilt = metadata_tilt(self.image, options)
        return analyse_view(
            View(
                self.image,
                self.detections,
                card=card,
                options=options,
                measure_detail_share=lambda *_: share,
                prior=self.prior,
                tilt=tilt,
            )
        )


DetectionLog: TypeAlias = Journal[SearchedImage]


def default_workers() -> int:
    """Choose the number of images to search in parallel on this machine."""
    return min(MAX_WORKERS, os.cpu_count() or 1)


_FORM = 5  # of what is kept of an image: a log of another form is refused


def open_detection_log(
    path: Path | None,
    detector: Detector,
    options: ScaleOptions,
    classes: Sequence[str | int] | None = None,
) -> DetectionLog:
    """Open the log of earlier searches with the same detector and options.

    Args:
        path: path of the file; None keeps results in memory only.
        detector: the detector.
        options: options of the search; options of the later stages are ignored.
        classes: detector classes that count as vehicles; None for its default.

    Raises:
        InvalidParameterError: the file is not a log of this search.
        OutputError: the file cannot be read or written.
    """
    settings = {
        "vehanchor": version("vehanchor"),
        "form": _FORM,
        "networks_sha256": networks_sha256(detector.card),
        "classes": classes,
        "search": _of_full_search(options.search) if needs_search(options.rulers) else None,
        "bands": options.reading.bands,
    }
    return Journal(path, settings, dump=_dumped, load=_loaded)


def _of_full_search(chosen: Search) -> dict[str, Any]:
    """Select the options that affect a full search."""
    early = ("effort", "max_tiles", "max_seconds")
    return {name: value for name, value in asdict(chosen).items() if name not in early}


def _dumped(searched: SearchedImage) -> Any:
    return Codec(STORED_CLASSES, FORMER_NAMES).dump(
        (searched.detections, searched.image, list(searched.detail_share.items()), searched.prior)
    )


def _loaded(stored: Any) -> SearchedImage:
    detections, image, detail_share, prior = Codec(STORED_CLASSES, FORMER_NAMES).load(stored)
    return SearchedImage(detections, image, detail_share=dict(detail_share), prior=prior)


def search_images(
    images: Iterable[Path],
    detector: Detector,
    options: ScaleOptions,
    *,
    log: DetectionLog | None = None,
    workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[tuple[Path, SearchedImage | FileIssue]]:
    """Search the images that the log lacks; unusable images never stop the search.

    Args:
        images: distinct files.
        detector: the detector, shared by all workers.
        options: options of the search. Every tile is searched, so that tables do not depend on an
            early stop. The detail is also measured for ``options.lengths.alpha``.
        log: receives each result at once.
        workers: images searched in parallel, each held in memory.
        progress: called with (images done, total).

    Yields:
        Each file in order, with its results or with the reason why it could not be searched.
    """
    options = replace(
        options, search=replace(options.search, effort="full", max_tiles=None, max_seconds=None)
    )
    files = list(images)
    log = open_detection_log(None, detector, options) if log is None else log
    tell = progress or (lambda _done, _total: None)
    keys = {file: Source.of(file) for file in files}
    alphas = tuple(dict.fromkeys((*ABLATION_ALPHAS, options.lengths.alpha)))
    missing = [file for file in files if not _has_alphas(log.get(keys[file]), alphas)]
    issues: dict[Path, FileIssue] = {}
    tell(len(files) - len(missing), len(files))
    work = partial(_search, detector=detector, options=options, alphas=alphas)
    with closing(finished(workers, work, missing)) as results:
        for done, (file, future) in enumerate(results, start=len(files) - len(missing) + 1):
            found = future.result()
            if isinstance(found, FileIssue):
                issues[file] = found
            elif Source.of(file) != keys[file]:
                issues[file] = FileIssue(
                    file, "image_changed", "the file was changed or removed during the search"
                )
            else:
                log.add(keys[file], found)
            tell(done, len(files))
    for file in files:
        known = issues.get(file) or log.get(keys[file])
        assert known is not None  # found now or earlier
        yield file, known


def search_known_scale(
    data: KnownScaleSet,
    detector: Detector,
    options: ScaleOptions,
    *,
    classes: Sequence[str | int] | None = None,
    cache: Path | None = None,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> dict[Path, SearchedImage | FileIssue]:
    """Search all images that the cache lacks.

    Args:
        data: images of known scale, which belong to the user; the limits of ``DATASET_READING``
            apply.
        detector: the detector.
        options: options of the search.
        classes: detector classes that count as vehicles, as when the detector was opened.
        cache: log of the search, which lets a later run resume; None keeps no log.
        workers: images in parallel; None chooses a number.
        progress: called with (images done, total).

    Raises:
        InvalidParameterError: the cache is not a log of a search.
        OutputError: the cache cannot be read or written.
    """
    options = replace(options, reading=replace(options.reading, limits=DATASET_READING.limits))
    return dict(
        search_images(
            (image.path for image in data.images),
            detector,
            options,
            log=open_detection_log(cache, detector, options=options, classes=classes),
            workers=workers or default_workers(),
            progress=progress,
        )
    )


def _has_alphas(known: SearchedImage | None, alphas: Sequence[float | None]) -> bool:
    return known is not None and all(alpha in known.detail_share for alpha in alphas)


def _search(
    file: Path, detector: Detector, options: ScaleOptions, alphas: Sequence[float | None]
) -> SearchedImage | FileIssue:
    try:
        with open_raster(os.fspath(file), options.reading) as raster:
            view = search_raster(raster, detector, options)
            detail_share = {alpha: _detail_share(raster, view, alpha) for alpha in alphas}
            return SearchedImage(
                view.detections, view.image, detail_share=detail_share, prior=view.prior
            )
    except VehAnchorError as error:
        return FileIssue(file, error.code, str(error))


def _detail_share(raster: Raster, view: View, alpha: float | None) -> float:
    """The share of the resolution with detail around the vehicles that a factor of the outlier filter keeps."""
    expected = None if view.prior is None or view.tilt is not None else view.prior.density
    fleet = select(view.detections, Lengths(alpha=alpha), expected)
    return measure_detail_share(raster, fleet.centres, fleet.main_reduction or 1.0)
