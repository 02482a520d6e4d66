"""Command-line options made from the fields of the option groups, the same for every command.

    @scale_command()
    def estimate(images: ..., chosen: ParsedOptions) -> None:
        engine = chosen.engine()

``estimate`` then has the options of ``Search``, ``Lengths``, ``Reference``, ``Frame``, ``Reading``, ``Rulers``,
``ByHand`` and ``DetectorChoice`` beside its own. ``options``, ``runtime`` and ``engine`` check them, so that the
command can report errors.
"""

from __future__ import annotations

import functools
import inspect
import typing
from dataclasses import MISSING, Field, dataclass, field, fields
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import typer

from vehanchor.cli.collection import paused_collection
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.formats.header import IMAGE_FORMATS
from vehanchor.options import (
    ByHand,
    Frame,
    KnownLength,
    Lengths,
    Reading,
    Reference,
    Rulers,
    ScaleOptions,
    Search,
    models,
)
from vehanchor.options.by_hand import axis_of_text, vehicle_numbers
from vehanchor.options.frame import FRAME
from vehanchor.options.method import Method
from vehanchor.options.models import Precision
from vehanchor.options.option import Option, metadata_of, option_of
from vehanchor.rulers.registry import rulers_help

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping
    from pathlib import Path

    from vehanchor.engine import Engine
    from vehanchor.models.runtime import Progress, Runtime

Photograph: TypeAlias = Annotated[
    str,
    typer.Argument(
        metavar="IMAGE",
        help=f"Photograph: {', '.join(IMAGE_FORMATS)}.",
        show_default=False,
    ),
]

_UNITS = ("_px", "_m")


@dataclass(frozen=True)
class DetectorChoice:
    """Detector and runtime chosen on the command line.

    Attributes:
        detector: path of an ONNX oriented-box model, or the name of a bundled one; None for the bundled default.
        precision: numeric precision of a bundled model; see ``vehanchor.models.zoo.resolve_model``.
        classes: classes, by name or index, that count as vehicles; None for the model's own.
        threads: CPU threads; None for all cores.
        providers: ONNX Runtime execution providers in order of preference; None for the CPU's.
    """

    detector: str | None = field(default=None, metadata=metadata_of(models.DETECTOR))
    precision: Precision = field(default="float32", metadata=metadata_of(models.PRECISION))
    classes: list[str] | None = field(default=None, metadata=metadata_of(models.CLASSES))
    threads: int | None = field(default=None, metadata=metadata_of(models.THREADS))
    providers: list[str] | None = field(default=None, metadata=metadata_of(models.PROVIDERS))

    @property
    def names_and_indices(self) -> list[str | int] | None:
        """Convert classes to the detector's names and indices; a number is an index."""
        return [int(name) if name.isdecimal() else name for name in self.classes] if self.classes else None

    def runtime(self, progress: Progress | None = None) -> Runtime:
        """Make the runtime of the models.

        Raises:
            InvalidParameterError: the threads or the providers are invalid.
        """
        from vehanchor.models.runtime import DEFAULT_PROVIDERS, Runtime

        return Runtime(self.threads, self.providers or DEFAULT_PROVIDERS, self.precision, progress)


_GROUPS: tuple[tuple[type[Any], str], ...] = (
    (DetectorChoice, "Detector"),
    (Reference, "Reference length"),
    (Search, "Search"),
    (Lengths, "Lengths"),
    (Frame, "Reading the image"),
    (Reading, "Reading the image"),
    (Rulers, "Other rulers"),
    (ByHand, "Vehicles by hand"),
    (Method, "Method"),
)
_NEEDED_FIRST = ("region", "known_lengths", "height_m", "frame")  # useful without knowledge of the method
_FIRST_PANEL = "Most useful options"
_FRAME = inspect.Parameter(
    "frame",
    inspect.Parameter.KEYWORD_ONLY,
    default=None,
    annotation=Annotated[
        tuple[int, int] | None,
        typer.Option(
            "--frame",
            metavar=FRAME.metavar,
            help=FRAME.help,
            rich_help_panel=_FIRST_PANEL,
        ),
    ],
)


