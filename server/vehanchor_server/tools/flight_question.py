"""Scale of an image with the evidence of its flight: ``estimate_gsd`` with ``more_images``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, TypeAlias

from pydantic import Field

from vehanchor.options import Frame
from vehanchor.options.option import Flag
from vehanchor.records import GsdEstimate
from vehanchor_server.calls.task import work
from vehanchor_server.errors import CallError
from vehanchor_server.images.argument import AnyImage, ImageArgument
from vehanchor_server.images.source import library_errors
from vehanchor_server.tools.picture import scale_reply
from vehanchor_server.tools.scale_arguments import CallerOptions, Question, scale_options

if TYPE_CHECKING:
    from vehanchor.options import ScaleOptions
    from vehanchor.options.pixel_grid import PixelGrid
    from vehanchor_flight.inputs import InputPhotograph
    from vehanchor_flight.photograph import Photograph
    from vehanchor_flight.record import Failure
    from vehanchor_flight.records import FlightEstimate
    from vehanchor_server.calls.job import Job
    from vehanchor_server.calls.reply import Reply
    from vehanchor_server.images.source import ImageSources, OpenedImage
    from vehanchor_server.resources import Resources

MAX_MORE_IMAGES = 32
_FIRST_NAME = "image"  # the argument that holds the first image
_ONE_IMAGE_OPTIONS = ("known_lengths", "drop", "add")

MoreImagesArgument: TypeAlias = Annotated[
    tuple[ImageArgument, ...] | None,
    Field(
        max_length=MAX_MORE_IMAGES,
        description="Other photographs of the same flight; the answer is for image.",
    ),
]
SameScaleArgument: TypeAlias = Annotated[
    Flag,
    Field(
        description="Whether image and more_images all have one scale; if not, overlaps link them."
    ),
]


@dataclass(frozen=True)
class EstimateSubject:
    """Subject of a call of ``estimate_gsd``.

    Attributes:
        same_scale: whether all images have one scale.
        lists_vehicles: whether the answer lists the vehicles.
    """

    same_scale: bool
    lists_vehicles: bool


def check_flight_options(options: CallerOptions) -> None:
    """Refuse options that belong to a single image.

    Raises:
        CallError: ``invalid_arguments``.
    """
    for name in _ONE_IMAGE_OPTIONS:
        if options.get(name):
            raise CallError(
                "invalid_arguments",
                f"{name} belongs to a single image. Omit more_images or {name}.",
            )


@work(GsdEstimate)
def estimate_with_flight(
    resources: Resources,
    job: Job,
    source: OpenedImage,
    question: Question[EstimateSubject],
    more: Sequence[tuple[AnyImage, bytes | None]],
) -> Reply[GsdEstimate]:
    """Estimate the scale of an image with the evidence of others.

    An error about one of the others has its name.
    """
    from vehanchor.analysis.pipeline import checked_detector
    from vehanchor.imagery.sources.opening import open_raster
    from vehanchor_flight.estimate import conclude, search_flight

    def searched(done: int, _: int) -> None:
        # The search does not know the number of photographs.
        job.searched(done, 1 + len(more))

    runtime = replace(job.runtime, progress=searched)
    detector = resources.models.detector(runtime)
    caller_options = scale_options(question.options, resources.settings, models=resources.models)
    # The caller's frame is about the first image; the search is about all of them.
    options = replace(caller_options, frame=Frame())
    checked_detector(detector, options)
    job.stop.check()
    # Refuse a path among the others before the search, which takes long.
    for _ in _open_each(resources.sources, source, more=more, opened=[]):
        job.stop.check()
    opened: list[OpenedImage] = []
    images = _open_each(resources.sources, source, more=more, opened=opened)
    photographs = search_flight(images, detector, options, featured=True)
    members = []
    for photograph, opened_image in zip(photographs, opened, strict=True):
        members.append(_require_readable(photograph, opened_image))
    _refuse_duplicates(members)
    flight = conclude(photographs, detector.card, same_scale=question.subject.same_scale)
    estimate = _estimate_of_image(flight, caller_options, members[0].view.image.grid)
    analysis = replace(members[0].analysis, estimate=estimate)
    reply = partial(
        scale_reply,
        analysis=analysis,
        request=question.picture,
        job=job,
        lists_vehicles=question.subject.lists_vehicles,
    )
    if not question.picture.kind:
        return reply(None)
    with open_raster(source, caller_options.reading) as raster:
        return reply(raster)


def _open_each(
    sources: ImageSources,
    source: OpenedImage,
    more: Sequence[tuple[AnyImage, bytes | None]],
    opened: list[OpenedImage],
) -> Iterator[InputPhotograph]:
    """Open the image and the others, one after the other; append each to ``opened``."""
    from vehanchor_flight.inputs import InputPhotograph

    opened.append(source)
    yield InputPhotograph(_FIRST_NAME, source)
    for number, (image, fetched) in enumerate(more):
        name = f"more_images.{number}"
        try:
            with sources.open(image, fetched) as other:
                opened.append(other)
                yield InputPhotograph(name, other)
        except CallError as error:
            raise CallError(error.code, f"{name}: {error.explanation}") from error


def _require_readable(photograph: Photograph | Failure, source: OpenedImage) -> Photograph:
    """Return the photograph.

    Raises:
        CallError: another image is unreadable; the message names it.
        VehAnchorError: the image itself is unreadable.
    """
    from vehanchor_flight.record import Failure

    if not isinstance(photograph, Failure):
        return photograph
    if photograph.name == _FIRST_NAME:
        raise photograph.error
    try:
        with library_errors(source):
            raise photograph.error
    except CallError as error:
        message = f"{photograph.name}: {error.explanation}"
        raise CallError(error.code, message) from photograph.error


def _refuse_duplicates(members: Sequence[Photograph]) -> None:
    names: dict[str, str] = {}  # by the identity of the content
    for member in members:
        first = names.setdefault(member.view.image.image_id, member.name)
        if first != member.name:
            raise CallError(
                "invalid_arguments",
                f"{member.name} is the same image as {first}. Give each image once.",
            )


def _estimate_of_image(
    flight: FlightEstimate, caller_options: ScaleOptions, grid: PixelGrid
) -> GsdEstimate:
    """Return the image's record with its scale in the caller's frame.

    Add a warning if no other image is linked to it.
    """
    from vehanchor.analysis.pipeline import frame_scale
    from vehanchor.records import Notice
    from vehanchor.records.notices import NoticeCode
    from vehanchor_flight.project import estimate_in_flight

    first = flight.photographs[0]
    record = estimate_in_flight(flight, first)
    caller_options.frame.check(grid)
    interval = None
    if record.gsd_ci95_low_m_per_px is not None and record.gsd_ci95_high_m_per_px is not None:
        interval = (record.gsd_ci95_low_m_per_px, record.gsd_ci95_high_m_per_px)
    warnings = record.warnings
    if first.component is not None and flight.components[first.component].n_photographs == 1:
        message = (
            "None of the other images overlaps this one enough for a link: the scale "
            "rests on this image alone."
        )
        warnings = (*warnings, Notice(code=NoticeCode.NOT_LINKED, message=message))
    frame = frame_scale(caller_options.frame, grid, gsd=record.gsd_m_per_px, interval=interval)
    return record.model_copy(update={"frame": frame, "warnings": warnings})
