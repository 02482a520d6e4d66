"""Command-line options made from the fields of the option groups and of the runtime, the same for every command.

    @scale_command()
    def estimate(images: ..., chosen: ParsedOptions) -> None:
        engine = chosen.engine()

``estimate`` then has the options of all groups of ``ScaleOptions``, of ``DetectorChoice`` and of ``Runtime`` beside its
own. ``options``, ``runtime`` and ``engine`` check them, so that the command can report errors.
"""

from __future__ import annotations

import functools
import inspect
import typing
from collections.abc import Sequence
from dataclasses import MISSING, Field, dataclass, field, fields
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeAlias

import typer

from vehanchor.cli.collection import paused_collection
from vehanchor.imagery.formats.header import IMAGE_FORMATS
from vehanchor.models.runtime import Progress, Runtime
from vehanchor.options import ScaleOptions, declared_options, models
from vehanchor.options.frame import FRAME
from vehanchor.options.option import Option, metadata_of, option_of
from vehanchor.rulers.registry import rulers_help

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterator, Mapping
    from pathlib import Path

    from vehanchor.engine import Engine

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
    """Detector chosen on the command line.

    Attributes:
        detector: path of an ONNX oriented-box model, or the name of a bundled one; None for the bundled default.
        classes: classes, by name or index, that count as vehicles; None for the model's own.
    """

    panel: ClassVar[str] = "Detector"

    detector: str | None = field(default=None, metadata=metadata_of(models.DETECTOR))
    classes: Sequence[str | int] | None = field(default=None, metadata=metadata_of(models.CLASSES))


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
        width, height = self.typed.get("frame") or (None, None)
        given = {name: value for group in _groups() for name, value in self._given(group).items()}
        return ScaleOptions.of({**given, "frame_width_px": width, "frame_height_px": height})

    def _given(self, group: type[Any]) -> dict[str, Any]:
        """Read the given values of a group's fields."""
        found: dict[str, Any] = {}
        for each in fields(group):
            stated, typed = option_of(each), self.typed.get(each.name)
            if stated is not None and typed is not None and typed != []:
                found[each.name] = typed.value if isinstance(typed, StrEnum) else stated.from_texts(typed)
        return found

    @property
    def detector(self) -> DetectorChoice:
        """Make the choice of the detector."""
        return DetectorChoice(**self._given(DetectorChoice))

    def runtime(self, progress: Progress | None = None) -> Runtime:
        """Make the runtime of the models.

        Raises:
            InvalidParameterError: the threads or the providers are invalid.
        """
        return Runtime(**self._given(Runtime), progress=progress)

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
            classes=choice.classes,
            options=self.options(),
            runtime=self.runtime(progress),
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
        first: list[inspect.Parameter] = []
        rest: list[inspect.Parameter] = []
        for group in (DetectorChoice, Runtime, *_groups()):
            for name, stated, parameter in option_parameters(group):
                if name not in without and name not in own:
                    (first if stated.first else rest).append(parameter)
        if "frame" not in without:
            first.append(_FRAME)
        added = [*first, *rest]  # panels are shown in this order

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


def _groups() -> list[type[Any]]:
    """List the option groups."""
    return list(dict.fromkeys(each.group for each in declared_options()))


def option_parameters(group: type[Any]) -> Iterator[tuple[str, Option, inspect.Parameter]]:
    """Make the parameters of a Typer command for the options of a group.

    Args:
        group: a dataclass; its ``panel`` is the heading in ``--help``.

    Yields:
        Each field's name, its declaration, and a keyword-only parameter of that name, annotated for Typer.
    """
    kinds = typing.get_type_hints(group, localns={"Calibration": str, "Sequence": Sequence})
    for each in fields(group):
        stated = option_of(each)
        if stated is not None and stated.cli:
            yield each.name, stated, _parameter(each, stated, kinds[each.name], getattr(group, "panel", "Detector"))


def _parameter(declared: Field[Any], stated: Option, kind: Any, panel: str) -> inspect.Parameter:
    name = declared.name
    bare = next((option for option in typing.get_args(kind) if option is not type(None)), kind)
    default = None if declared.default in (MISSING, ()) else declared.default
    flag = stated.flag or _without_unit(name).replace("_", "-")
    more: dict[str, Any] = {"metavar": stated.metavar} if stated.metavar else {}
    if typing.get_origin(bare) is Literal or typing.get_origin(kind) is Literal:
        words = {word: word for word in typing.get_args(bare) or typing.get_args(kind)}
        kind = typing.cast("type", StrEnum(name.title(), words)) | None
    elif stated.repeated:
        kind, default = list[str] | None, None
    elif stated.read is not None:
        kind, default = str | None, None if default is None else str(default)
    flags = f"--{flag}/--no-{flag}" if bare is bool else f"--{flag}"
    text = rulers_help() if name == "rulers" else stated.help
    option = typer.Option(flags, help=text, rich_help_panel=_FIRST_PANEL if stated.first else panel, **more)
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