@dataclass(frozen=True)
class ParsedOptions:
    """Values of the command-line options by field name, checked on use."""

    typed: Mapping[str, Any]

    def options(self) -> ScaleOptions:
        """Make the options of the method.

        Raises:
            InvalidParameterError: a value is invalid.
            CalibrationFileError: the calibration cannot be read.
        """
        typed = dict(self.typed)
        width, height = typed.pop("frame", None) or (None, None)
        keywords: dict[str, Any] = {
            name: value for name, value in typed.items() if name not in DetectorChoice.__dataclass_fields__
        }
        if "alpha" in keywords:
            keywords["alpha"] = _alpha(keywords["alpha"])
        keywords |= {name: value.value for name, value in keywords.items() if isinstance(value, StrEnum)}
        if keywords.get("rulers") is not None:
            keywords["rulers"] = tuple(name.strip() for name in keywords["rulers"].split(","))
        if "known_lengths" in keywords:
            keywords["known_lengths"] = [KnownLength.from_text(text) for text in keywords["known_lengths"] or ()]
        if "add" in keywords:
            keywords["add"] = [axis_of_text(text) for text in keywords["add"] or ()]
            keywords |= {name: vehicle_numbers(name, keywords[name] or "") for name in ("confirm", "drop")}
        return ScaleOptions.of({**keywords, "frame_width_px": width, "frame_height_px": height})

    @property
    def detector(self) -> DetectorChoice:
        """Make the choice of detector and runtime."""
        typed: dict[str, Any] = {name: self.typed.get(name) for name in DetectorChoice.__dataclass_fields__}
        return DetectorChoice(**typed)

    def engine(
        self, *, segmenter: tuple[str | Path, str | Path] | None = None, progress: Progress | None = None
    ) -> Engine:
        """Make the engine; it loads each model on first use.

        Raises:
            InvalidParameterError: a value is invalid.
            CalibrationFileError: the calibration cannot be read.
        """
        with paused_collection():
            from vehanchor.engine import Engine

        choice = self.detector
        return Engine(
            choice.detector,
            segmenter,
            classes=choice.names_and_indices,
            options=self.options(),
            runtime=choice.runtime(progress),
        )


def scale_command(*, without: Collection[str] = ()) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Add the options of all groups to a command, which receives them as the argument ``chosen``.

    Args:
        without: names of fields, or ``frame``, that do not apply to this command.

    Returns:
        A decorator for a function with a parameter ``chosen``; its result is a Typer command.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        own = _resolved_parameters(command)
        del own["chosen"]
        added = [each for group, panel in _GROUPS for each in option_parameters(group, panel)]
        added = [each for each in (*added, _FRAME) if each.name not in without and each.name not in own]
        added.sort(key=lambda each: each.name not in _NEEDED_FIRST)  # panels are shown in this order

        @functools.wraps(command)
        def with_choices(**arguments: Any) -> None:
            typed = {each.name: arguments.pop(each.name) for each in added}
            command(**arguments, chosen=ParsedOptions(typed))

        parameters = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in own.values()]
        parameters += added
        with_choices.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        with_choices.__annotations__ = {each.name: each.annotation for each in parameters}
        return with_choices

    return decorate


def option_parameters(group: type[Any], panel: str) -> list[inspect.Parameter]:
    """Make the parameters of a Typer command for the options of a group.

    Args:
        group: a dataclass.
        panel: heading in ``--help``; options in ``_NEEDED_FIRST`` have their own.

    Returns:
        Keyword-only parameters named as the fields, annotated for Typer.
    """
    kinds = typing.get_type_hints(group, localns={"Calibration": str})
    declared = [(each, option_of(each)) for each in fields(group)]
    return [_parameter(each, stated, kinds[each.name], panel) for each, stated in declared if stated and stated.cli]


def _parameter(declared: Field[Any], stated: Option, kind: Any, panel: str) -> inspect.Parameter:
    name = declared.name
    bare = next((option for option in typing.get_args(kind) if option is not type(None)), kind)
    default = None if declared.default is MISSING else declared.default
    flag = stated.flag or _without_unit(name).replace("_", "-")
    more: dict[str, Any] = {"metavar": stated.metavar} if stated.metavar else {}
    if typing.get_origin(bare) is Literal:
        words = {word: word for word in typing.get_args(bare)}
        kind = typing.cast("type", StrEnum(name.title(), words)) | None
    if name == "alpha":  # a number or a word
        kind, default = str, str(default)
    elif name in ("rulers", "confirm", "drop"):  # words with commas
        kind, default = str | None, None
    elif name in ("known_lengths", "add"):  # each joined to one text (see ``vehanchor.cli.spaced``)
        kind, default = list[str] | None, None
    flags = f"--{flag}/--no-{flag}" if bare is bool else f"--{flag}"
    heading = _FIRST_PANEL if name in _NEEDED_FIRST else panel
    text = rulers_help() if name == "rulers" else stated.help
    option = typer.Option(flags, help=text, rich_help_panel=heading, **more)
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, option])


def _resolved_parameters(command: Callable[..., None]) -> dict[str, inspect.Parameter]:
    """Resolve the annotations of the command's own parameters, which Typer needs."""
    kinds = typing.get_type_hints(command, include_extras=True)
    return {
        name: each.replace(annotation=kinds.get(name, each.annotation))
        for name, each in inspect.signature(command).parameters.items()
    }


def _without_unit(name: str) -> str:
    for unit in _UNITS:
        if name.endswith(unit):
            return name.removesuffix(unit)
    return name


def _alpha(text: Any) -> float | None:
    if isinstance(text, str) and text.strip().lower() in ("none", "off"):
        return None
    try:
        return float(text)
    except ValueError:
        raise InvalidParameterError(f"--alpha is {text!r}: use a number >= 1, or 'none'") from None
