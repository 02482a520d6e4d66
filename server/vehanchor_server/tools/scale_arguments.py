"""Arguments of the measuring tools that are options of the library, and the options that follow from them."""

from __future__ import annotations

import functools
import inspect
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Generic, TypeAlias, TypeVar, get_args

from pydantic import BeforeValidator, Field

from vehanchor.options import Reading, Reference, ScaleOptions, declared_options
from vehanchor.options.option import Option
from vehanchor.options.rulers import OBJECT_HEIGHT, ObjectHeight
from vehanchor.records import GsdEstimate
from vehanchor_server.calls.call import run_call
from vehanchor_server.calls.reply import MAX_SIDE_PX, Detail, PictureRequest
from vehanchor_server.errors import CallError
from vehanchor_server.tools.messages import answer_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from mcp.server.mcpserver import Context

    from vehanchor.measure.scale_source import ScaleInput
    from vehanchor.records import AreaMeasurement, DistanceMeasurement
    from vehanchor_server.calls.job import Job
    from vehanchor_server.calls.reply import Reply
    from vehanchor_server.calls.task import Work
    from vehanchor_server.images.argument import AnyImage
    from vehanchor_server.models import Models
    from vehanchor_server.services import Services
    from vehanchor_server.settings import Settings
    from vehanchor_server.tools.messages import Answer

DetailArgument: TypeAlias = Annotated[Detail, Field(description="full: every field, for programs.")]
_LARGE_PX = 1000  # longer side of images in which nobody points at the first 100 px alone
_PER_CENT = 100
Given: TypeAlias = "Mapping[str, Any]"
"""Options that the caller gave, by keyword."""


Subject = TypeVar("Subject")


@dataclass(frozen=True)
class Question(Generic[Subject]):
    """Arguments of a call, for its work.

    Attributes:
        given: options that the caller gave.
        wanted: the requested picture.
        subject: what the tool measures beside the scale.
    """

    given: Given
    wanted: PictureRequest
    subject: Subject


