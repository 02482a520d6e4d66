"""Output of commands: results, errors, warnings and progress."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import PurePath
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from vehanchor.errors import OutOfMemoryError, VehAnchorError
from vehanchor.records.escaping import on_one_line
from vehanchor.records.text import by_hand_text

if TYPE_CHECKING:
    from vehanchor.records import GsdEstimate, Notice

# exit statuses
BAD_INPUT = 2
UNFORESEEN = 1
INTERRUPTED = 130
NOT_OK = 3  # with --strict: a result that is not usable
FAILED = 1  # a self-test, or every image of a batch
_LINE_EVERY_S = 10.0  # if stderr is not a terminal

Strict: TypeAlias = Annotated[
    bool,
    typer.Option(
        "--strict",
        help=f"Exit with status {NOT_OK} if a result is not ok: low confidence or no scale.",
    ),
]


def exit_strictly(strict: bool, statuses: Iterable[str]) -> None:
    """Exit with ``NOT_OK`` if the caller chose ``--strict`` and a result is not usable."""
    if strict and any(status != "ok" for status in statuses):
        raise typer.Exit(NOT_OK)


def report(error: VehAnchorError, about: str = "") -> None:
    """Print an error in one line on stderr, with its subject if the message does not name it."""
    message = str(error)
    prefix = f"{about}: " if about and about not in message else ""
    print(printable(f"error[{error.code}]: {prefix}{message}"), file=sys.stderr, flush=True)


@contextmanager
def exit_on_error() -> Iterator[None]:
    """Convert an exception of a command to one line on stderr and an exit status."""
    try:
        yield
    except VehAnchorError as error:
        report(error)
        raise typer.Exit(BAD_INPUT) from None
    except MemoryError:
        report(OutOfMemoryError("too little memory is left. Close other programs and try again"))
        raise typer.Exit(BAD_INPUT) from None
    except KeyboardInterrupt:
        raise typer.Exit(INTERRUPTED) from None
    except (typer.Exit, typer.Abort, typer.BadParameter, BrokenPipeError):
        raise
    except Exception as error:
        if os.environ.get("VEHANCHOR_TRACEBACK"):
            raise
        reason = printable(f"{type(error).__name__}: {error}".splitlines()[0])
        print(
            f"error[internal_error]: {reason}. This is a defect of vehanchor; for details, set "
            "VEHANCHOR_TRACEBACK=1",
            file=sys.stderr,
        )
        raise typer.Exit(UNFORESEEN) from None


@contextmanager
def work_progress(unit: str, *, lines: bool = False) -> Iterator[Callable[..., None]]:
    """Report work on stderr: a bar on a terminal, else a line every ten seconds.

    Yields the callback for finished and all units and, optionally, the name of the work.

    Args:
        unit: what is counted, in the plural.
        lines: write lines also on a terminal.
    """
    if lines or not sys.stderr.isatty():
        last = time.monotonic()

        def tell(done: int, total: int, name: str = "") -> None:
            nonlocal last
            if time.monotonic() - last >= _LINE_EVERY_S:
                last = time.monotonic()
                print(
                    printable(f"{name} {done} of {total} {unit}".lstrip()),
                    file=sys.stderr,
                    flush=True,
                )

        yield tell
        return
    from rich import progress
    from rich.console import Console
    from rich.markup import escape

    columns = (
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
    )
    # By default, rich redirects stdout to stderr.
    with progress.Progress(
        *columns,
        progress.TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
        redirect_stdout=False,
    ) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total, name="": bar.update(
            task, completed=done, total=total, description=escape(printable(name))
        )


@contextmanager
def failures_as_json(sources: Iterable[str], wanted: bool) -> Iterator[None]:
    """Print, if it is wanted, one JSON object for each image that an error prevents; the error goes on."""
    try:
        yield
    except VehAnchorError as error:
        for source in sources if wanted else ():
            print_json({"source": source, "error": {"code": error.code, "message": str(error)}})
        raise


def print_json(record: Mapping[str, Any]) -> None:
    """Print one JSON object in one line on stdout."""
    print(json.dumps(record, allow_nan=False), flush=True)  # ASCII: the same bytes in every locale


def printable(text: str, *, lines: bool = False) -> str:
    """Escape what a terminal would obey; ``lines`` keeps line ends, in texts of ours."""
    return "\n".join(map(on_one_line, text.split("\n"))) if lines else on_one_line(text)


def print_facts(title: str, facts: Iterable[tuple[str, str]]) -> None:
    """Print names and values in two columns under a title."""
    print_rows({"name": "name", "value": "text"}, facts, title, heading=False)


def print_rows(
    columns: Mapping[str, str],
    rows: Iterable[Sequence[str]],
    title: str = "",
    *,
    heading: bool = True,
) -> None:
    """Print a table on stdout, as wide as the terminal.

    Args:
        columns: their kinds by heading: ``text`` is folded, ``number`` is on the right, ``word`` on
            the left, ``name`` is coloured.
        rows: the cells of each row.
        title: title of the table; empty for none.
        heading: print the headings of the columns.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(
        box=box.SIMPLE_HEAD,
        pad_edge=not heading,
        show_header=heading,
        title=title and Text(printable(title)),
        title_justify="left",
        title_style="bold",
    )
    for name, kind in columns.items():
        table.add_column(
            name,
            style="cyan" if kind == "name" else None,
            overflow="fold" if kind == "text" else "ellipsis",
            no_wrap=kind != "text",
            justify="right" if kind == "number" else "left",
        )
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    Console(soft_wrap=False, highlight=False).print(table)


def counts_text(counts: Mapping[str, int]) -> str:
    """List the numbers of results by status."""
    statuses = ("ok", "low_confidence", "no_scale", "error")
    return ", ".join(f"{counts[status]} {status}" for status in statuses if status in counts)


STATUS_TEXTS = {
    "ok": "ok",
    "low_confidence": "low: use another source of scale",
    "no_scale": "no scale: no ruler found",
}


def print_warnings(warnings: Iterable[Notice], about: str = "") -> None:
    """Print the warnings of a record on stderr, one per line."""
    prefix = f"{about}: " if about else ""
    for notice in warnings:
        print(printable(f"warning[{notice.code}]: {prefix}{notice.message}"), file=sys.stderr)


@contextmanager
def resumable(journal: object, kept: str = "photographs") -> Iterator[None]:
    """Report after Ctrl-C that a journal, if there is one, keeps the results so far."""
    try:
        yield
    except KeyboardInterrupt:
        if journal is not None:
            print(
                f"interrupted: finished {kept} are kept; run the same command to resume",
                file=sys.stderr,
            )
        raise typer.Exit(INTERRUPTED) from None


def under_one_folder(names: Sequence[str]) -> tuple[str, list[str]]:
    """Split image names into their common folder and the names relative to it.

    Returns:
        The folder and the names; the folder is empty if the images share none.
    """
    try:
        folder = os.path.commonpath([PurePath(name).parent for name in names])
    except ValueError:  # some are absolute and some not
        folder = ""
    folder = "" if folder == "." else folder
    return folder, [os.path.relpath(name, folder) if folder else name for name in names]


def vehicles_text(record: GsdEstimate) -> str:
    """Count the vehicles of an estimate."""
    if record.n_vehicles is None:
        return "not searched"
    by_hand = by_hand_text(record)
    return (
        f"{record.n_vehicles} kept of {record.details.n_detections} "
        f"found{by_hand and f'; {by_hand}'}"
    )
