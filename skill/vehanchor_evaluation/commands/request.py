"""Commands whose options are the fields of a dataclass, with or without the options of the method."""

from __future__ import annotations

import inspect
import typing
from typing import TYPE_CHECKING, Any, TypeVar

from vehanchor.cli.cli_options import ParsedOptions, scale_command
from vehanchor.cli.terminal import exit_on_error

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

Request = TypeVar("Request")


def plain_command(request: type[Request]) -> Callable[[Callable[[Request], None]], Callable[..., None]]:
    """Give a command the fields of a dataclass as its options.

    Args:
        request: the dataclass; its fields are annotated for Typer.

    Returns:
        A decorator for a function of one such object; the result is for Typer, and tells errors on stderr.
    """

    def decorate(command: Callable[[Request], None]) -> Callable[..., None]:
        def run(**typed: Any) -> None:
            with exit_on_error():
                command(request(**typed))

        return _declared(run, command, _parameters(request))

    return decorate


def measuring_command(
    request: type[Request], *, without: Collection[str] = ()
) -> Callable[[Callable[[Request, ParsedOptions], None]], Callable[..., None]]:
    """As ``plain_command``, with all options of the method, too.

    Args:
        request: the dataclass.
        without: options of the method that make no sense for this command; a frame and known lengths, which
            belong to one image, never do.

    Returns:
        A decorator for a function of the request and what was chosen for the method.
    """

    def decorate(command: Callable[[Request, ParsedOptions], None]) -> Callable[..., None]:
        def run(chosen: ParsedOptions, **typed: Any) -> None:
            with exit_on_error():
                command(request(**typed), chosen)

        chosen = inspect.Parameter("chosen", inspect.Parameter.KEYWORD_ONLY, annotation=ParsedOptions)
        declared = _declared(run, command, [*_parameters(request), chosen])
        return scale_command(
            without={"frame", "coordinates", "known_lengths", "effort", "max_tiles", "max_seconds", *without}
        )(declared)

    return decorate


def _parameters(request: type[Any]) -> list[inspect.Parameter]:
    kinds = typing.get_type_hints(request, include_extras=True)
    return [
        each.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=kinds[name])
        for name, each in inspect.signature(request).parameters.items()
    ]


def _declared(
    run: Callable[..., None], command: Callable[..., None], parameters: list[inspect.Parameter]
) -> Callable[..., None]:
    """The function to be called, looking to Typer like the command with these parameters."""
    run.__name__, run.__doc__, run.__module__ = command.__name__, command.__doc__, command.__module__
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {each.name: each.annotation for each in parameters}
    return run
