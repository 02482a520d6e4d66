"""The verbs of more than one photograph, with an engine of ``vehanchor``."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.engine import Engine, EstimateKeywords
from vehanchor.errors import InvalidParameterError
from vehanchor.rulers.known_length_table import lines_in
from vehanchor_flight.estimate import analyse_flight
from vehanchor_flight.inputs import check_many
from vehanchor_flight.live.estimator import scales_of
from vehanchor_flight.live.frames import open_frames
from vehanchor_flight.reconstruction.estimate import rescale as rescale_model
from vehanchor_flight.reconstruction.files import images_of, read_model

if TYPE_CHECKING:
    from typing import Unpack

    from vehanchor.engine import ImageSource, ScaleOptions
    from vehanchor_flight.inputs import InputPhotograph
    from vehanchor_flight.records import FlightEstimate, LiveScale, ModelScale


class FlightKeywords(EstimateKeywords, total=False):
    """Keywords of a flight.

    Attributes:
        same_scale: all photographs have one scale, as in a survey at one height: pool their evidence.
        known_lengths_table: CSV of lines of known length in photographs given as paths; see ``read_known_lengths``.
        journal: file with the result of each photograph, from which the same call resumes after an interruption;
            removed at the end. It covers photographs given as paths, and frames of ``sample_video``.
    """

    same_scale: bool
    known_lengths_table: str | os.PathLike[str] | None
    journal: str | os.PathLike[str] | None


class RescaleKeywords(EstimateKeywords, total=False):
    """Keywords of a reconstruction.

    Attributes:
        images: folder of the photographs; None looks near the model's files.
        known_lengths_table: CSV of lines of known length in the photographs; see ``read_known_lengths``.
        journal: file with the result of each photograph, from which the same call resumes after an interruption;
            removed at the end.
    """

    images: str | os.PathLike[str] | None
    known_lengths_table: str | os.PathLike[str] | None
    journal: str | os.PathLike[str] | None


class LiveKeywords(EstimateKeywords, total=False):
    """Keywords of a running camera.

    Attributes:
        every_s: for a video, seconds between frames; 0.2 by default.
        hold_s: seconds without vehicles after which there is no scale; 10 by default.
        idle_s: seconds without a new frame that end a folder or a camera; None for never.
        tell: receives a sentence on each frame that cannot be read, and on each loss and return of the camera.
    """

    every_s: float
    hold_s: float
    idle_s: float | None
    tell: Callable[[str], None]


def estimate_flight(
    images: Iterable[ImageSource | InputPhotograph],
    options: ScaleOptions | None = None,
    *,
    engine: Engine | None = None,
    **keywords: Unpack[FlightKeywords],
) -> FlightEstimate:
    """Estimate the scales of the photographs of one flight from their common evidence.

    One photograph is held in memory at a time. The record holds the error of a photograph that cannot be read.

    Args:
        images: the photographs, in the order in which they were taken, each as in ``vehanchor.estimate_gsd``. An
            ``InputPhotograph`` names one; the default name is its path or its number.
        options: as in ``vehanchor.estimate_gsd``, without a frame and lines of known length, which belong to one
            photograph.
        engine: holds the models; None for the bundled ones.
        **keywords: see ``FlightKeywords``.

    Returns:
        The record; a photograph without evidence and without links to others has no scale.

    Raises:
        OutputError: the journal cannot be written.
        VehAnchorError: as ``vehanchor.estimate_gsd``.
    """
    check_many(images)  # before a model is loaded
    same_scale, journal = keywords.pop("same_scale", False), keywords.pop("journal", None)
    table = keywords.pop("known_lengths_table", None)
    lines = {} if table is None else lines_in(table, _paths(images))
    chosen_engine, chosen = (engine or Engine()).for_call(options, keywords)
    return analyse_flight(images, chosen_engine.detector, chosen, same_scale=same_scale, journal=journal, lines=lines)


def rescale(
    model: str | os.PathLike[str],
    options: ScaleOptions | None = None,
    *,
    engine: Engine | None = None,
    **keywords: Unpack[RescaleKeywords],
) -> ModelScale:
    """Estimate the factor that gives a reconstruction its size in metres.

    Args:
        model: folder of a project of OpenDroneMap, OpenSfM or COLMAP, or a ``reconstruction.json``.
        options: as in ``vehanchor.estimate_gsd``. Metadata of the photographs is not used.
        engine: holds the models; None for the bundled ones.
        **keywords: see ``RescaleKeywords``.

    Returns:
        The record; ``factor`` is None if nothing of known size is found.

    Raises:
        ReconstructionError: the model cannot be read or measured, or its photographs are not found.
        OutputError: the journal cannot be written.
        VehAnchorError: as ``vehanchor.estimate_gsd``.
    """
    images, lines = keywords.pop("images", None), keywords.pop("known_lengths_table", None)
    journal = keywords.pop("journal", None)
    chosen_engine, chosen = (engine or Engine()).for_call(options, keywords)
    read = read_model(model)
    folder = images_of(read) if images is None else Path(images)
    return rescale_model(read, folder, chosen_engine.detector, chosen, lines, journal)


def live_scales(
    source: str | os.PathLike[str] | int,
    options: ScaleOptions | None = None,
    *,
    engine: Engine | None = None,
    **keywords: Unpack[LiveKeywords],
) -> Iterator[LiveScale]:
    """Estimate the scale of each frame of a running camera, advisory.

    The newest frame wins: no queue grows while a record is used. A video gives every frame.

    Args:
        source: folder that fills, video file, or number of a camera.
        options: as in ``vehanchor.estimate_gsd``. The rulers are vehicles and the scene-scale prior.
        engine: holds the models; None for the bundled ones.
        **keywords: see ``LiveKeywords``.

    Returns:
        An iterator of one record for each frame, from all frames so far.

    Raises:
        ImageNotFoundError: there is no such source.
        InvalidParameterError: the seconds are invalid, or an option is.
        ModelError: a model cannot be used.
    """
    every, hold, idle = keywords.pop("every_s", 0.2), keywords.pop("hold_s", 10.0), keywords.pop("idle_s", None)
    tell = keywords.pop("tell", _ignore)
    chosen_engine, chosen = (engine or Engine()).for_call(options, keywords)
    name = str(source) if isinstance(source, int) else os.fspath(source)
    frames = open_frames(name, chosen.reading, every_s=every, idle_s=idle, tell=tell)
    return scales_of(frames, chosen_engine.detector, chosen, hold_s=hold)


def _paths(images: Iterable[object]) -> list[str | os.PathLike[str]]:
    """Check that photographs with lines of known length are given as paths.

    Raises:
        InvalidParameterError: they are not.
    """
    paths = [each for each in images if isinstance(each, str | os.PathLike)] if isinstance(images, Sequence) else []
    if not isinstance(images, Sequence) or len(paths) < len(images):
        raise InvalidParameterError("a table of known lengths names files: give the photographs as paths")
    return paths


def _ignore(_sentence: str) -> None:
    pass