def with_options(
    kind: str, *, paged: bool = True
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add the options of all measuring tools, and those of a kind, to the arguments of a tool.

    Args:
        kind: ``estimate`` or ``measure``.
        paged: whether hosts show the results on the page.

    Returns:
        A decorator for a function with the parameters ``given``, which gets the options that the
        caller gave, and ``wanted``, the picture: the evidence for ``view_image``, or the image for
        a host with pages.
    """
    from mcp.server.apps import client_supports_apps

    def decorate(tool: Callable[..., Any]) -> Callable[..., Any]:
        own = inspect.signature(tool).parameters
        options = {
            name: each
            for name, each in declared_options().items()
            if each.option.tools in ("all", kind)
        }
        arguments = {
            name: _optional(each.annotation, each.option) for name, each in options.items()
        }
        if kind == "measure":
            arguments["object_height_m"] = _optional(ObjectHeight, OBJECT_HEIGHT)
        added = [
            inspect.Parameter(
                name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation
            )
            for name, annotation in arguments.items()
        ]
        kept = [
            each.replace(kind=each.KEYWORD_ONLY)
            for name, each in own.items()
            if name not in ("given", "wanted")
        ]

        @functools.wraps(tool)
        async def with_given(
            *, ctx: Context[Any, Any], shown: PictureRequest | None = None, **values: Any
        ) -> Any:
            told = {name: values.pop(name) for name in arguments}
            given = {name: value for name, value in told.items() if value is not None}
            wanted = shown or PictureRequest("plain" if paged and client_supports_apps(ctx) else "")
            return await tool(**values, ctx=ctx, given=given, wanted=wanted)

        signature = inspect.signature(tool).replace(parameters=[*kept, *added])
        with_given.__signature__ = signature  # type: ignore[attr-defined] # what the SDK reads
        with_given.__annotations__ = {
            each.name: each.annotation for each in signature.parameters.values()
        }
        return with_given

    return decorate


def _optional(annotation: Any, option: Option) -> Any:
    """Make an optional argument; null and an empty text are no value."""
    kind, *metadata = get_args(annotation)
    rest = [each for each in metadata if not isinstance(each, Option)]
    bare: Any = Annotated[(kind, *rest)] if rest else kind
    return Annotated[
        bare | None, BeforeValidator(lambda value: None if value == "" else value), option
    ]


def scale_options(given: Given, settings: Settings, models: Models | None) -> ScaleOptions:
    """Make the options: limits and calibration of the operator, all others of the caller.

    If the caller gives a region or a reference length, the operator's calibration is not used.

    Args:
        given: options of the caller.
        settings: the operator's settings.
        models: source of the calibration; None if the scale is known.

    Raises:
        CallError: the calibration cannot be loaded.
        InvalidParameterError: the caller's options contradict each other.
    """
    fleet_unknown = "region" not in given and "reference_length_m" not in given
    operator = ScaleOptions(
        reference=Reference(calibration=models.calibration() if models and fleet_unknown else None),
        reading=Reading(limits=settings.image_limits),
    )
    return operator.with_keywords(
        {name: value for name, value in given.items() if name != "object_height_m"}
    )


def resolve_source(given: Given, services: Services, job: Job) -> tuple[ScaleOptions, ScaleInput]:
    """Return the options, and the measured scale from elsewhere or the detector that finds one.

    Raises:
        CallError: a model cannot be loaded.
        VehAnchorError: the arguments contradict each other.
    """
    from vehanchor.analysis.pipeline import checked_detector
    from vehanchor.measure.scale_source import given_scale

    if given.get("gsd_basis") == "measured":
        options = scale_options(given, services.settings, None)
        known = given_scale(options.rulers.gsd_m_per_px, None, options)
        assert known is not None
        return options, known
    options = scale_options(given, services.settings, services.models)
    detector = checked_detector(services.models.detector(job.runtime), options)
    return options, functools.partial(services.models.memory.analyse, detector)


async def answered(
    services: Services,
    ctx: Context[Any, Any],
    image: AnyImage,
    work: Work[Any],
    question: Question[Any],
    places: Sequence[tuple[float, float]] = (),
    *,
    more: Sequence[AnyImage] = (),
    detail: Detail,
) -> tuple[Reply[Any], Answer]:
    """Run the work of a call, and say its records in words; see ``run_call``.

    The places are the points of the subjects, in the caller's coordinates.
    """
    _check_coordinates(places, question.given)
    reply = await run_call(services, ctx, image=image, work=work, question=question, more=more)
    return reply, answer_of(reply.records, _hints(places, question.given, reply.record), detail)


def _check_coordinates(places: Iterable[tuple[float, float]], given: Given) -> None:
    """Refuse coordinates that look like fractions, also those of lines and vehicles, unless their units are named.

    Raises:
        CallError: ``invalid_prompt``.
    """
    found = _all_places(places, given)
    if (
        found
        and "coordinates" not in given
        and all(0 <= value <= 1 for place in found for value in place)
    ):
        raise CallError(
            "invalid_prompt",
            "all coordinates lie in 0 to 1. For shares of the sides give coordinates: "
            '"fraction", for pixels "pixels".',
        )


def _hints(
    places: Iterable[tuple[float, float]],
    given: Given,
    record: GsdEstimate | AreaMeasurement | DistanceMeasurement,
) -> list[str]:
    """Return warnings about the call: what was made of a region or a stated scale, and doubtful coordinates.

    Naming the units, or a frame, silences those about coordinates.
    """
    estimate = record if isinstance(record, GsdEstimate) else record.estimate
    said = []
    if "region" in given and estimate is not None and estimate.details.reference_source == "region":
        said.append(
            f"Region {given['region']}: cars of {estimate.details.reference_length_m:.2f} m."
        )
    if "gsd_m_per_px" in given and "gsd_tolerance" not in given:
        said.append("The stated scale is taken as +- 10 %.")
    found = _all_places(places, given)
    longest = max(record.image_width_px, record.image_height_px)
    if not found or "frame" in given or "coordinates" in given:
        return said
    size = f"The image has {record.image_width_px} x {record.image_height_px} px"
    factor = MAX_SIDE_PX / longest
    if longest > _LARGE_PX and all(value <= _PER_CENT for place in found for value in place):
        said.append(
            f"{size}, all coordinates lie in 0 to 100. If they are pixels, give coordinates: "
            '"pixels".'
        )
    elif factor < 1 and all(
        x <= record.image_width_px * factor and y <= record.image_height_px * factor
        for x, y in found
    ):
        said.append(f"{size}. If you used a smaller copy, give its size as frame.")
    return said


def _all_places(places: Iterable[tuple[float, float]], given: Given) -> list[tuple[float, float]]:
    lines = (*given.get("known_lengths", ()), *given.get("add", ()))
    return [*places, *(end for line in lines for end in ((line.x1, line.y1), (line.x2, line.y2)))]
