"""The commands ``vehanchor serve`` and ``view``."""

from __future__ import annotations

import inspect
import types
import typing
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vehanchor.cli.terminal import exit_on_error
from vehanchor_server.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

_VIEW_SETTINGS = ("detector", "segmenter", "calibration", "threads", "providers", "max_megapixels")
# each begins at this setting
_PANELS = {"roots": "Image sources", "detector": "Models and limits", "host": "HTTP"}
_VIEW_DEADLINE_S = 600.0  # people see the progress and can leave


def _with_settings(
    names: Collection[str] | None = None,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of settings, in place of its ``**options``; None for every setting."""

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        kinds = typing.get_type_hints(command, include_extras=True)
        own = [
            each
            for each in inspect.signature(command).parameters.values()
            if each.kind is not each.VAR_KEYWORD
        ]
        parameters = [each.replace(annotation=kinds[each.name]) for each in own]
        panel = ""
        for each in fields(Settings):
            panel = _PANELS.get(each.name, panel)
            if names is None or each.name in names:
                parameters.append(_parameter(each.name, each.default, panel))
        command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined] # what Typer reads
        command.__annotations__ = {each.name: each.annotation for each in parameters}
        return command

    return decorate


def _parameter(name: str, default: Any, panel: str) -> inspect.Parameter:
    """Convert a setting to a Typer option; the default None (flags: False) lets the environment variable apply."""
    declared = typing.get_type_hints(Settings, include_extras=True)[name].__metadata__[-1]
    option = typer.Option(
        f"--{declared.flag or name.replace('_', '-')}",
        help=declared.help,
        metavar=declared.metavar or None,
        rich_help_panel=panel,
        show_default=f"{default:g}" if isinstance(default, float) else str(default or "") or False,
    )
    kind = typing.get_type_hints(Settings)[name]
    if Ellipsis in typing.get_args(kind):
        kind = types.GenericAlias(list, typing.get_args(kind)[:1])
    no_value, kind = (False, bool) if kind is bool else (None, kind | None)
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=no_value, annotation=Annotated[kind, option]
    )


@_with_settings()
def serve(
    http: Annotated[bool, typer.Option("--http", help="Serve over HTTP instead of stdio.")] = False,
    schemas: Annotated[
        Path | None,
        typer.Option(
            "--schemas",
            metavar="DIR",
            help="Write the tools' JSON Schemas and their Anthropic and OpenAI definitions to a "
            "directory, then exit.",
        ),
    ] = None,
    skill: Annotated[
        bool, typer.Option("--skill", help="Print the skill file for agents, then exit.")
    ] = False,
    **options: Any,
) -> None:
    """Serve the tools over MCP: on stdio, or over HTTP at /mcp.

    Every option has an environment variable: --deadline-s is VEHANCHOR_DEADLINE_S, --root is
    VEHANCHOR_ROOTS. The system's path separator separates several paths in one variable.
    """
    if schemas is not None or skill:
        _print_definitions(schemas, skill=skill)
        return
    with exit_on_error():
        settings = Settings.from_environment(**_given(options))
        from vehanchor_server.transport.quick_import import import_sdk

        import_sdk()
        if http:
            from vehanchor_server.transport.http import serve_http as run
        else:
            from vehanchor_server.transport.stdio import serve_stdio as run
        run(settings)


def _print_definitions(schemas: Path | None, *, skill: bool) -> None:
    """Write the schemas and print their paths; print the skill file."""
    from importlib.resources import files

    from vehanchor_server.schemas import schema_files

    if schemas is not None:
        schemas.mkdir(parents=True, exist_ok=True)
        for name, text in schema_files().items():
            (schemas / name).write_text(text, encoding="utf-8")
            typer.echo(schemas / name)
    if skill:
        typer.echo(
            files("vehanchor_server").joinpath("SKILL.md").read_text(encoding="utf-8"), nl=False
        )


def _given(options: dict[str, Any]) -> dict[str, Any]:
    """Return the options that were given; 0 is a value."""
    given = {
        name: tuple(value) if isinstance(value, list) else value for name, value in options.items()
    }
    return {
        name: value
        for name, value in given.items()
        if value is not None and value is not False and value != ()
    }


@_with_settings(_VIEW_SETTINGS)
def view(
    photographs: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FOLDER]",
            help="Folder of photographs, or one photograph. Drop others on the page.",
            show_default=False,
        ),
    ] = None,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port on 127.0.0.1; 0 for a free one.")
    ] = 0,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
    **options: Any,
) -> None:
    """Show photographs in your browser with scale, vehicles and rulers; measure distances and areas by clicks.

    Only this machine can reach the page, at an address with a random token. Ctrl-C ends it.
    """
    import webbrowser

    from vehanchor_server.transport.viewer import serve_viewer

    def opened(url: str) -> None:
        typer.echo(f"Open {url} in a browser on this machine. Press Ctrl-C to stop.", err=True)
        if browser:
            webbrowser.open(url)

    with exit_on_error():
        selected = (
            photographs.resolve() if photographs is not None and photographs.is_file() else None
        )
        roots = (
            () if photographs is None else (photographs if selected is None else selected.parent,)
        )
        settings = Settings(
            roots=roots, deadline_s=_VIEW_DEADLINE_S, isolation="in-process", **_given(options)
        )
        serve_viewer(settings, selected, port=port, opened=opened)
