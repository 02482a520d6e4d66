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
from vehanchor.options.signature import set_signature
from vehanchor_server.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

_VIEW_SETTINGS = ("detector", "segmenter", "calibration", "threads", "providers", "max_megapixels")
# Headings of the help; each begins at this setting.
_PANELS = {"roots": "Image sources", "detector": "Models and limits", "host": "HTTP"}
_VIEW_DEADLINE_S = 600.0  # people see the progress and can leave


def _with_settings(
    names: Collection[str] | None = None,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Give a command the options of settings, in place of its ``**options``.

    Args:
        names: names of the settings; None for all.
    """

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        annotations = typing.get_type_hints(command, include_extras=True)
        parameters = []
        for parameter in inspect.signature(command).parameters.values():
            if parameter.kind is not parameter.VAR_KEYWORD:
                parameters.append(parameter.replace(annotation=annotations[parameter.name]))
        panel = ""
        for setting in fields(Settings):
            panel = _PANELS.get(setting.name, panel)
            if names is None or setting.name in names:
                parameters.append(_parameter(setting.name, setting.default, panel))
        set_signature(command, parameters)
        return command

    return decorate


def _parameter(name: str, default: Any, panel: str) -> inspect.Parameter:
    """Convert a setting to a Typer option.

    Its default None (flags: False) lets the environment variable apply.
    """
    declared = typing.get_type_hints(Settings, include_extras=True)[name].__metadata__[-1]
    flag = declared.flag or name.replace("_", "-")
    option = typer.Option(
        f"--{flag}",
        help=declared.help,
        metavar=declared.metavar or None,
        rich_help_panel=panel,
        show_default=_shown_default(default),
    )
    kind = typing.get_type_hints(Settings)[name]
    if kind is bool:
        annotation: Any = bool
        no_value = False
    else:
        # Typer takes a repeatable option for a list.
        if Ellipsis in typing.get_args(kind):
            kind = types.GenericAlias(list, typing.get_args(kind)[:1])
        annotation = kind | None
        no_value = None
    return inspect.Parameter(
        name,
        inspect.Parameter.KEYWORD_ONLY,
        default=no_value,
        annotation=Annotated[annotation, option],
    )


def _shown_default(default: Any) -> str | bool:
    """Return a default for the help; False shows none."""
    if isinstance(default, float):
        return f"{default:g}"
    return str(default) if default else False


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
    with exit_on_error():
        if schemas is not None or skill:
            _print_definitions(schemas, skill=skill)
            return
        settings = Settings.from_environment(**_set_options(options))
        # Late, and before the transports: it makes their import of the SDK quicker.
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
        text = files("vehanchor_server").joinpath("SKILL.md").read_text(encoding="utf-8")
        typer.echo(text, nl=False)


def _set_options(options: dict[str, Any]) -> dict[str, Any]:
    """Return the options that the command line sets, with tuples for lists; 0 is a value."""
    values = {}
    for name, value in options.items():
        is_empty = isinstance(value, list | tuple) and not value
        if value is None or value is False or is_empty:
            continue
        values[name] = tuple(value) if isinstance(value, list) else value
    return values


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
    """Show photographs in your browser with scale, vehicles and rulers; measure by clicks.

    Only this machine can reach the page, at an address with a random token. Ctrl-C ends it.
    """
    import webbrowser

    def opened(url: str) -> None:
        typer.echo(f"Open {url} in a browser on this machine. Press Ctrl-C to stop.", err=True)
        if browser:
            webbrowser.open(url)

    with exit_on_error():
        # Here, so that a missing or older package is named.
        from vehanchor_server.transport.viewer import serve_viewer

        selected = None
        roots: tuple[Path, ...] = ()
        if photographs is not None and photographs.is_file():
            selected = photographs.resolve()
            roots = (selected.parent,)
        elif photographs is not None:
            roots = (photographs,)
        settings = Settings(
            roots=roots,
            deadline_s=_VIEW_DEADLINE_S,
            isolation="in-process",
            **_set_options(options),
        )
        serve_viewer(settings, selected, port=port, opened=opened)
