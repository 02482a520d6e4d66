"""Command-line options made from the option groups and the runtime, the same for every command.

    @scale_command()
    def estimate(images: ..., chosen: ParsedOptions) -> None:
        engine = chosen.engine()

``estimate`` then has its own options, and those of ``ScaleOptions``, of the detector and of its
runtime: the usual ones in ``--help``, all of them in a TOML file with the keywords of the library.
Typer passes texts; the option groups read and check them, so that errors are the library's own.
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
from vehanchor.options.signature import set_signature
from vehanchor.rulers.active import rulers_help
from vehanchor.storage.text import decoded

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
_MODEL_OPTIONS = {
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
        file: TOML file with further values; None without one.
        names: keywords of the command's options.
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
            text = decoded(self.file.read_bytes())
            from_file = tomllib.loads(text)
        except (OSError, ValueError) as error:
            raise InvalidParameterError(
                f"--options {str(self.file)!r} cannot be read: {error}"
            ) from None
        for name in from_file:
            if name not in self.names:
                names = ", ".join(sorted(self.names))
                raise InvalidParameterError(
                    f"--options {str(self.file)!r} has {name!r}: the options of this command are "
                    f"{names}"
                )
        return {**from_file, **self.typed}

    def options(self) -> ScaleOptions:
        """Make the options of the method.

        Raises:
            InvalidParameterError: a value is invalid.
            CalibrationFileError: the calibration cannot be read.
        """
        declared = declared_options()
        keywords = {}
        for name, value in self.values.items():
            if name in declared:
                keywords[name] = value
        return ScaleOptions.of(keywords)

    @property
    def detector(self) -> str | None:
        """Path of an ONNX oriented-box model, or name of a bundled one; None for the default."""
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
        values = self.values
        fields = {}
        for name in ("threads", "providers"):
            if name in values:
                fields[name] = values[name]
        return Runtime(**fields, progress=progress)

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

    def loaded_engine(self) -> Engine:
        """Make an engine whose networks are loaded.

        Raises:
            ModelError: a model cannot be used.
            VehAnchorError: as ``engine``.
        """
        from concurrent.futures import ThreadPoolExecutor

        from vehanchor.detection.chips import prepare_colours
        from vehanchor.detection.detector import open_detector
        from vehanchor.models.zoo import load_ruler_networks

        options = self.options()
        runtime = self.runtime()
        # ONNX Runtime and OpenCV leave the interpreter to this thread, which imports the rest
        # meanwhile. Nobody waits for the colours, which are the last things that a search needs.
        thread = ThreadPoolExecutor(1)
        opening = thread.submit(open_detector, self.detector, self.classes, runtime)
        thread.submit(prepare_colours)
        thread.shutdown(wait=False)
        from vehanchor.engine import Engine

        load_ruler_networks(runtime)
        detector = opening.result()
        return Engine(detector, options=options, runtime=runtime)


def read_classes(values: Iterable[object]) -> list[str | int] | None:
    """Read classes of a model; digits are indices. None without any."""
    classes: list[str | int] = []
    for value in values:
        text = str(value)
        classes.append(int(text) if text.isdecimal() else text)
    return classes or None


def scale_command(
    *, without: Collection[str] = ()
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Add the options of all groups to a command, and report its errors.

    Args:
        without: keywords of options that do not apply to this command.

    Returns:
        A decorator for a function that receives the options as the keyword ``chosen``; its result
        is a Typer command.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        # Typer needs the annotated types, not their names as texts.
        own = dict(inspect.signature(command, eval_str=True).parameters)
        del own["chosen"]
        added = _option_parameters(without={*without, *own})
        names = frozenset(parameter.name for parameter in added)

        @functools.wraps(command)
        def parse_and_run(**arguments: Any) -> None:
            typed = {}
            for name in names:
                value = arguments.pop(name)
                if value not in (None, []):
                    typed[name] = value
            file = arguments.pop(_FILE)
            with exit_on_error():
                command(**arguments, chosen=ParsedOptions(typed, file, names))

        set_signature(parse_and_run, [*own.values(), *added, _FILE_PARAMETER])
        return parse_and_run

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


def _option_parameters(without: Collection[str]) -> list[inspect.Parameter]:
    """Make the parameters of a Typer command for all options; the usual ones come first."""
    usual = []
    others = []
    for name, option, kind, default in _command_line_options():
        if name in without:
            continue
        parameter = _parameter(name, option, kind=kind, default=default)
        if option.first:
            usual.append(parameter)
        else:
            others.append(parameter)
    return usual + others


def _command_line_options() -> Iterator[tuple[str, Option, Any, Any]]:
    """List keyword, declaration, type and default of each option that the command line offers."""
    for name, option in _MODEL_OPTIONS.items():
        yield name, option, str, None
    for name, declared in declared_options().items():
        if declared.option.cli:
            yield name, declared.option, declared.kind, declared.default


def _parameter(name: str, option: Option, *, kind: Any, default: Any) -> inspect.Parameter:
    """Make a keyword-only parameter with an annotation for Typer.

    A flag takes a bool. Any other option takes texts, which its group reads.
    """
    is_flag = kind is bool
    without_unit = re.sub("_(px|m)$", "", name)
    flag = option.flag or without_unit.replace("_", "-")
    metavar = option.metavar
    if not metavar and typing.get_origin(kind) is Literal:
        metavar = "|".join(typing.get_args(kind))
    show_default = not is_flag and default not in (None, (), "assumed")
    declared = typer.Option(
        f"--{flag}/--no-{flag}" if is_flag else f"--{flag}",
        help=rulers_help() if name == "rulers" else option.help,
        metavar=metavar or None,
        hidden=not option.first,
        show_default=str(default) if show_default else False,
    )

    n_values = len(metavar.split())
    typer_kind: Any
    if is_flag:
        typer_kind = bool
    elif option.repeated:
        typer_kind = list[str]
    elif n_values > 1:
        typer_kind = types.GenericAlias(tuple, (str,) * n_values)
    else:
        typer_kind = str
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=None,
        annotation=Annotated[typer_kind | None, declared],
    )
