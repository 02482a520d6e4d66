"""Steps of a flight: search each photograph once, then pool the evidence."""

from __future__ import annotations

import os
from collections.abc import Sequence, Sized
from contextlib import contextmanager
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.analysis.pipeline import analyse_view, search_raster
from vehanchor.detection.detector import networks_sha256
from vehanchor.errors import ImageError, InvalidParameterError, VehAnchorError
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.tiles import read_preview
from vehanchor.options import ScaleOptions
from vehanchor.rulers.known_length_table import with_lines_of
from vehanchor.storage.journal import Journal, Key, Source
from vehanchor_flight.components import single_component
from vehanchor_flight.features import find_features
from vehanchor_flight.inputs import InputPhotograph
from vehanchor_flight.linking import link_photographs
from vehanchor_flight.photograph import Photograph, StoredPhotograph, chief_member, photograph_codec
from vehanchor_flight.record import Failure, conclude_flight

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.typing import NDArray

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detector import Detector
    from vehanchor.imagery.raster import Raster
    from vehanchor.rulers.known_length_table import KnownLengthTable
    from vehanchor_flight.features import Features
    from vehanchor_flight.records import FlightEstimate

_REDUCED_PX = 32
_READ_PX = 512  # long side that is read, at least
_MOST_DIFFERENT = 3.0  # grey levels on average, a choice: JPEG and resampling change about 1
_SAME_SHAPE = 0.01  # relative, of copies


def conclude(
    results: Sequence[Photograph | Failure], card: DetectorCard, *, same_scale: bool
) -> FlightEstimate:
    """Make the record of searched photographs; without ``same_scale`` they need features."""
    places = [place for place, result in enumerate(results) if isinstance(result, Photograph)]
    members = [result for result in results if isinstance(result, Photograph)]
    if same_scale:
        return conclude_flight(
            results, [single_component(places, chief_member(members))], card, same_scale=True
        )
    linked, links = link_photographs(
        members, [each.features for each in members if each.features is not None]
    )
    components = [
        replace(component, members=np.asarray(places)[component.members]) for component in linked
    ]
    return conclude_flight(results, components, card, same_scale=False, links=links)


def search_flight(
    taken: Iterable[InputPhotograph],
    detector: Detector,
    options: ScaleOptions,
    *,
    featured: bool = False,
    journal: Journal[StoredPhotograph] | None = None,
    lines: KnownLengthTable | None = None,
) -> list[Photograph | Failure]:
    """Search the photographs one by one.

    Args:
        taken: the photographs, one held at a time.
        detector: finds the vehicles. The progress of its runtime gets (photographs done,
            photographs in all); both numbers are the same for a video, whose length is unknown.
        options: all options of the method.
        featured: whether to find the features that link overlapping photographs.
        journal: earlier results; each new result is added at once.
        lines: lines of known length by photograph.

    Returns:
        Each photograph with its own analysis, or its error; of several sizes of one, the largest.

    Raises:
        ImageError: no photograph is given, or none can be used.
    """
    tell = detector.runtime.tell
    silent = detector.under(replace(detector.runtime, progress=None))
    found: list[Photograph | Failure] = []
    total = len(taken) if isinstance(taken, Sized) else 0
    for done, each in enumerate(taken):
        name, image, _ = each
        tell(done, max(total, done))
        key = journal_key(each)
        known = journal.get(key) if journal is not None and key is not None else None
        try:
            own = (
                with_lines_of(options, lines, image)
                if lines and isinstance(image, str | os.PathLike)
                else options
            )
            result, features = _search(each, silent, own, known, featured=featured)
        except VehAnchorError as error:
            found.append(Failure(name, error))
            continue
        if known is None and journal is not None and key is not None and key == journal_key(each):
            journal.add(key, result)
        found.append(Photograph.of(name, result, detector.card, own, features))
    tell(len(found), len(found))
    if not found:
        raise ImageError("no photograph given: name at least one")
    failures = [each for each in found if isinstance(each, Failure)]
    if len(failures) == len(found):
        raise failures[0].error
    return without_copies(found)


