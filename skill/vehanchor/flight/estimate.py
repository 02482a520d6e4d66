"""The scales of a flight: every photograph looked at once, then all of the evidence together."""

from __future__ import annotations

import os
from collections.abc import Sequence, Sized
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.analysis.pipeline import analyse_view, checked_detector, search_raster
from vehanchor.detection.networks import networks_sha256
from vehanchor.errors import ImageError, InvalidParameterError, VehAnchorError
from vehanchor.flight.components import single_component
from vehanchor.flight.features import find_features
from vehanchor.flight.inputs import InputPhotograph, check_many, named
from vehanchor.flight.linking import link_photographs
from vehanchor.flight.photograph import Look, Photograph, chief_member, look_codec
from vehanchor.flight.record import Failure, conclude_flight
from vehanchor.imagery.identity import Source
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ScaleOptions
from vehanchor.rulers.known_length_table import with_lines_of
from vehanchor.rulers.measurement import with_tilt
from vehanchor.storage.journal import Journal, Key

if TYPE_CHECKING:
    from collections.abc import Iterable

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detector import Detector
    from vehanchor.flight.features import Features
    from vehanchor.imagery.sources.opening import ImageSource
    from vehanchor.records import FlightEstimate
    from vehanchor.rulers.known_length_table import KnownLengthTable


def analyse_flight(
    images: Iterable[ImageSource | InputPhotograph],
    detector: Detector,
    options: ScaleOptions,
    *,
    same_scale: bool = False,
    journal: str | os.PathLike[str] | None = None,
    lines: KnownLengthTable | None = None,
) -> FlightEstimate:
    """Estimate the scales of many photographs of one flight; see ``Engine.flight``.

    Args:
        images: the photographs, in the order in which they were taken.
        detector: finds the vehicles; photographs are reported to the progress of its runtime.
        options: of the method.
        same_scale: pool the evidence of all photographs.
        journal: file that keeps what was found.
        lines: of known length in single photographs, which are paths or addresses; see ``read_known_lengths``.

    Raises:
        VehAnchorError: as ``Engine.flight``.
    """
    check_many(images)
    check_options(options)
    checked_detector(detector, options)
    taken = list(named(images)) if isinstance(images, Sequence) else named(images)
    kept = None if journal is None else open_journal(Path(journal), detector, options, lines or {})
    looks = search_flight(taken, detector, options, featured=not same_scale, journal=kept, lines=lines or {})
    record = conclude(looks, detector.card, same_scale=same_scale)
    if kept is not None:
        kept.remove()
    return record


def conclude(looks: Sequence[Photograph | Failure], card: DetectorCard, *, same_scale: bool) -> FlightEstimate:
    """Conclude from photographs that were looked at, with their features unless they are of one scale."""
    places = [place for place, look in enumerate(looks) if isinstance(look, Photograph)]
    members = [look for look in looks if isinstance(look, Photograph)]
    if same_scale:
        return conclude_flight(looks, [single_component(places, chief_member(members))], card, same_scale=True)
    linked = link_photographs(members, [each.features for each in members if each.features is not None])
    components = [replace(component, members=np.asarray(places)[component.members]) for component in linked.components]
    return conclude_flight(looks, components, card, same_scale=False, links=linked.links)


def search_flight(
    taken: Iterable[InputPhotograph],
    detector: Detector,
    options: ScaleOptions,
    *,
    featured: bool = False,
    journal: Journal[Look] | None = None,
    lines: KnownLengthTable | None = None,
) -> list[Photograph | Failure]:
    """Look at every photograph, one after the other.

    Args:
        taken: the photographs, one held at a time.
        detector: finds the vehicles. The progress of its runtime gets (photographs done, photographs in all); the
            length of a video is unknown, and both numbers are the same.
        options: every choice of the method.
        featured: whether features are wanted, by which photographs find those that overlap.
        journal: what was found before; takes what is found now, at once.
        lines: of known length in single photographs.

    Returns:
        Each photograph with what it says by itself, or why it cannot be used.

    Raises:
        ImageError: there is none, or none that can be used.
    """
    tell, silent = detector.runtime.tell, detector.under(replace(detector.runtime, progress=None))
    found: list[Photograph | Failure] = []
    total = len(taken) if isinstance(taken, Sized) else 0
    for done, each in enumerate(taken):
        name, image, _ = each
        tell(done, max(total, done))
        key = journal_key(each)
        known = journal.get(key) if journal is not None and key is not None else None
        try:
            own = with_lines_of(options, lines, image) if lines and isinstance(image, str | os.PathLike) else options
            look, features = _look(each, silent, own, known, featured=featured)
        except VehAnchorError as error:
            found.append(Failure(name, error))
            continue
        if known is None and journal is not None and key is not None and key == journal_key(each):
            journal.add(key, look)
        found.append(Photograph.of(name, look, detector.card, own, features))
    tell(len(found), len(found))
    if not found:
        raise ImageError("no photograph given: name at least one")
    failures = [each for each in found if isinstance(each, Failure)]
    if len(failures) == len(found):
        raise failures[0].error
    return found


def _look(
    taken: InputPhotograph,
    detector: Detector,
    options: ScaleOptions,
    known: Look | None,
    *,
    featured: bool,
) -> tuple[Look, Features | None]:
    """Look at one photograph; where that is known already, only at its features, which are quickly found again."""
    if known is not None and not featured:
        return known, None
    reading = options.reading
    bgr = reading.bgr and taken.film is None  # a film's frames are RGB here, whatever the caller's arrays are
    with open_raster(taken.image, bands=reading.bands, limits=reading.limits, bgr=bgr) as raster:
        features = find_features(raster) if featured else None
        if known is not None:
            return known, features
        view = with_tilt(search_raster(raster, detector, options))
        return Look.of(view, analyse_view(view)), features


def check_options(options: ScaleOptions) -> None:
    """Refuse options that belong to one image.

    Raises:
        InvalidParameterError: a frame, or a line of known length.
    """
    if options.frame.size is not None:
        raise InvalidParameterError("a frame belongs to one image: a flight has none")
    if options.rulers.known_lengths:
        raise InvalidParameterError("a line of known length belongs to one image: estimate that image by itself")


def journal_key(taken: InputPhotograph) -> Key | None:
    """Key of a photograph in the journal: its name and its file as it is now; None without a file."""
    file = taken.image if taken.film is None else taken.film
    return (taken.name, *Source.of(file)) if isinstance(file, str | os.PathLike) else None


def open_journal(path: Path, detector: Detector, options: ScaleOptions, lines: KnownLengthTable) -> Journal[Look]:
    """Open the findings of an interrupted run.

    Raises:
        InvalidParameterError: they are those of other options, or the file is no journal.
        OutputError: it cannot be read or written.
    """
    choices = asdict(options)
    del choices["frame"]
    if lines:
        choices["lines_of"] = lines
    networks = networks_sha256(detector.card)
    settings = {"vehanchor": version("vehanchor"), "networks_sha256": networks, "flight": 1, **choices}
    remedy = "move the file away, or name another"
    codec = look_codec()
    return Journal(path, settings, dump=codec.dump, load=codec.load, sole=True, remedy=remedy)
