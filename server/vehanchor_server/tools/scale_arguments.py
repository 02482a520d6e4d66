"""Arguments of the measuring tools that are options of the library, and the options from them."""

from __future__ import annotations

import functools
import inspect
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Generic, TypeAlias, TypeVar, get_args

from pydantic import BeforeValidator, Field
from pydantic_core import PydanticCustomError

from vehanchor.errors import InvalidParameterError
from vehanchor.options import Reading, Reference, ScaleOptions, declared_options
from vehanchor.options.option import Limits, Option
from vehanchor.options.rulers import OBJECT_HEIGHT, ObjectHeight
from vehanchor.options.signature import set_signature
from vehanchor_server.calls.reply import Detail, PictureRequest

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from mcp.server.mcpserver import Context

    from vehanchor.measure.scale_source import ScaleInput
    from vehanchor_server.calls.job import Job
    from vehanchor_server.models import Models
    from vehanchor_server.resources import Resources
    from vehanchor_server.settings import Settings

DetailArgument: TypeAlias = Annotated[Detail, Field(description="full: every field.")]

CallerOptions: TypeAlias = "Mapping[str, Any]"
"""Options that the caller gave, by keyword."""

Subject = TypeVar("Subject")


@dataclass(frozen=True)
class Question(Generic[Subject]):
    """Arguments of a call, for its work.

    Attributes:
        options: options that the caller gave.
        picture: the requested picture.
        subject: what the tool measures beside the scale.
    """

    options: CallerOptions
    picture: PictureRequest
    subject: Subject


def with_options(
    kind: str, *, paged: bool = True
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add the options of all measuring tools, and those of a kind, to the arguments of a tool.

    Args:
        kind: ``estimate`` or ``measure``.
        paged: whether hosts show the results on the page.

    Returns:
        A decorator for a function with the parameters ``caller_options``, which gets the options
        that the caller gave, and ``picture``, the requested picture: the evidence for
        ``view_image``, or the image for a host with pages.
    """
    from mcp.server.apps import client_supports_apps

    def decorate(tool: Callable[..., Any]) -> Callable[..., Any]:
        annotations = _option_annotations(kind)

        @functools.wraps(tool)
        async def with_caller_options(
            *, ctx: Context[Any, Any], shown: PictureRequest | None = None, **arguments: Any
        ) -> Any:
            values = {name: arguments.pop(name) for name in annotations}
            given = {name: value for name, value in values.items() if value is not None}
            picture = shown
            if picture is None:
                shows_page = paged and client_supports_apps(ctx)
                picture = PictureRequest("plain" if shows_page else "")
            return await tool(**arguments, ctx=ctx, caller_options=given, picture=picture)

        parameters = _published_parameters(tool, annotations)
        returns = inspect.signature(tool).return_annotation
        set_signature(with_caller_options, parameters, returns=returns)
        return with_caller_options

    return decorate


def _option_annotations(kind: str) -> dict[str, Any]:
    """Return the annotation of each option that a kind of tool takes as an argument."""
    annotations = {}
    for name, declared in declared_options().items():
        if declared.option.tools in ("all", kind):
            annotations[name] = _optional(declared.annotation, declared.option)
    if kind == "measure":
        annotations["object_height_m"] = _optional(ObjectHeight, OBJECT_HEIGHT)
    return annotations


def _published_parameters(
    tool: Callable[..., Any], annotations: Mapping[str, Any]
) -> list[inspect.Parameter]:
    """List a tool's parameters with the options instead of ``caller_options`` and ``picture``."""
    parameters = []
    for name, parameter in inspect.signature(tool).parameters.items():
        if name not in ("caller_options", "picture"):
            parameters.append(parameter)
    for name, annotation in annotations.items():
        parameters.append(
            inspect.Parameter(
                name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation
            )
        )
    return parameters


def _optional(annotation: Any, option: Option) -> Any:
    """Make an optional argument; null and an empty text are no value."""
    kind, *metadata = get_args(annotation)
    constraints = [item for item in metadata if not isinstance(item, Option)]
    bare: Any = kind
    if constraints:
        bare = Annotated[(kind, *constraints)]
    validators = [BeforeValidator(_empty_as_none)]
    validators += [_unit_check(limits) for limits in _limits_in(annotation)]
    return Annotated[(bare | None, *validators, option)]


def _empty_as_none(value: Any) -> Any:
    return None if value == "" else value


def _limits_in(annotation: Any) -> list[Limits]:
    """Find the limits of a number in an annotation, which may be optional."""
    limits = []
    for part in get_args(annotation):
        if isinstance(part, Limits):
            limits.append(part)
        else:
            limits += _limits_in(part)
    return limits


def _unit_check(limits: Limits) -> BeforeValidator:
    """Make a validator that refuses a number with a unit, such as "120 ft".

    The name of an argument states its unit, and the schema a number. Whoever writes another unit
    has not read them, so the answer states the number to give.
    """

    def check(value: Any) -> Any:
        if not isinstance(value, str) or not value.strip()[-1:].isalpha():
            return value
        expected = _expected_number(value, limits)
        raise PydanticCustomError("unit", "{expected}", {"expected": expected})

    return BeforeValidator(check)


def _expected_number(text: str, limits: Limits) -> str:
    """Ask for the number of a text in the unit of an option, and state it if it is known."""
    try:
        number = limits.check("", text)
    except InvalidParameterError:
        return f"give a number, in {limits.unit}" if limits.unit else "give a number"
    return f"give a number without a unit: {number:.4g} {limits.unit}"


def scale_options(
    caller_options: CallerOptions, settings: Settings, models: Models | None
) -> ScaleOptions:
    """Make the options: limits and calibration of the operator, all others of the caller.

    If the caller gives a region or a reference length, the operator's calibration is not used.

    Args:
        caller_options: options of the caller.
        settings: the operator's settings.
        models: source of the calibration; None if the scale is known.

    Raises:
        CallError: the calibration cannot be loaded.
        InvalidParameterError: the caller's options contradict each other.
    """
    is_fleet_unknown = not {"region", "reference_length_m"} & caller_options.keys()
    calibration = None
    if models is not None and is_fleet_unknown:
        calibration = models.calibration()
    operator = ScaleOptions(
        reference=Reference(calibration=calibration),
        reading=Reading(limits=settings.image_limits),
    )
    return operator.with_keywords(
        {name: value for name, value in caller_options.items() if name != "object_height_m"}
    )


def resolve_source(
    caller_options: CallerOptions, resources: Resources, job: Job
) -> tuple[ScaleOptions, ScaleInput]:
    """Return the options, and the caller's measured scale or the analysis that finds one.

    Raises:
        CallError: a model cannot be loaded.
        VehAnchorError: the arguments contradict each other.
    """
    from vehanchor.analysis.pipeline import checked_detector
    from vehanchor.measure.scale_source import read_scale_argument

    if caller_options.get("gsd_basis") == "measured":
        options = scale_options(caller_options, resources.settings, models=None)
        scale = read_scale_argument(options.rulers.gsd_m_per_px, None, options)
        assert scale is not None
        return options, scale
    options = scale_options(caller_options, resources.settings, models=resources.models)
    detector = checked_detector(resources.models.detector(job.runtime), options)
    return options, functools.partial(resources.models.memory.analyse, detector)
