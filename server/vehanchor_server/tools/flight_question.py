"""Scale of an image with the evidence of its flight: ``estimate_gsd`` with ``more_images``."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import replace
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
from vehanchor_server.tools.scale_arguments import Given, Question, scale_options

if TYPE_CHECKING:
    from vehanchor.options import ScaleOptions
    from vehanchor_flight.inputs import InputPhotograph
    from vehanchor_flight.photograph import Photograph
    from vehanchor_flight.record import Failure
    from vehanchor_flight.records import FlightEstimate
    from vehanchor_server.calls.job import Job
    from vehanchor_server.calls.reply import Reply
    from vehanchor_server.images.source import OpenedImage
    from vehanchor_server.services import Services

MAX_MORE_IMAGES = 32

MoreImagesArgument: TypeAlias = Annotated[
    tuple[ImageArgument, ...] | None,
    Field(
        max_length=MAX_MORE_IMAGES,
        description="Other photographs of the same flight; the answer is for image.",
    ),
]
SameScaleArgument: TypeAlias = Annotated[
    Flag,
    Field(description="With more_images: all have one scale; otherwise their overlaps link them."),
]


def check_flight_question(given: Given) -> None:
    """Refuse arguments that belong to a single image.

    Raises:
        CallError: ``invalid_arguments``.
    """
    single = next((name for name in ("known_lengths", "drop", "add") if given.get(name)), None)
    if single is not None:
        raise CallError(
            "invalid_arguments",
            f"{single} belongs to a single image. Omit more_images or {single}.",
        )


@work(GsdEstimate)
def estimate_with_flight(
    services: Services,
    job: Job,
    source: OpenedImage,
    question: Question[bool],
    more: Sequence[tuple[AnyImage, bytes | None]],
) -> Reply[GsdEstimate]:
    """Estimate the scale of an image with the evidence of others; an error about one of these has its name."""
    from vehanchor.analysis.pipeline import checked_detector
    from vehanchor.imagery.sources.opening import open_raster
    from vehanchor_flight.estimate import conclude, search_flight

    # The search does not know the number of photographs.
    runtime = replace(job.runtime, progress=lambda done, _: job.searched(done, 1 + len(more)))
    detector = services.models.detector(runtime)
    asked = scale_options(question.given, services.settings, services.models)
    options = replace(asked, frame=Frame())
    checked_detector(detector, options)
    job.stop.check()
    for _ in _open_each(services, source, more=more, opened=[]):  # refuse a path before the search
        job.stop.check()
    opened: list[OpenedImage] = []
    images = _open_each(services, source, more=more, opened=opened)
    photographs = search_flight(images, detector, options, featured=not question.subject)
    members = [
        _require_readable(found, each) for found, each in zip(photographs, opened, strict=True)
    ]
    _refuse_duplicates(members)
    flight = conclude(photographs, detector.card, same_scale=question.subject)
    analysis = replace(members[0].analysis, estimate=_estimate_of_image(flight, asked))
    with open_raster(source, asked.reading) if question.wanted.kind else nullcontext() as raster:
        return scale_reply(raster, analysis, wanted=question.wanted, job=job)


def _open_each(
    services: Services,
    source: OpenedImage,
    more: Sequence[tuple[AnyImage, bytes | None]],
    opened: list[OpenedImage],
) -> Iterator[InputPhotograph]:
    """Open the image and the others, one after the other."""
    from vehanchor_flight.inputs import InputPhotograph

    opened.append(source)
    yield InputPhotograph("image", source)
    for number, (image, fetched) in enumerate(more):
        try:
            with services.sources.open(image, fetched) as other:
                opened.append(other)
                yield InputPhotograph(f"more_images.{number}", other)
        except CallError as error:
            raise CallError(error.code, f"more_images.{number}: {error.explanation}") from error


def _require_readable(photograph: Photograph | Failure, source: OpenedImage) -> Photograph:
    """Return the photograph.

    Raises:
        CallError: another image is unreadable; the message names it.
        VehAnchorError: the image itself is unreadable.
    """
    from vehanchor_flight.record import Failure

    if not isinstance(photograph, Failure):
        return photograph
    if photograph.name == "image":
        raise photograph.error
    try:
        with library_errors(source):
            raise photograph.error
    except CallError as error:
        raise CallError(error.code, f"{photograph.name}: {error.explanation}") from photograph.error


def _refuse_duplicates(members: Sequence[Photograph]) -> None:
    seen: dict[str, str] = {}
    for member in members:
        first = seen.setdefault(member.view.image.image_id, member.name)
        if first != member.name:
            raise CallError(
                "invalid_arguments",
                f"{member.name} is the same image as {first}. Give each image once.",
            )


def _estimate_of_image(flight: FlightEstimate, asked: ScaleOptions) -> GsdEstimate:
    """Return the image's record with its scale in the caller's frame; warn if no other image is linked to it."""
    from vehanchor.analysis.pipeline import frame_scale
    from vehanchor.records import Notice
    from vehanchor.records.notices import NoticeCode
    from vehanchor_flight.project import estimate_in_flight

    first = flight.photographs[0]
    record = estimate_in_flight(flight, first)
    asked.frame.check(record.image_width_px, record.image_height_px)
    interval = None
    if record.gsd_ci95_low_m_per_px is not None and record.gsd_ci95_high_m_per_px is not None:
        interval = record.gsd_ci95_low_m_per_px, record.gsd_ci95_high_m_per_px
    warnings = record.warnings
    if first.component is not None and flight.components[first.component].n_photographs == 1:
        message = (
            "None of the other images overlaps this one enough for a link: the scale "
            "rests on this image alone."
        )
        warnings = (*warnings, Notice(code=NoticeCode.NOT_LINKED, message=message))
    frame = frame_scale(
        asked.frame, record.image_width_px, gsd=record.gsd_m_per_px, interval=interval
    )
    return record.model_copy(update={"frame": frame, "warnings": warnings})
