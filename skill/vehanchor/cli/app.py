"""Command line: its commands are entry points of the group ``vehanchor.commands``.

Results go to stdout; progress, errors and warnings go to stderr. The exit status is 0 for a result,
even without a scale; 3 with ``--strict`` for no scale or low confidence; 2 for bad input, bad
options or an output that cannot be written; 130 after Ctrl-C; 1 for an unforeseen error or a failed
self-test.

An entry point is a Typer function, or a ``typer.Typer`` with several commands. ``pyproject.toml``
lists those of the library, the evaluation and the server. A package is imported only when one of
its commands is called. Each command imports slow modules (OpenCV, ONNX Runtime, tables) itself, so
that help is fast.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys
from importlib.metadata import entry_points
from io import TextIOWrapper
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from vehanchor.cli.multi_value import SpacedCommand
from vehanchor.cli.terminal import BAD_INPUT, INTERRUPTED, UNFORESEEN, is_full, report_full

if TYPE_CHECKING:
    from collections.abc import Callable
    from importlib.metadata import EntryPoint

_GROUP = "vehanchor.commands"
_MEASURING = ("estimate", "distance", "measure", "batch", "flight", "view")
# Panels of --help by command, in the order of --help; other commands follow in _OTHER_PANEL.
_PANELS = {
    **dict.fromkeys(_MEASURING, "Measure"),
    "models": "This installation",
    "serve": "For agents",
}
_OTHER_PANEL = "Calibrate and evaluate"
_SETTINGS = {"help_option_names": ["-h", "--help"]}


class _Commands(TyperGroup):
    """Commands by the names of their entry points."""

    def list_commands(self, ctx: Any) -> list[str]:
        """List all commands that can be loaded, in the order of ``--help``."""
        names = sorted(_entry_points(), key=_help_position)
        return [name for name in names if self.get_command(ctx, name) is not None]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Load a command; None if it does not exist or its package is not installed."""
        entry_point = _entry_points().get(cmd_name)
        if entry_point is None:
            return None
        try:
            loaded = entry_point.load()
        except ModuleNotFoundError as error:
            # --help omits a command that cannot be loaded; a call of it deserves the reason.
            is_first = cmd_name in sys.argv[1:2]
            is_called = is_first or ctx.invoked_subcommand == cmd_name
            if not is_called:
                return None
            print(
                f"error[command_missing]: '{cmd_name}' needs {error.name}: reinstall vehanchor",
                file=sys.stderr,
            )
            raise typer.Exit(BAD_INPUT) from None
        typer_app = loaded
        if not isinstance(typer_app, typer.Typer):
            typer_app = _app_of(cmd_name, loaded)
        command = typer.main.get_command(typer_app)
        command.name = cmd_name
        # Typer's help reads this attribute.
        command.rich_help_panel = _PANELS.get(cmd_name, _OTHER_PANEL)  # type: ignore[attr-defined]
        return command


def _app_of(name: str, function: Callable[..., None]) -> typer.Typer:
    """Make a Typer application of one command from its function."""
    typer_app = typer.Typer(
        add_completion=False, pretty_exceptions_enable=False, context_settings=_SETTINGS
    )
    register = typer_app.command(name, cls=SpacedCommand, context_settings=_SETTINGS)
    register(function)
    return typer_app


def _entry_points() -> dict[str, EntryPoint]:
    registered = entry_points(group=_GROUP)
    return {entry_point.name: entry_point for entry_point in registered}


def _help_position(name: str) -> tuple[int, str]:
    """Return the sort key of a command in ``--help``: our order, then the alphabet."""
    ordered = list(_PANELS)
    if name in ordered:
        return ordered.index(name), name
    return len(ordered), name


app = typer.Typer(
    name="vehanchor",
    cls=_Commands,
    help="Metric scale for aerial images without metadata, with cars as the ruler. Exit status: 0 "
    "(done), 2 (bad input), 3 (with --strict: an unusable result), 1 (a defect), 130 "
    "(interrupted).",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings=_SETTINGS,
)


def main() -> None:
    """Run the command line; the entry point of ``vehanchor`` and of ``python -m vehanchor``."""
    # Imports create 170,000 lasting objects. The garbage collector would visit them again and
    # again, for a tenth of the time, and three more times at exit, for 0.1 s.
    gc.set_threshold(200_000)
    atexit.register(gc.freeze)
    # Without a standard stream, as after `>&-`, what is printed leads nowhere.
    if sys.stdout is None:
        sys.stdout = Path(os.devnull).open("w")  # noqa: SIM115 - until the process ends
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w")  # noqa: SIM115
    # A pipe's encoding, such as cp1252, lacks characters of file names: they are escaped.
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    # OpenCV reads this when it is imported; our errors report its problems.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    try:
        try:
            app(prog_name="vehanchor")
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        # The reader has closed the pipe, as `| head` does.
        _leave_stdout()
        sys.exit(UNFORESEEN)
    except OSError as error:
        if not is_full(error):
            raise
        report_full(error)
        _leave_stdout()
        sys.exit(BAD_INPUT)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _leave_stdout() -> None:
    """Let stdout lead nowhere: Python flushes it at exit, and would report an error."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())


def _show_version(show: bool) -> None:
    if show:
        from importlib.metadata import version

        print(f"vehanchor {version('vehanchor')}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_show_version, is_eager=True, help="Print the version and exit."
        ),
    ] = False,
) -> None:
    del version  # The callback of the option has printed it.
