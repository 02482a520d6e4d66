"""The verbs of more than one photograph, with an engine of ``vehanchor``."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vehanchor.analysis.pipeline import checked_detector
from vehanchor.engine import Engine
from vehanchor.rulers.known_length_table import lines_in
from vehanchor_flight.estimate import (
    check_options,
    conclude,
    resumable_journal,
    search_flight,
)
from vehanchor_flight.inputs import check_many, name_photographs
from vehanchor_flight.live.estimator import LiveEstimator
from vehanchor_flight.live.frames import open_frames
from vehanchor_flight.overlays import write_overlays
from vehanchor_flight.reconstruction.estimate import (
    conclude_model,
    model_sha256,
    photograph_files,
    search_model,
    uses_positions,
)
from vehanchor_flight.reconstruction.files import images_of, read_model
from vehanchor_flight.reconstruction.model import Reconstruction

if TYPE_CHECKING:
    from vehanchor.engine import ImageSource
    from vehanchor.options import ScaleOptions
    from vehanchor_flight.inputs import InputPhotograph
    from vehanchor_flight.records import FlightEstimate, LiveScale, ModelScale


def estimate_flight(
    images: Iterable[ImageSource | InputPhotograph],
    options: ScaleOptions | None = None,
    *,
    engine: Engine | None = None,
    same_scale: bool = False,
    known_lengths_table: str | os.PathLike[str] | None = None,
    journal: str | os.PathLike[str] | None = None,
    overlays: str | os.PathLike[str] | None = None,
    **keywords: Any,
) -> FlightEstimate:
    """Estimate the scales of the photographs of one flight from their common evidence.

    One photograph is held in memory at a time. The record holds the error of a photograph that
    cannot be read.

    Args:
        images: the photographs, in the order in which they were taken, each as in
            ``vehanchor.estimate_gsd``. An ``InputPhotograph`` names one; the default name is its
            path or its number.
        options: as in ``vehanchor.estimate_gsd``, without a frame and lines of known length, which
            belong to one photograph.
        engine: holds the models; None for the bundled ones.
        same_scale: all photographs have one scale, as in a survey at one height: pool their
            evidence. Pictures of the same ground are one witness, as without it.
        known_lengths_table: CSV of lines of known length in photographs given as paths; see
            ``lines_in``.
        journal: file with the result of each photograph, from which the same call resumes after an
            interruption; removed at the end. It covers photographs given as paths, and frames of
            ``sample_video``.
        overlays: folder of a picture of each photograph with its vehicles and its scale in the
            flight; made if missing. The photographs are files.
        **keywords: options and runtime, as in ``vehanchor.estimate_gsd``.

    Returns:
        The record; a photograph without evidence and without links to others has no scale.

    Raises:
        InvalidParameterError: the photographs contradict ``same_scale``; the message names the
            groups of different scales.
        OutputError: the journal cannot be written.
        VehAnchorError: as ``vehanchor.estimate_gsd``.
    """
    # A model takes seconds to load: refuse the images first.
    check_many(images)
    paths: list[str | os.PathLike[str]] = []
    if isinstance(images, Sequence):
        paths = [image for image in images if isinstance(image, str | os.PathLike)]
    lines = lines_in(known_lengths_table, paths)
    engine = engine or Engine()
    call_engine, call_options = engine.for_call(options, keywords)
    check_options(call_options)
    detector = checked_detector(call_engine.detector, call_options)
    inputs: Iterable[InputPhotograph] = name_photographs(images)
    if isinstance(images, Sequence):
        # Refuse repeated names before the search; an iterator is read during the search only.
        inputs = list(inputs)
    with resumable_journal(journal, detector, call_options, lines) as open_journal:
        results = search_flight(
            inputs,
            detector,
            call_options,
            featured=True,
            journal=open_journal,
            lines=lines,
        )
        record = conclude(results, detector.card, same_scale=same_scale)
    if overlays is not None:
        write_overlays(overlays, results, record, call_options.reading)
    return record


def rescale(
    model: str | os.PathLike[str] | Reconstruction,
    options: ScaleOptions | None = None,
    *,
    engine: Engine | None = None,
    images: str | os.PathLike[str] | None = None,
    known_lengths_table: str | os.PathLike[str] | None = None,
    journal: str | os.PathLike[str] | None = None,
    **keywords: Any,
) -> ModelScale:
    """Estimate the factor that gives a reconstruction its size in metres.

    Args:
        model: folder of a project of OpenDroneMap, OpenSfM or COLMAP, a ``reconstruction.json``, or
            a model that ``read_model`` returned.
        options: as in ``vehanchor.estimate_gsd``. Metadata is not used, because positions and
            heights in it may have made the wrong size; but the positions give a model without a
            position on Earth its size, and any model if ``rulers`` names them.
        engine: holds the models; None for the bundled ones.
        images: folder of the photographs; None looks near the model's files.
        known_lengths_table: CSV of lines of known length in the photographs; see ``lines_in``.
        journal: as in ``estimate_flight``.
        **keywords: options and runtime, as in ``vehanchor.estimate_gsd``.

    Returns:
        The record; ``factor`` is None if nothing of known size is found.

    Raises:
        ReconstructionError: the model cannot be read or measured, or its photographs are not found.
        KnownLengthError: a line is invalid, or in a photograph that is not in the model.
        OutputError: the journal cannot be written.
        VehAnchorError: as ``vehanchor.estimate_gsd``.
    """
    engine = engine or Engine()
    call_engine, call_options = engine.for_call(options, keywords)
    reconstruction = _reconstruction(model)
    if images is None:
        folder = images_of(reconstruction)
    else:
        folder = Path(images)
    detector = checked_detector(call_engine.detector, call_options)
    by_positions = uses_positions(reconstruction, call_options.rulers)
    rulers = replace(call_options.rulers, metadata=False)
    call_options = replace(call_options, rulers=rulers)
    files = photograph_files(reconstruction, folder)
    lines = lines_in(known_lengths_table, files)
    sha256 = model_sha256(reconstruction)
    with resumable_journal(
        journal, detector, call_options, lines, model_sha256=sha256
    ) as open_journal:
        results = search_model(
            reconstruction,
            folder,
            detector=detector,
            options=call_options,
            lines=lines,
            journal=open_journal,
        )
        return conclude_model(reconstruction, results, folder, by_positions=by_positions)


def _reconstruction(model: str | os.PathLike[str] | Reconstruction) -> Reconstruction:
    """Read a model, unless the caller has read it already."""
    if isinstance(model, Reconstruction):
        return model
    return read_model(model)


def live_scales(
    source: str | os.PathLike[str] | int,
    options: ScaleOptions | None = None,
    *,
    engine: Engine | None = None,
    every_s: float = 0.2,
    hold_s: float = 10.0,
    idle_s: float | None = None,
    tell: Callable[[str], None] = lambda _sentence: None,
    **keywords: Any,
) -> Iterator[LiveScale]:
    """Estimate the scale of each frame of a running camera; the scales are advisory.

    The newest frame wins: no queue grows while the caller uses a record. A video skips no frame.

    Args:
        source: folder that fills, video file, or number of a camera.
        options: as in ``vehanchor.estimate_gsd``. The rulers are vehicles and the scene-scale
            prior.
        engine: holds the models; None for the bundled ones.
        every_s: for a video, seconds between frames.
        hold_s: seconds without vehicles after which there is no scale.
        idle_s: seconds without a new frame that end a folder or a camera; None for never.
        tell: receives a sentence about each frame that cannot be read, and about each loss and
            return of the camera.
        **keywords: options and runtime, as in ``vehanchor.estimate_gsd``.

    Returns:
        An iterator of one record for each frame, from all frames so far.

    Raises:
        ImageNotFoundError: there is no such source.
        InvalidParameterError: the seconds are invalid, or an option is.
        ModelError: a model cannot be used.
    """
    engine = engine or Engine()
    call_engine, call_options = engine.for_call(options, keywords)
    if isinstance(source, int):
        name = str(source)
    else:
        name = os.fspath(source)
    frames = open_frames(name, call_options.reading, every_s=every_s, idle_s=idle_s, tell=tell)
    estimator = LiveEstimator(call_engine.detector, call_options, hold_s=hold_s)
    return map(estimator.estimate, frames)
