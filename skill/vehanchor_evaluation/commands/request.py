"""Commands whose options are the fields of a dataclass and the options of the estimate."""

from __future__ import annotations

import inspect
import typing
from typing import TYPE_CHECKING, Any, TypeVar

from vehanchor.cli.cli_options import OF_ONE_IMAGE, ParsedOptions, scale_command
from vehanchor.options.signature import set_signature

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

Request = TypeVar("Request")


def measuring_command(
    request: type[Request], *, without: Collection[str] = ()
) -> Callable[[Callable[[Request, ParsedOptions], None]], Callable[..., None]]:
    """Create a command with the fields of a dataclass and the options of the estimate as options.

    Args:
        request: the dataclass; its fields are annotated for Typer.
        without: options of the estimate that do not apply to this command; those of one image
            never apply.

    Returns:
        A decorator for a function of the request and the parsed options; the result is for Typer.
    """
    # Every image is searched in full, so options that stop a search early do not apply.
    excluded = {*OF_ONE_IMAGE, "effort", "max_tiles", "max_seconds", *without}

    def decorate(command: Callable[[Request, ParsedOptions], None]) -> Callable[..., None]:
        def run(chosen: ParsedOptions, **typed: Any) -> None:
            command(request(**typed), chosen)

        # scale_command passes the parsed options under this name.
        parsed = inspect.Parameter(
            "chosen", inspect.Parameter.KEYWORD_ONLY, annotation=ParsedOptions
        )
        with_fields = as_command(run, command, [*fields_of(request), parsed])
        add_scale_options = scale_command(without=excluded)
        return add_scale_options(with_fields)

    return decorate


def fields_of(request: type[Any]) -> list[inspect.Parameter]:
    """Return the fields of a dataclass as parameters for Typer."""
    hints = typing.get_type_hints(request, include_extras=True)
    return [
        parameter.replace(annotation=hints[name])
        for name, parameter in inspect.signature(request).parameters.items()
    ]


def as_command(
    run: Callable[..., None], command: Callable[..., None], parameters: list[inspect.Parameter]
) -> Callable[..., None]:
    """Give the function the command's name and these parameters, for Typer."""
    run.__name__ = command.__name__
    run.__doc__ = command.__doc__
    run.__module__ = command.__module__
    set_signature(run, parameters)
    return run
