"""Command-line options made from the option groups and the runtime, the same for every command.

    @scale_command()
    def estimate(images: ..., chosen: ParsedOptions) -> None:
        engine = chosen.engine()

``estimate`` then has the options of ``ScaleOptions``, of the detector and of its runtime beside its
own: the usual ones in ``--help``, all of them in a TOML file with the keywords of the library. The
options check the values, so that the command can report errors.
"""

from __future__ import annotations

import functools
import inspect
import re
import tomllib
import types
import typing
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import typer

from vehanchor.cli.terminal import exit_on_error
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.formats.header import IMAGE_FORMATS
from vehanchor.models.runtime import Progress, Runtime
from vehanchor.options import ScaleOptions, declared_options, models
from vehanchor.options.option import Option
from vehanchor.rulers.active import rulers_help

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Iterator, Mapping

    from vehanchor.engine import Engine

Photograph: TypeAlias = Annotated[
    str,
    typer.Argument(
        metavar="IMAGE", help=f"Photograph: {', '.join(IMAGE_FORMATS)}.", show_default=False
    ),
]
OF_ONE_IMAGE = ("frame", "coordinates", "known_lengths", "drop", "add")
"""Options that belong to one image."""

_FILE = "options_file"
_MODELS = {
    "detector": models.DETECTOR,
    "classes": models.CLASSES,
    "threads": models.THREADS,
    "providers": models.PROVIDERS,
}


@dataclass(frozen=True)
class ParsedOptions:
    """Values of the options by keyword, from the command line and a file; checked on use.

    Attributes:
        typed: values of the command line.
        file: TOML file with further ones; None without one.
        names: options of the command.
    """

    typed: Mapping[str, Any]
    file: Path | None = None
    names: Collection[str] = field(default=())

    @cached_property
    def values(self) -> Mapping[str, Any]:
        """All values; those of the command line take precedence.

        Raises:
            InvalidParameterError: the file cannot be read, or has an option that the command does
                not have.
        """
        if self.file is None:
            return self.typed
        try:
            of_file = tomllib.loads(self.file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InvalidParameterError(
                f"--options {str(self.file)!r} cannot be read: {error}"
            ) from None
        unknown = next((name for name in of_file if name not in self.names), None)
        if unknown is not None:
            raise InvalidParameterError(
                f"--options {str(self.file)!r} has {unknown!r}: the options of this command are "
                f"{', '.join(sorted(self.names))}"
            )
        return {**of_file, **self.typed}

    def options(self) -> ScaleOptions:
        """Make the options of the method.

        Raises:
            InvalidParameterError: a value is invalid.
            CalibrationFileError: the calibration cannot be read.
        """
        return ScaleOptions.of(
            {name: value for name, value in self.values.items() if name in declared_options()}
        )

    @property
    def detector(self) -> str | None:
        """Path of an ONNX oriented-box model, or the name of a bundled one; None for the bundled default."""
        detector: str | None = self.values.get("detector")
        return detector

    @property
    def classes(self) -> list[str | int] | None:
        """Classes that count as vehicles; None for the model's own."""
        return read_classes(self.values.get("classes", ()))

    def runtime(self, progress: Progress | None = None) -> Runtime:
        """Make the runtime of the models.

        Raises:
            InvalidParameterError: the threads or the providers are invalid.
        """
        given = {
            name: self.values[name] for name in ("threads", "providers") if name in self.values
        }
        return Runtime(**given, progress=progress)

    def engine(
        self,
        *,
        segmenter: tuple[str | Path, str | Path] | None = None,
        progress: Progress | None = None,
    ) -> Engine:
        """Make the engine; it loads each model on first use.

        Raises:
            InvalidParameterError: a value is invalid.
            CalibrationFileError: the calibration cannot be read.
        """
        from vehanchor.engine import Engine

        options = self.options()
        runtime = self.runtime(progress)
        return Engine(
            self.detector, segmenter, classes=self.classes, options=options, runtime=runtime
        )


def read_classes(values: Iterable[object]) -> list[str | int] | None:
    """Read classes of a model; digits are indices. None without any."""
    return [int(each) if each.isdecimal() else each for each in map(str, values)] or None


def scale_command(
    *, without: Collection[str] = ()
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Add the options of all groups to a command, which receives them as the argument ``chosen``; report its errors.

    Args:
        without: keywords of options that do not apply to this command.

    Returns:
        A decorator for a function with a parameter ``chosen``; its result is a Typer command.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        # Typer needs types, not their names
        own = dict(inspect.signature(command, eval_str=True).parameters)
        del own["chosen"]
        shown = [
            (name, option, each)
            for name, option, each in _parameters()
            if name not in {*without, *own}
        ]
        added = [each for _, _, each in sorted(shown, key=lambda one: not one[1].first)]
        names = frozenset(each.name for each in added)

        @functools.wraps(command)
        def with_choices(**arguments: Any) -> None:
            typed = {
                name: value for name in names if (value := arguments.pop(name)) not in (None, [])
            }
            file = arguments.pop(_FILE)
            with exit_on_error():
                command(**arguments, chosen=ParsedOptions(typed, file, names))

        parameters = [each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in own.values()]
        parameters += [*added, _FILE_PARAMETER]
        with_choices.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        with_choices.__annotations__ = {each.name: each.annotation for each in parameters}
        return with_choices

    return decorate


_FILE_PARAMETER = inspect.Parameter(
    _FILE,
    inspect.Parameter.KEYWORD_ONLY,
    default=None,
    annotation=Annotated[
        Path | None,
        typer.Option(
            "--options",
            metavar="FILE.toml",
            help="Further options of the method by keyword, such as effort = 'full'; see the "
            "reference.",
        ),
    ],
)


def _parameters() -> Iterator[tuple[str, Option, inspect.Parameter]]:
    """Make the parameters of a Typer command: name, declaration, and a keyword-only parameter annotated for Typer."""
    for name, option in _MODELS.items():
        yield name, option, _parameter(name, option, str, None)
    for name, each in declared_options().items():
        if each.option.cli:
            yield name, each.option, _parameter(name, each.option, each.kind, each.default)


def _parameter(name: str, option: Option, bare: Any, default: Any) -> inspect.Parameter:
    """Make a parameter that takes texts, which the option reads; a flag; or a list of texts."""
    flag = option.flag or re.sub("_(px|m)$", "", name).replace("_", "-")
    metavar = option.metavar or (
        "|".join(typing.get_args(bare)) if typing.get_origin(bare) is Literal else ""
    )
    n_values = len(metavar.split())
    kind: Any
    if bare is bool:
        flag = f"{flag}/--no-{flag}"
        kind = bool
    elif option.repeated:
        kind = list[str]
    else:
        kind = types.GenericAlias(tuple, (str,) * n_values) if n_values > 1 else str
    declared = typer.Option(
        f"--{flag}",
        help=rulers_help() if name == "rulers" else option.help,
        metavar=metavar or None,
        hidden=not option.first,
        show_default=str(default)
        if default not in (None, (), "assumed") and bare is not bool
        else False,
    )
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=None,
        annotation=Annotated[kind | None, declared],
    )
