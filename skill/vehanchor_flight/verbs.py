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
from vehanchor_flight.estimate import check_options, conclude, resumed, search_flight
from vehanchor_flight.inputs import check_many, named
from vehanchor_flight.live.estimator import LiveEstimator
from vehanchor_flight.live.frames import open_frames
from vehanchor_flight.reconstruction.estimate import (
    conclude_model,
    model_sha256,
    photograph_files,
    search_model,
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
            evidence.
        known_lengths_table: CSV of lines of known length in photographs given as paths; see
            ``lines_in``.
        journal: file with the result of each photograph, from which the same call resumes after an
            interruption; removed at the end. It covers photographs given as paths, and frames of
            ``sample_video``.
        **keywords: options and runtime, as in ``vehanchor.estimate_gsd``.

    Returns:
        The record; a photograph without evidence and without links to others has no scale.

    Raises:
        OutputError: the journal cannot be written.
        VehAnchorError: as ``vehanchor.estimate_gsd``.
    """
    check_many(images)  # before a model is loaded
    paths = (
        [each for each in images if isinstance(each, str | os.PathLike)]
        if isinstance(images, Sequence)
        else []
    )
    lines = lines_in(known_lengths_table, paths)
    called, chosen = (engine or Engine()).for_call(options, keywords)
    check_options(chosen)
    detector = checked_detector(called.detector, chosen)
    taken = list(named(images)) if isinstance(images, Sequence) else named(images)
    with resumed(journal, detector, chosen, lines) as kept:
        results = search_flight(
            taken, detector, chosen, featured=not same_scale, journal=kept, lines=lines
        )
        return conclude(results, detector.card, same_scale=same_scale)


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
            what ``read_model`` read.
        options: as in ``vehanchor.estimate_gsd``. Metadata is not used: positions and heights in it
            may have made the wrong size.
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
    called, chosen = (engine or Engine()).for_call(options, keywords)
    read = model if isinstance(model, Reconstruction) else read_model(model)
    folder = images_of(read) if images is None else Path(images)
    detector = checked_detector(called.detector, chosen)
    chosen = replace(chosen, rulers=replace(chosen.rulers, metadata=False))
    lines = lines_in(known_lengths_table, photograph_files(read, folder))
    with resumed(journal, detector, chosen, lines, model_sha256=model_sha256(read)) as kept:
        return conclude_model(
            read,
            search_model(
                read, folder, detector=detector, options=chosen, lines=lines, journal=kept
            ),
            folder,
        )


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
    """Estimate the scale of each frame of a running camera, advisory.

    The newest frame wins: no queue grows while a record is used. A video gives every frame.

    Args:
        source: folder that fills, video file, or number of a camera.
        options: as in ``vehanchor.estimate_gsd``. The rulers are vehicles and the scene-scale
            prior.
        engine: holds the models; None for the bundled ones.
        every_s: for a video, seconds between frames.
        hold_s: seconds without vehicles after which there is no scale.
        idle_s: seconds without a new frame that end a folder or a camera; None for never.
        tell: receives a sentence on each frame that cannot be read, and on each loss and return of
            the camera.
        **keywords: options and runtime, as in ``vehanchor.estimate_gsd``.

    Returns:
        An iterator of one record for each frame, from all frames so far.

    Raises:
        ImageNotFoundError: there is no such source.
        InvalidParameterError: the seconds are invalid, or an option is.
        ModelError: a model cannot be used.
    """
    called, chosen = (engine or Engine()).for_call(options, keywords)
    name = str(source) if isinstance(source, int) else os.fspath(source)
    frames = open_frames(name, chosen.reading, every_s=every_s, idle_s=idle_s, tell=tell)
    return map(LiveEstimator(called.detector, chosen, hold_s=hold_s).estimate, frames)
