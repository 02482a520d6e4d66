"""``vehanchor serve``, ``view``, ``schemas`` and ``skill``, for the command line to mount."""

from __future__ import annotations

import gc
import inspect
import typing
from dataclasses import Field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vehanchor_server.settings import Settings, SettingsError

if TYPE_CHECKING:
    from vehanchor.options.option import Option

_VIEWED_WITH = (  # settings that are options of ``view``, too
    "detector",
    "segmenter",
    "calibration",
    "threads",
    "providers",
    "min_score",
    "max_image_mb",
    "max_megapixels",
    "max_windowed_megapixels",
)
_VIEW_DEADLINE_S = 600.0  # a person sees how far it is, and can leave


def _parameters() -> list[inspect.Parameter]:
    """The options of ``serve``: the transport, and one for each setting."""
    http = Annotated[bool, typer.Option("--http", help="Listen for HTTP instead of serving stdin and stdout.")]
    kinds = typing.get_type_hints(Settings)
    return [
        inspect.Parameter("http", inspect.Parameter.KEYWORD_ONLY, default=False, annotation=http),
        *(_parameter(each, kinds[each.name]) for each in fields(Settings)),
    ]


def _parameter(setting: Field[Any], kind: Any) -> inspect.Parameter:
    """A setting as Typer wants it; not given, it is None, or False for a flag, so that its variable may speak."""
    stated: Option = setting.metadata["option"]
    option = typer.Option(
        f"--{stated.flag or setting.name.replace('_', '-')}",
        help=_help(setting),
        metavar=stated.metavar or None,
        rich_help_panel=setting.metadata["panel"],
        show_default=False,
    )
    default = False if kind is bool else None
    if Ellipsis in typing.get_args(kind):
        repeated: Any = list
        kind = repeated[typing.get_args(kind)[0]]
    if default is None:
        kind = kind | None
    return inspect.Parameter(
        setting.name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, option]
    )


def _help(setting: Field[Any]) -> str:
    """The setting's sentence, with its default in brackets."""
    text: str = setting.metadata["option"].help
    default = setting.metadata["if_unset"]
    if setting.default and setting.default is not True:
        default = f"{setting.default:g}" if isinstance(setting.default, float) else str(setting.default)
    return f"{text.removesuffix('.')} \\[{default}]." if default else text  # a bare [ begins Rich's markup


def serve(http: bool = False, **options: Any) -> None:
    """Serve the tools to agents over MCP: on stdin and stdout, or over HTTP at /mcp.

    Every option is also a variable: --max-image-mb is VEHANCHOR_MAX_IMAGE_MB, --root is VEHANCHOR_ROOTS. Several paths
    in one variable are separated by the system's path separator.
    """
    given = {name: tuple(value) if isinstance(value, list) else value for name, value in options.items()}
    try:
        settings = Settings.from_environment(**{name: value for name, value in given.items() if _says_something(value)})
        if http:
            from vehanchor_server.transport.http import serve_http

            serve_http(settings)
        else:
            gc.disable()  # importing the SDK makes thousands of classes: looking for garbage among them is slow
            try:
                from vehanchor_server.transport.stdio import serve_stdio
            finally:
                gc.enable()
            serve_stdio(settings)
    except SettingsError as error:
        typer.echo(f"error[invalid_settings]: {error}", err=True)
        raise typer.Exit(2) from None


serve.__signature__ = inspect.Signature(_parameters())  # type: ignore[attr-defined] # what Typer reads,
serve.__annotations__ = {each.name: each.annotation for each in _parameters()}  # and where it looks for the types


def _says_something(value: Any) -> bool:
    """Whether an option was given: 0 is a value, and a flag's absence is none."""
    return value is not None and value is not False and value != ()


def view(
    photographs: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FOLDER]", help="Folder of photographs, or one of them. Others can be dropped.", show_default=False
        ),
    ] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of 127.0.0.1; 0 for any that is free.")] = 0,
    browser: Annotated[bool, typer.Option(help="Open the page in the browser.")] = True,
    **options: Any,
) -> None:
    """Look at photographs in a page of your own browser: scale, vehicles, rulers; distances and areas by clicks.

    The page is served to this machine only, at an address with a random token, until Ctrl-C.
    """
    import webbrowser

    from vehanchor_server.transport.viewer import serve_viewer

    def opened(url: str) -> None:
        typer.echo(f"Open {url} in a browser of this machine. Ctrl-C ends it.", err=True)
        if browser:
            webbrowser.open(url)

    try:
        chosen = photographs.resolve() if photographs is not None and photographs.is_file() else None
        roots = () if photographs is None else (photographs if chosen is None else chosen.parent,)
        given = {name: tuple(value) if isinstance(value, list) else value for name, value in options.items()}
        said: dict[str, Any] = {name: value for name, value in given.items() if _says_something(value)}
        settings = Settings(roots=roots, deadline_s=_VIEW_DEADLINE_S, in_process=True, **said)  # one's own photographs
        serve_viewer(settings, chosen, port, opened)
    except SettingsError as error:
        typer.echo(f"error[invalid_settings]: {error}", err=True)
        raise typer.Exit(2) from None
    except OSError as error:
        typer.echo(f"error[port_taken]: cannot listen on port {port}: {error.strerror}; use another --port", err=True)
        raise typer.Exit(2) from None


def _own_parameters(command: Any) -> list[inspect.Parameter]:
    kinds = typing.get_type_hints(command, include_extras=True)
    own = inspect.signature(command).parameters.values()
    return [each.replace(annotation=kinds[each.name]) for each in own if each.kind is not each.VAR_KEYWORD]


_VIEW_PARAMETERS = [
    *_own_parameters(view),
    *(each.replace(kind=inspect.Parameter.KEYWORD_ONLY) for each in _parameters() if each.name in _VIEWED_WITH),
]
view.__signature__ = inspect.Signature(_VIEW_PARAMETERS)  # type: ignore[attr-defined]
view.__annotations__ = {each.name: each.annotation for each in _VIEW_PARAMETERS}


def schemas(
    directory: Annotated[Path, typer.Argument(help="Directory to write to.")] = Path("schemas"),
) -> None:
    """Write the tools' JSON Schemas, and the same tools as Anthropic and OpenAI definitions."""
    from vehanchor_server.schemas import write_schemas

    for path in write_schemas(directory):
        typer.echo(path)


def skill(
    install: Annotated[
        Path | None,
        typer.Option(
            "--install",
            metavar="DIR",
            help="Folder of an agent's skills, such as ~/.claude/skills: writes DIR/vehanchor/SKILL.md.",
        ),
    ] = None,
) -> None:
    """Print the skill file for agents, or install it where an agent looks for its skills."""
    from importlib.resources import files

    text = files("vehanchor_server").joinpath("SKILL.md").read_text(encoding="utf-8")
    if install is None:
        typer.echo(text, nl=False)
        return
    target = install / "vehanchor" / "SKILL.md"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text, encoding="utf-8")
    except OSError as error:
        typer.echo(f"error[output_unwritable]: cannot write {str(target)!r}: {error.strerror or error}", err=True)
        raise typer.Exit(2) from None
    typer.echo(target)
