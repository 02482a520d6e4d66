"""The command line: each command is an entry point of the group ``vehanchor.commands`` and is loaded when called.

Results go to stdout; progress, errors and warnings go to stderr. Exit status: 0 for a result, also
without a scale; with ``--strict`` 3 for no scale or low confidence; 2 for bad input, bad options or
an output that cannot be written; 130 after Ctrl-C; 1 for an unforeseen error or a failed self-test.

A command is a Typer function, or a ``typer.Typer`` with several. ``pyproject.toml`` lists the
commands of the library, the evaluation and the server. A package is imported only when one of its
commands is called. Each command imports slow modules (OpenCV, ONNX Runtime, tables) itself, so that
help is fast.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from vehanchor.cli.multi_value import SpacedCommand
from vehanchor.cli.terminal import BAD_INPUT, INTERRUPTED, UNFORESEEN

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

_GROUP = "vehanchor.commands"
_PANELS = {  # in the order of --help; commands of other packages follow
    **dict.fromkeys(("estimate", "distance", "measure", "batch", "flight", "view"), "Measure"),
    "models": "This installation",
    "serve": "For agents",
}
_OTHER_PANEL = "Calibrate and evaluate"
_SETTINGS = {"help_option_names": ["-h", "--help"]}


class _Commands(TyperGroup):
    """Commands by the names of their entry points."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Name all commands that can be loaded."""
        first = list(_PANELS)
        names = sorted(
            _declared(), key=lambda name: (first.index(name) if name in first else len(first), name)
        )
        return [name for name in names if self.get_command(ctx, name) is not None]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Load a command; None if it does not exist or its package is not installed."""
        declared = _declared().get(cmd_name)
        if declared is None:
            return None
        try:
            loaded = declared.load()
        except ModuleNotFoundError as error:
            if ctx.invoked_subcommand == cmd_name or cmd_name in sys.argv[1:2]:
                print(
                    f"error[command_missing]: '{cmd_name}' needs {error.name}: reinstall vehanchor",
                    file=sys.stderr,
                )
                raise typer.Exit(BAD_INPUT) from None
            return None
        if not isinstance(loaded, typer.Typer):
            single = typer.Typer(
                add_completion=False, pretty_exceptions_enable=False, context_settings=_SETTINGS
            )
            single.command(cmd_name, cls=SpacedCommand, context_settings=_SETTINGS)(loaded)
            loaded = single
        command = typer.main.get_command(loaded)
        command.name = cmd_name
        command.rich_help_panel = _PANELS.get(cmd_name, _OTHER_PANEL)  # type: ignore[attr-defined] # typer reads it
        return command


def _declared() -> dict[str, EntryPoint]:
    return {each.name: each for each in entry_points(group=_GROUP)}


app = typer.Typer(
    name="vehanchor",
    cls=_Commands,
    help="Metric scale for aerial images without metadata: cars as the ruler. Exit status: 0 "
    "(done), 2 (bad input), 3 (with --strict: an unusable result), 1 (a defect), 130 "
    "(interrupted).",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings=_SETTINGS,
)


def main() -> None:
    """Run the command line; the entry point of ``vehanchor`` and of ``python -m vehanchor``."""
    # imports create 170,000 lasting objects; to visit them again takes a tenth of the time
    gc.set_threshold(200_000)
    atexit.register(gc.freeze)  # else Python visits them thrice when it exits, for 0.1 s
    # before its import; our errors report the problem
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    try:
        try:
            app(prog_name="vehanchor")
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # the reader has closed the pipe, as `| head` does
        # avoids an error when Python exits
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(UNFORESEEN)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def _show_version(wanted: bool) -> None:
    if wanted:
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
    del version  # its callback has printed it
