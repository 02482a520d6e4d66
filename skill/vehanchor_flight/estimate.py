"""Steps of a flight: search each photograph once, then pool the evidence."""

from __future__ import annotations

import os
from collections.abc import Sized
from contextlib import contextmanager
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.analysis.pipeline import analyse_view, search_raster
from vehanchor.detection.detector import networks_sha256
from vehanchor.errors import ImageError, InvalidParameterError, VehAnchorError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ScaleOptions
from vehanchor.rulers.known_length_table import with_lines_of
from vehanchor.storage.journal import Journal, Key, Source
from vehanchor_flight.components import placements_by_ground, single_component
from vehanchor_flight.copies import reduced_picture, without_copies
from vehanchor_flight.features import find_features
from vehanchor_flight.inputs import InputPhotograph
from vehanchor_flight.linking import link_photographs
from vehanchor_flight.photograph import (
    Photograph,
    StoredPhotograph,
    photograph_codec,
    reference_member,
)
from vehanchor_flight.record import Failure, conclude_flight
from vehanchor_flight.same_scale import check_same_scale, check_straight_down

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detector import Detector
    from vehanchor.rulers.known_length_table import KnownLengthTable
    from vehanchor_flight.features import Features
    from vehanchor_flight.record import Results
    from vehanchor_flight.records import FlightEstimate


def conclude(results: Results, card: DetectorCard, *, same_scale: bool) -> FlightEstimate:
    """Make the record of searched photographs, which need features.

    Raises:
        InvalidParameterError: the photographs contradict the claim that they have one scale.
    """
    indices = []
    members = []
    for index, result in enumerate(results):
        if isinstance(result, Photograph):
            indices.append(index)
            members.append(result)
    features = [member.features for member in members if member.features is not None]
    linked, links = link_photographs(members, features)
    if same_scale:
        check_straight_down(members)
        check_same_scale(members, linked)
        # One scale is stated, but pictures of the same ground are one witness of it.
        component = single_component(
            indices, reference_member(members), placements_by_ground(linked)
        )
        return conclude_flight(results, [component], card, same_scale=True)
    # Linking counts the usable photographs only; the record counts all.
    indices_of_usable = np.asarray(indices)
    components = []
    for component in linked:
        members_of_flight = indices_of_usable[component.members]
        components.append(replace(component, members=members_of_flight))
    return conclude_flight(results, components, card, same_scale=False, links=links)


def search_flight(
    inputs: Iterable[InputPhotograph],
    detector: Detector,
    options: ScaleOptions,
    *,
    featured: bool = False,
    journal: Journal[StoredPhotograph] | None = None,
    lines: KnownLengthTable | None = None,
) -> list[Photograph | Failure]:
    """Search the photographs one by one.

    Args:
        inputs: the photographs, one held at a time.
        detector: finds the vehicles. The progress of its runtime receives (photographs done,
            photographs in all); both numbers are the same for a video, whose length is unknown.
        options: all options of the method.
        featured: whether to find the features that link overlapping photographs.
        journal: earlier results; each new result is added at once.
        lines: lines of known length by photograph.

    Returns:
        Each photograph with its own analysis, or its error. Of several sizes of one photograph,
        only the largest counts.

    Raises:
        ImageError: no photograph is given, or none can be used.
    """
    report_progress = detector.runtime.report_progress
    silent_runtime = replace(detector.runtime, progress=None)
    silent_detector = detector.under(silent_runtime)
    results: list[Photograph | Failure] = []
    # An iterator, such as that of a video, has no length.
    n_photographs = 0
    if isinstance(inputs, Sized):
        n_photographs = len(inputs)
    for n_done, photograph in enumerate(inputs):
        report_progress(n_done, max(n_photographs, n_done))
        own_options = options
        key = journal_key(photograph)
        stored = None
        if journal is not None and key is not None:
            stored = journal.get(key)
        try:
            if lines and isinstance(photograph.image, str | os.PathLike):
                own_options = with_lines_of(options, lines, photograph.image)
            result, features = _search(
                photograph,
                silent_detector,
                options=own_options,
                stored=stored,
                featured=featured,
            )
        except VehAnchorError as error:
            results.append(Failure(photograph.name, error))
            continue
        if (
            journal is not None
            and stored is None
            and key is not None
            # A file that was replaced during its search has another key now.
            and key == journal_key(photograph)
        ):
            journal.add(key, result)
        searched = Photograph.of(photograph.name, result, detector.card, own_options, features)
        if photograph.film is not None:
            searched = replace(searched, is_frame=True)
        results.append(searched)
    report_progress(len(results), len(results))
    if not results:
        raise ImageError("no photograph given: name at least one")
    failures = [result for result in results if isinstance(result, Failure)]
    if len(failures) == len(results):
        raise failures[0].error
    return without_copies(results)


def _search(
    photograph: InputPhotograph,
    detector: Detector,
    options: ScaleOptions,
    stored: StoredPhotograph | None,
    *,
    featured: bool,
) -> tuple[StoredPhotograph, Features | None]:
    """Search one photograph and find its features; a stored one needs its features only."""
    if stored is not None and not featured:
        return stored, None
    reading = options.reading
    if photograph.film is not None:
        # The option ``bgr`` describes the caller's arrays; frames of a video are RGB.
        reading = replace(reading, bgr=False)
    with open_raster(photograph.image, reading) as raster:
        if photograph.camera is not None:
            raster.camera = photograph.camera
        features = None
        if featured:
            features = find_features(raster)
        if stored is not None:
            return stored, features
        view = search_raster(raster, detector, options)
        analysis = analyse_view(view)
        result = StoredPhotograph.of(view, analysis)
        reduced = reduced_picture(raster)
        return replace(result, reduced=reduced), features


def check_options(options: ScaleOptions) -> None:
    """Check that no option belongs to a single image.

    Raises:
        InvalidParameterError: a frame, a line of known length, or vehicles by hand.
    """
    if options.frame.size is not None:
        raise InvalidParameterError("a frame belongs to one image: leave it out for a flight")
    options.check_for_several_images()


def journal_key(photograph: InputPhotograph) -> Key | None:
    """Make the journal key of a photograph from its name and the state of its file.

    Returns:
        The key; None for a photograph without a file.
    """
    file = photograph.image if photograph.film is None else photograph.film
    if not isinstance(file, str | os.PathLike):
        return None
    name = photograph.name
    # Subtitles that change, or that are found later, make another result.
    if photograph.camera is not None:
        name = f"{name} with {photograph.camera}"
    return (name, *Source.of(file))


@contextmanager
def resumable_journal(
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
        InvalidParameterError: the journal has results of other options, or the file is not a
            journal.
        OutputError: it cannot be read or written.
    """
    if path is None:
        yield None
        return
    settings = {
        "vehanchor": version("vehanchor"),
        "networks_sha256": networks_sha256(detector.card),
        "flight": 1,
        **asdict(options),
    }
    del settings["frame"]
    # Journals of runs with the model's own classes have no such setting.
    if detector.classes is not None:
        settings["classes"] = detector.classes
    if lines:
        settings["lines_of"] = {
            photograph: [asdict(line) for line in own_lines]
            for photograph, own_lines in lines.items()
        }
    if model_sha256:
        settings["reconstruction"] = model_sha256
    codec = photograph_codec()
    with Journal(
        Path(path),
        settings,
        dump=codec.dump,
        load=codec.load,
        sole=True,
        remedy="move the file away, or name another",
    ) as journal:
        yield journal
        journal.remove()
