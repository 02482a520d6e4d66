"""Commands whose options are the fields of a dataclass, with or without the options of the estimate."""

from __future__ import annotations

import inspect
import typing
from typing import TYPE_CHECKING, Any, TypeVar

from vehanchor.cli.cli_options import ParsedOptions, scale_command
from vehanchor.cli.terminal import exit_on_error
from vehanchor.options.by_hand import BY_HAND

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

Request = TypeVar("Request")

_OF_ONE_IMAGE = ("frame", "coordinates", "known_lengths", *BY_HAND)


def plain_command(request: type[Request]) -> Callable[[Callable[[Request], None]], Callable[..., None]]:
    """Create a command with the fields of a dataclass as options.

    Args:
        request: the dataclass; its fields are annotated for Typer.

    Returns:
        A decorator for a function of the dataclass; the result is for Typer and prints errors to stderr.
    """

    def decorate(command: Callable[[Request], None]) -> Callable[..., None]:
        def run(**typed: Any) -> None:
            with exit_on_error():
                command(request(**typed))

        return _with_signature(run, command, _parameters(request))

    return decorate


def measuring_command(
    request: type[Request], *, without: Collection[str] = ()
) -> Callable[[Callable[[Request, ParsedOptions], None]], Callable[..., None]]:
    """Create a command as ``plain_command`` does, and add the options of the estimate.

    Args:
        request: the dataclass.
        without: options of the estimate that do not apply to this command; those of one image
            never apply.

    Returns:
        A decorator for a function of the request and the parsed options.
    """

    def decorate(command: Callable[[Request, ParsedOptions], None]) -> Callable[..., None]:
        def run(chosen: ParsedOptions, **typed: Any) -> None:
            with exit_on_error():
                command(request(**typed), chosen)

        chosen = inspect.Parameter("chosen", inspect.Parameter.KEYWORD_ONLY, annotation=ParsedOptions)
        declared = _with_signature(run, command, [*_parameters(request), chosen])
        return scale_command(without={*_OF_ONE_IMAGE, "effort", "max_tiles", "max_seconds", *without})(declared)

    return decorate


def _parameters(request: type[Any]) -> list[inspect.Parameter]:
    kinds = typing.get_type_hints(request, include_extras=True)
    return [
        each.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=kinds[name])
        for name, each in inspect.signature(request).parameters.items()
    ]


def _with_signature(
    run: Callable[..., None], command: Callable[..., None], parameters: list[inspect.Parameter]
) -> Callable[..., None]:
    """Give the function the command's name and these parameters, for Typer."""
    run.__name__, run.__doc__, run.__module__ = command.__name__, command.__doc__, command.__module__
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run