def _search(
    taken: InputPhotograph,
    detector: Detector,
    options: ScaleOptions,
    known: StoredPhotograph | None,
    *,
    featured: bool,
) -> tuple[StoredPhotograph, Features | None]:
    """Search one photograph and find its features; a known photograph needs its features only."""
    if known is not None and not featured:
        return known, None
    # a video's frames are RGB
    reading = options.reading if taken.film is None else replace(options.reading, bgr=False)
    with open_raster(taken.image, reading) as raster:
        features = find_features(raster) if featured else None
        if known is not None:
            return known, features
        view = search_raster(raster, detector, options)
        kept = StoredPhotograph.of(view, analyse_view(view))
        return replace(kept, reduced=reduced_picture(raster)), features


def reduced_picture(raster: Raster) -> NDArray[np.uint8]:
    """Reduce an image to ``[32, 32]`` grey levels."""
    factor = max(1, max(raster.width_px, raster.height_px) // _READ_PX)
    whole = Window(
        0,
        0,
        width_px=max(1, raster.width_px // factor),
        height_px=max(1, raster.height_px // factor),
    )
    grey = cv2.cvtColor(read_preview(raster, whole, factor), cv2.COLOR_RGB2GRAY)
    return np.asarray(
        cv2.resize(grey, (_REDUCED_PX, _REDUCED_PX), interpolation=cv2.INTER_AREA), np.uint8
    )


def without_copies(found: Sequence[Photograph | Failure]) -> list[Photograph | Failure]:
    """Keep the largest of several sizes of a photograph; the others become failures that name it."""
    kept = list(found)
    photographs = [
        (place, each) for place, each in enumerate(found) if isinstance(each, Photograph)
    ]
    largest: list[Photograph] = []
    for place, each in sorted(photographs, key=lambda one: -one[1].view.image.width_px):
        original = next((other for other in largest if _is_copy(each, other)), None)
        if original is None:
            largest.append(each)
        else:
            error = ImageError(f"it is a smaller copy of {original.name!r}, which counts once")
            kept[place] = Failure(each.name, error)
    return kept


def _is_copy(small: Photograph, large: Photograph) -> bool:
    one = small.view.image
    other = large.view.image
    shape = one.width_px * other.height_px / (one.height_px * other.width_px)
    if (
        one.width_px == other.width_px
        or abs(shape - 1) > _SAME_SHAPE
        or small.reduced is None
        or large.reduced is None
    ):
        return False
    return float(np.abs(small.reduced.astype(float) - large.reduced).mean()) <= _MOST_DIFFERENT


def check_options(options: ScaleOptions) -> None:
    """Check that no option belongs to a single image.

    Raises:
        InvalidParameterError: a frame, a line of known length, or vehicles by hand.
    """
    if options.frame.size is not None:
        raise InvalidParameterError("a frame belongs to one image: leave it out for a flight")
    if options.rulers.known_lengths:
        raise InvalidParameterError(
            "a line of known length belongs to one image: estimate that image by itself"
        )
    options.by_hand.check_single()


def journal_key(taken: InputPhotograph) -> Key | None:
    """Make the journal key of a photograph from its name and the state of its file; None without a file."""
    file = taken.image if taken.film is None else taken.film
    return (taken.name, *Source.of(file)) if isinstance(file, str | os.PathLike) else None


@contextmanager
def resumed(
    path: str | os.PathLike[str] | None,
    detector: Detector,
    options: ScaleOptions,
    lines: KnownLengthTable,
    *,
    model_sha256: str = "",
) -> Iterator[Journal[StoredPhotograph] | None]:
    """Open the journal of a flight or of a reconstruction's photographs, and remove it at the end.

    Args:
        path: the file; None for no journal.
        detector: finds the vehicles.
        options: of the method.
        lines: lines of known length by photograph.
        model_sha256: checksum of the reconstruction; empty for a flight.

    Yields:
        The journal, which stays if the block raises; None without one.

    Raises:
        InvalidParameterError: the journal has results of other options, or the file is no journal.
        OutputError: it cannot be read or written.
    """
    if path is None:
        yield None
        return
    choices = asdict(options)
    del choices["frame"]
    if lines:
        choices["lines_of"] = {name: [asdict(line) for line in own] for name, own in lines.items()}
    if model_sha256:
        choices["reconstruction"] = model_sha256
    networks = networks_sha256(detector.card)
    settings = {
        "vehanchor": version("vehanchor"),
        "networks_sha256": networks,
        "flight": 1,
        **choices,
    }
    remedy = "move the file away, or name another"
    codec = photograph_codec()
    with Journal(
        Path(path), settings, dump=codec.dump, load=codec.load, sole=True, remedy=remedy
    ) as journal:
        yield journal
        journal.remove()
