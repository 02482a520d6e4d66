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
from vehanchor.rulers.fleet import select
from vehanchor.rulers.ruler import View
from vehanchor.scale.defaults import OUTLIER_ALPHA
from vehanchor.storage.codec import Codec
from vehanchor.storage.journal import Journal, Source
from vehanchor_evaluation.known_scale import DATASET_READING, FileIssue
from vehanchor_evaluation.pool import finished

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping
    from pathlib import Path

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detector import Detector
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.imagery.raster import Raster
    from vehanchor_evaluation.known_scale import KnownScaleSet

    Alphas: TypeAlias = tuple[float | None, ...]
    """Factors of the outlier filter; None switches it off."""

# Factors of the outlier filter in the paper's Table III.
ABLATION_ALPHAS = (1.0, OUTLIER_ALPHA, None)
# Default limit; each worker holds an image in memory.
MAX_WORKERS = 4


@dataclass(frozen=True, eq=False)
class SearchedImage:
    """Search results for one image.

    Attributes:
        detections: the vehicles.
        image: size, own scale and notices of the file.
        detail_share: share of the pixels' resolution at which the image has detail around the
            vehicles that the outlier filter keeps, by the filter's factor. Empty for labelled
            vehicles, which need none.
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
        options = options.in_pixels(self.image.grid)
        share = self._detail_share_of(options.lengths.alpha)
        view = View(
            self.image,
            self.detections,
            card=card,
            options=options,
            measure_detail_share=lambda *_: share,
            prior=self.prior,
            tilt=metadata_tilt(self.image, options),
        )
        return analyse_view(view)

    def _detail_share_of(self, alpha: float | None) -> float:
        """Look up the share for a factor of the outlier filter; 1 for labelled vehicles."""
        if not self.detail_share:
            return 1.0
        share = self.detail_share.get(alpha)
        if share is None:
            raise InvalidParameterError(
                f"searched without alpha {alpha}: search with these options"
            )
        return share


DetectionLog: TypeAlias = Journal[SearchedImage]


def default_workers() -> int:
    """Choose the number of images to search in parallel on this machine."""
    return min(MAX_WORKERS, os.cpu_count() or 1)


# Version of the stored results: the log of another version is refused.
_FORM = 5


def open_detection_log(
    path: Path | None, detector: Detector, options: ScaleOptions
) -> DetectionLog:
    """Open the log of earlier searches with the same detector and options.

    Args:
        path: path of the file; None keeps results in memory only.
        detector: the detector.
        options: options of the search; options of the later stages are ignored.

    Raises:
        InvalidParameterError: the file is not a log of this search.
        OutputError: the file cannot be read or written.
    """
    # Rulers that need no vehicles make the options of the search irrelevant.
    search_options = None
    if needs_search(options.rulers):
        search_options = _full_search_options(options.search)
    settings = {
        "vehanchor": version("vehanchor"),
        "form": _FORM,
        "networks_sha256": networks_sha256(detector.card),
        "classes": detector.classes,
        "search": search_options,
        "bands": options.reading.bands,
    }
    return Journal(path, settings, dump=_dump, load=_load)


def _full_search_options(search: Search) -> dict[str, Any]:
    """Select the options that affect a full search."""
    of_early_stop = ("effort", "max_tiles", "max_seconds")
    search_options = asdict(search)
    for name in of_early_stop:
        del search_options[name]
    return search_options


def _dump(searched: SearchedImage) -> Any:
    codec = Codec(STORED_CLASSES, FORMER_NAMES)
    detail_share = list(searched.detail_share.items())
    fields = (searched.detections, searched.image, detail_share, searched.prior)
    return codec.dump(fields)


def _load(stored: Any) -> SearchedImage:
    codec = Codec(STORED_CLASSES, FORMER_NAMES)
    detections, image, detail_share, prior = codec.load(stored)
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
    full_search = replace(options.search, effort="full", max_tiles=None, max_seconds=None)
    options = replace(options, search=full_search)
    files = list(images)
    if log is None:
        log = open_detection_log(None, detector, options)
    report_progress = progress or _report_nothing
    keys = {file: Source.of(file) for file in files}
    alphas = _alphas_to_measure(options)
    missing = [file for file in files if not _has_alphas(log.get(keys[file]), alphas)]
    issues: dict[Path, FileIssue] = {}
    n_done = len(files) - len(missing)
    report_progress(n_done, len(files))
    work = partial(_search, detector=detector, options=options, alphas=alphas)
    with closing(finished(workers, work, missing)) as results:
        for file, future in results:
            result = future.result()
            if isinstance(result, FileIssue):
                issues[file] = result
            elif Source.of(file) != keys[file]:
                # The results would be stored under the key of other pixels.
                message = "the file was changed or removed during the search"
                issues[file] = FileIssue(file, "image_changed", message)
            else:
                log.add(keys[file], result)
            n_done += 1
            report_progress(n_done, len(files))
    for file in files:
        outcome = issues.get(file) or log.get(keys[file])
        assert outcome is not None  # every file was searched now or in an earlier run
        yield file, outcome


def search_known_scale(
    data: KnownScaleSet,
    detector: Detector,
    options: ScaleOptions,
    *,
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
        cache: log of the search, which lets a later run resume; None keeps no log.
        workers: images in parallel; None chooses a number.
        progress: called with (images done, total).

    Raises:
        InvalidParameterError: the cache is not a log of a search.
        OutputError: the cache cannot be read or written.
    """
    reading = replace(options.reading, limits=DATASET_READING.limits)
    options = replace(options, reading=reading)
    results = search_images(
        [image.path for image in data.images],
        detector,
        options,
        log=open_detection_log(cache, detector, options),
        workers=workers or default_workers(),
        progress=progress,
    )
    return dict(results)


def _report_nothing(_done: int, _total: int) -> None:
    """Ignore the progress."""


def _alphas_to_measure(options: ScaleOptions) -> Alphas:
    """List the filter's factors of the paper and of the user, each once."""
    alphas = dict.fromkeys(ABLATION_ALPHAS)
    alphas[options.lengths.alpha] = None
    return tuple(alphas)


def _has_alphas(logged: SearchedImage | None, alphas: Alphas) -> bool:
    """Check whether an earlier run measured the detail for all these factors."""
    if logged is None:
        return False
    return all(alpha in logged.detail_share for alpha in alphas)


def _search(
    file: Path,
    detector: Detector,
    options: ScaleOptions,
    alphas: Alphas,
) -> SearchedImage | FileIssue:
    """Search one image, or state why it could not be searched."""
    try:
        with open_raster(os.fspath(file), options.reading) as raster:
            view = search_raster(raster, detector, options)
            # Detail is measured in the pixels, which later estimates no longer have.
            detail_share = {}
            for alpha in alphas:
                detail_share[alpha] = _detail_share(raster, view, alpha)
            return SearchedImage(
                view.detections,
                view.image,
                detail_share=detail_share,
                prior=view.prior,
            )
    except VehAnchorError as error:
        return FileIssue(file, error.code, str(error))


def _detail_share(raster: Raster, view: View, alpha: float | None) -> float:
    """Measure the share of the resolution with detail around the vehicles kept with this alpha."""
    # The prior of a scene's scale holds for one scale, and a tilted photograph has many.
    expected = None
    if view.prior is not None and view.tilt is None:
        expected = view.prior.density
    fleet = select(view.detections, Lengths(alpha=alpha), expected)
    reduction = fleet.main_reduction or 1.0
    return measure_detail_share(raster, fleet.centres, reduction)
