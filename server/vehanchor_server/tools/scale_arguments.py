"""Arguments of the measuring tools that are options of the library, and the options that follow from them."""

from __future__ import annotations

import functools
import inspect
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, get_args

from pydantic import BeforeValidator, Field

from vehanchor.options import Reading, Reference, ScaleOptions, declared_options
from vehanchor.options.option import Option
from vehanchor.options.rulers import OBJECT_HEIGHT, ObjectHeight
from vehanchor_server.calls.reply import MAX_SIDE_PX, Detail
from vehanchor_server.frozen import Flag, WholeNumber

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from vehanchor.measure.resolved_scale import ScaleInput
    from vehanchor_server.calls.job import Job
    from vehanchor_server.models import Models
    from vehanchor_server.services import Services
    from vehanchor_server.settings import Settings

OVERLAY_SIDE_PX = 1000
_LEAST_OVERLAY_PX = 256

DetailArgument: TypeAlias = Annotated[Detail, Field(description="full: every field, for programs.")]
OverlayArgument: TypeAlias = Annotated[Flag, Field(description="Also return a picture.")]
OverlaySideArgument: TypeAlias = Annotated[
    WholeNumber,
    Field(ge=_LEAST_OVERLAY_PX, le=MAX_SIDE_PX, description="Longer side of that picture, pixels, at most."),
]
Given: TypeAlias = "Mapping[str, Any]"
"""Options that the caller gave, by keyword."""

UNLISTED_ARGUMENTS = (
    "detail",
    "tolerance_m",
    "object_height_m",
    "overlay_side_px",
    *(name for name, each in declared_options().items() if not each.option.listed),
)
"""Arguments and fields that the listed schemas hide from models; programs or the operator set them."""


def with_options(kind: str) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Add the options of all measuring tools, and those of a kind, to the arguments of a tool.

    Args:
        kind: ``estimate`` or ``measure``.

    Returns:
        A decorator for a function with a parameter ``given``, which gets the options that the caller gave.
    """

    def decorate(tool: Callable[..., Any]) -> Callable[..., Any]:
        own = inspect.signature(tool).parameters
        options = {name: each for name, each in declared_options().items() if each.option.tools in ("all", kind)}
        arguments = {name: _optional(each.annotation, each.option) for name, each in options.items()}
        if kind == "measure":
            arguments["object_height_m"] = _optional(ObjectHeight, OBJECT_HEIGHT)
        added = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
            for name, annotation in arguments.items()
        ]
        kept = [each.replace(kind=each.KEYWORD_ONLY) for name, each in own.items() if name != "given"]

        @functools.wraps(tool)
        async def with_given(**values: Any) -> Any:
            told = {name: values.pop(name) for name in arguments}
            return await tool(**values, given={name: value for name, value in told.items() if value is not None})

        signature = inspect.signature(tool).replace(parameters=[*kept, *added])
        with_given.__signature__ = signature  # type: ignore[attr-defined] # what the SDK reads
        with_given.__annotations__ = {each.name: each.annotation for each in signature.parameters.values()}
        return with_given

    return decorate


def _optional(annotation: Any, option: Option) -> Any:
    """Make an optional argument; null and an empty text are no value."""
    kind, *metadata = get_args(annotation)
    rest = [each for each in metadata if not isinstance(each, Option)]
    bare: Any = Annotated[(kind, *rest)] if rest else kind
    return Annotated[bare | None, BeforeValidator(lambda value: None if value == "" else value), option]


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
    return operator.with_keywords({name: value for name, value in given.items() if name != "object_height_m"})


@dataclass(frozen=True)
class ScaleSource:
    """Scale of a measurement.

    Attributes:
        options: options of the method.
        scale: the known scale, or the detector that finds one.
        object_height_m: height of the object above ground.
    """

    options: ScaleOptions
    scale: ScaleInput
    object_height_m: float | None


def resolve_source(given: Given, services: Services, job: Job) -> ScaleSource:
    """Take the measured scale from elsewhere, or the detector that finds one.

    Raises:
        CallError: a model cannot be loaded.
        VehAnchorError: the arguments contradict each other.
    """
    from vehanchor.analysis.pipeline import checked_detector
    from vehanchor.measure.resolved_scale import given_scale

    height = given.get("object_height_m")
    if given.get("gsd_basis") == "measured":
        options = scale_options(given, services.settings, None)
        known = given_scale(options.rulers.gsd_m_per_px, None, options)
        assert known is not None
        return ScaleSource(options, known, height)
    options = scale_options(given, services.settings, services.models)
    detector = checked_detector(services.models.detector(job.runtime), options)
    return ScaleSource(options, functools.partial(services.models.memory.analyse, detector), height)


def copy_hint(places: Iterable[tuple[float, float]], given: Given, width_px: int, height_px: int) -> list[str]:
    """Return a hint if the coordinates may belong to a resized copy of the image.

    Args:
        places: points in the caller's coordinates.
        given: options of the caller, with the coordinate system.
        width_px: width of the image.
        height_px: height of the image.
    """
    factor = MAX_SIDE_PX / max(width_px, height_px)
    if "frame" in given or given.get("coordinates", "pixels") != "pixels" or factor >= 1:
        return []
    if any(x > width_px * factor or y > height_px * factor for x, y in places):
        return []
    return [f"Check: the image has {width_px} x {height_px} px. If you used a smaller copy, give its size as frame."]
