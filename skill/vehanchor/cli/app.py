"""The command line: one command an entry point of the group ``vehanchor.commands``, loaded when it is called.

Results go to stdout, everything else (progress, errors, warnings) to stderr. Exit status: 0 with a result, also where
an image has no anchor; 3 there, and with low confidence, for ``--strict``; 2 for bad input, bad options or an output
that cannot be written; 130 after Ctrl-C; 1 for anything unforeseen, and for a self-test that fails.

A command is a function for Typer, or a ``typer.Typer`` of several. The library's own are listed in ``pyproject.toml``
beside those of the scenes, the evaluation and the server, none of which is imported before it is asked for; whatever is
slow to load (OpenCV, ONNX Runtime, tables) is imported by the command that needs it, so help comes at once.
"""

from __future__ import annotations

import os
import sys
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from vehanchor.cli.spaced import SpacedCommand
from vehanchor.cli.terminal import BAD_INPUT, INTERRUPTED, UNFORESEEN

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

_GROUP = "vehanchor.commands"
_PANELS = {
    **dict.fromkeys(("estimate", "distance", "measure", "batch", "flight", "scalebar", "view"), "Measure"),
    **dict.fromkeys(("serve", "schemas", "skill"), "For agents"),
    **dict.fromkeys(("doctor", "models"), "This installation"),
}
_OTHER_PANEL = "Calibrate and evaluate"
_FIRST = (
    "estimate",
    "distance",
    "measure",
    "batch",
    "flight",
    "scalebar",
    "view",
    "doctor",
    "models",
    "serve",
)  # in --help; what other packages bring follows
_SETTINGS = {"help_option_names": ["-h", "--help"]}


class _Commands(TyperGroup):
    """Commands by the names of their entry points."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Name all commands that can be loaded."""
        names = sorted(_declared(), key=lambda name: (_FIRST.index(name) if name in _FIRST else len(_FIRST), name))
        return [name for name in names if self.get_command(ctx, name) is not None]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Load a command; None where there is none of that name, or its package is not installed."""
        declared = _declared().get(cmd_name)
        if declared is None:
            return None
        try:
            loaded = declared.load()
        except ModuleNotFoundError as error:
            if ctx.invoked_subcommand == cmd_name or cmd_name in sys.argv[1:2]:
                print(f"error[command_missing]: '{cmd_name}' needs {error.name}: reinstall vehanchor", file=sys.stderr)
                raise typer.Exit(BAD_INPUT) from None
            return None
        if not isinstance(loaded, typer.Typer):
            single = typer.Typer(add_completion=False, pretty_exceptions_enable=False, context_settings=_SETTINGS)
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
    help="Metric scale for aerial images without metadata: cars as the ruler. Ends with 0 (done), 2 (bad input), "
    "3 (with --strict: a result not to be used), 1 (a defect) or 130 (interrupted).",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings=_SETTINGS,
)


def main() -> None:
    """Run the command line; the entry point of ``vehanchor`` and of ``python -m vehanchor``."""
    try:
        try:
            app(prog_name="vehanchor")
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # `| head` has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python complains on its way out
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
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    del version  # its callback has printed it
