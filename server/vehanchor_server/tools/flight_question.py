"""The scale of an image among others of the same flight: what ``estimate_gsd`` does with ``more_images``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated, TypeAlias

from pydantic import Field

from vehanchor.options import Frame
from vehanchor.records import GsdEstimate
from vehanchor_server.calls.answer import WantedPictures
from vehanchor_server.calls.task import work
from vehanchor_server.errors import CallError
from vehanchor_server.frozen import Flag
from vehanchor_server.images.argument import AnyImage, ImageArgument
from vehanchor_server.images.source import library_errors
from vehanchor_server.tools.scale_answer import scale_answer
from vehanchor_server.tools.scale_question import ScaleQuestion

if TYPE_CHECKING:
    from vehanchor.flight.inputs import InputPhotograph
    from vehanchor.flight.photograph import Photograph
    from vehanchor.flight.record import Failure
    from vehanchor.options import ScaleOptions
    from vehanchor.records import FlightEstimate
    from vehanchor_server.calls.answer import Answer
    from vehanchor_server.calls.job import Job
    from vehanchor_server.images.source import OpenedImage
    from vehanchor_server.services import Services

MAX_MORE_IMAGES = 32

MoreImagesArgument: TypeAlias = Annotated[
    tuple[ImageArgument, ...] | None,
    Field(max_length=MAX_MORE_IMAGES, description="Others of the same flight; the answer is for image."),
]
SameScaleArgument: TypeAlias = Annotated[
    Flag, Field(description="With more_images: all are of one scale; else they are tied by what they overlap.")
]


def check_flight_question(question: ScaleQuestion) -> None:
    """Refuse what belongs to one image.

    Raises:
        CallError: ``invalid_arguments``.
    """
    if question.known_lengths:
        raise CallError(
            "invalid_arguments", "known_lengths belong to one image. Leave more_images out, or known_lengths."
        )


@dataclass(frozen=True)
class FlightQuestion:
    """A caller's words about the scale of an image among others of its flight."""

    scale: ScaleQuestion
    wanted: WantedPictures
    same_scale: bool


@work(FlightQuestion, GsdEstimate)
def estimate_among(
    services: Services,
    job: Job,
    source: OpenedImage,
    question: FlightQuestion,
    more: Sequence[tuple[AnyImage, bytes | None]],
) -> Answer[GsdEstimate]:
    """Measure an image with the evidence of others; in a worker's process or thread.

    Raises:
        VehAnchorError: the library refused the image.
        CallError: it refused another one, or a model cannot be loaded.
        CallStoppedError: the call was asked to end.
    """
    from vehanchor.estimate import check_region
    from vehanchor.flight.estimate import conclude, search_flight
    from vehanchor.imagery.sources.opening import open_raster

    told = partial(_tell_photograph, job, 1 + len(more))
    detector = services.models.detector(replace(job.runtime, progress=told))
    asked = question.scale.options(services.settings, services.models)
    options = replace(asked, frame=Frame())
    check_region(detector, options)
    job.enter("decode")
    for _ in _taken(services, source, more, []):  # a path that is refused is told before the work
        job.stop.check()
    opened: list[OpenedImage] = []
    looks = search_flight(_taken(services, source, more, opened), detector, options, featured=not question.same_scale)
    members = [_readable(look, each) for look, each in zip(looks, opened, strict=True)]
    _refuse_twice(members)
    flight = conclude(looks, detector.card, same_scale=question.same_scale)
    analysis = replace(members[0].analysis, estimate=_answered(flight, asked))
    with open_raster(source, limits=asked.reading.limits) if any(question.wanted) else nullcontext() as raster:
        return scale_answer(raster, analysis, question.wanted, job)


def _tell_photograph(job: Job, total: int, done: int, _: int) -> None:
    """Report a photograph; the iterator does not know how many there are."""
    job.searched(done, total)


def _taken(
    services: Services, source: OpenedImage, more: Sequence[tuple[AnyImage, bytes | None]], opened: list[OpenedImage]
) -> Iterator[InputPhotograph]:
    """The image and the others, each open for as long as it is looked at."""
    from vehanchor.flight.inputs import InputPhotograph

    opened.append(source)
    yield InputPhotograph("image", source)
    for number, (image, fetched) in enumerate(more):
        try:
            with services.sources.open(image, fetched) as other:
                opened.append(other)
                yield InputPhotograph(f"more_images.{number}", other)
        except CallError as error:
            raise CallError(error.code, f"more_images.{number}: {error.told}") from error


def _readable(look: Photograph | Failure, source: OpenedImage) -> Photograph:
    """The photograph.

    Raises:
        CallError: it is none of an image that the caller has named among the others; which one is said.
        VehAnchorError: it is none of the image itself.
    """
    from vehanchor.flight.record import Failure

    if not isinstance(look, Failure):
        return look
    if look.name == "image":
        raise look.error
    try:
        with library_errors(source):
            raise look.error
    except CallError as error:
        raise CallError(error.code, f"{look.name}: {error.told}") from look.error


def _refuse_twice(members: Sequence[Photograph]) -> None:
    seen: dict[str, str] = {}
    for member in members:
        first = seen.setdefault(member.view.image.image_id, member.name)
        if first != member.name:
            raise CallError("invalid_arguments", f"{member.name} is the same picture as {first}. Name each once.")


def _answered(flight: FlightEstimate, asked: ScaleOptions) -> GsdEstimate:
    """The record of the image, with what it says in the caller's copy, and a warning where nothing ties it."""
    from vehanchor.estimate import frame_scale
    from vehanchor.flight.project import estimate_in_flight
    from vehanchor.records import Notice
    from vehanchor.records.notices import NoticeCode

    first = flight.photographs[0]
    record = estimate_in_flight(flight, first)
    asked.frame.check(record.image_width_px, record.image_height_px)
    interval = None
    if record.gsd_ci95_low_m_per_px is not None and record.gsd_ci95_high_m_per_px is not None:
        interval = record.gsd_ci95_low_m_per_px, record.gsd_ci95_high_m_per_px
    warnings = record.warnings
    if first.component is not None and flight.components[first.component].n_photographs == 1:
        message = (
            "None of the other images overlaps this one enough to be tied to it: the scale is its own, or that of "
        )
        message += "its height above the sea."
        warnings = (*warnings, Notice(code=NoticeCode.NOT_LINKED, message=message))
    frame = frame_scale(asked.frame, record.image_width_px, record.gsd_m_per_px, interval)
    return record.model_copy(update={"frame": frame, "warnings": warnings})
