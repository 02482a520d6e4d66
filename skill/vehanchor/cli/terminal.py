"""Output of commands: results, errors, warnings and progress."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from vehanchor.errors import OutOfMemoryError, VehAnchorError
from vehanchor.records.foreign_text import on_one_line
from vehanchor.records.text import by_hand_text, with_interval

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID
    from rich.table import Table

    from vehanchor.records import GsdEstimate, Notice

BAD_INPUT, UNFORESEEN, INTERRUPTED = 2, 1, 130  # exit statuses
NOT_OK = 3  # with --strict: a result that is not usable
FAILED = 1  # a self-test, or every image of a batch
_LINE_EVERY_S = 10.0  # if stderr is not a terminal
_NAME = "{task.description}"

Strict: TypeAlias = Annotated[
    bool,
    typer.Option("--strict", help=f"Exit with status {NOT_OK} if a result is not ok: low confidence or no scale."),
]


def exit_strictly(strict: bool, statuses: Iterable[str]) -> None:
    """Exit with ``NOT_OK`` if the caller chose ``--strict`` and a result is not usable."""
    if strict and any(status != "ok" for status in statuses):
        raise typer.Exit(NOT_OK)


def _seldom(words: Callable[[int, int], str]) -> Callable[[int, int], None]:
    """Report progress in one line on stderr every ten seconds, for logs."""
    last = time.monotonic()

    def tell(done: int, total: int) -> None:
        nonlocal last
        if time.monotonic() - last >= _LINE_EVERY_S:
            last = time.monotonic()
            print(words(done, total), file=sys.stderr, flush=True)

    return tell


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
            f"error[internal_error]: {reason}. This is a defect of vehanchor; for details, set VEHANCHOR_TRACEBACK=1",
            file=sys.stderr,
        )
        raise typer.Exit(UNFORESEEN) from None


@contextmanager
def _bar(*columns: str) -> Iterator[tuple[Progress, TaskID]]:
    """Show a progress bar on stderr, with further columns of ``rich.progress`` by name or format."""
    from rich import progress
    from rich.console import Console

    made = [getattr(progress, each)() if each.isidentifier() else progress.TextColumn(each) for each in columns]
    # By default, rich redirects stdout to stderr.
    with progress.Progress(*made, console=Console(stderr=True), transient=True, redirect_stdout=False) as bar:
        yield bar, bar.add_task("", total=None)


@contextmanager
def tile_progress(
    n_images: int, *, lines_on_terminal: bool
) -> Iterator[Callable[[int, str], Callable[[int, int], None]]]:
    """Show a progress bar if stderr is a terminal; yield a function that makes the callback for an image's tiles."""
    if lines_on_terminal or not sys.stderr.isatty():
        yield lambda number, source: _seldom(
            lambda done, total: f"{printable(source)}: {done} of {total} tiles (image {number + 1} of {n_images})"
        )
        return
    from rich.markup import escape

    with _bar(_NAME, "BarColumn", "{task.percentage:>3.0f} %", "TimeRemainingColumn") as (bar, task):

        def step(number: int, source: str) -> Callable[[int, int], None]:
            count = f"{number + 1}/{n_images} " if n_images > 1 else ""
            bar.reset(task, total=None, description=escape(printable(count + Path(source).name)))
            return lambda done, total: bar.update(task, completed=done, total=total)

        yield step


@contextmanager
def image_progress(work: Callable[[int, int], str] | None = None) -> Iterator[Callable[[int, int], None]]:
    """Report finished images on stderr: a bar on a terminal, a line now and then in a log.

    Args:
        work: names the present work by the numbers of finished and of all images; None for no name.
    """
    name = work or (lambda _done, _total: "")
    if not sys.stderr.isatty():
        yield _seldom(lambda done, total: f"{name(done, total)} {done} of {total} images".lstrip())
        return
    named = (_NAME,) if work else ()
    with _bar(*named, "MofNCompleteColumn", "BarColumn", "TimeElapsedColumn", "TimeRemainingColumn") as (bar, task):
        yield lambda done, total: bar.update(task, completed=done, total=total, description=name(done, total))


def print_failure(source: str, error: VehAnchorError) -> None:
    """Print the JSON object of a failed image."""
    print_json({"source": source, "error": {"code": error.code, "message": str(error)}})


@contextmanager
def failures_as_json(sources: Iterable[str], wanted: bool) -> Iterator[None]:
    """Print, if it is wanted, one JSON object for each image that an error prevents; the error goes on."""
    try:
        yield
    except VehAnchorError as error:
        for source in sources if wanted else ():
            print_failure(source, error)
        raise


def print_json(record: Mapping[str, Any]) -> None:
    """Print one JSON object in one line on stdout."""
    print(json.dumps(record, allow_nan=False), flush=True)  # ASCII: the same bytes in every locale


def printable(text: str, *, lines: bool = False) -> str:
    """Escape what a terminal would obey; ``lines`` keeps line ends, in texts of ours."""
    return "\n".join(map(on_one_line, text.split("\n"))) if lines else on_one_line(text)


def print_table(table: Table) -> None:
    """Print a table on stdout, as wide as the terminal."""
    from rich.console import Console

    Console(soft_wrap=False, highlight=False).print(table)


def facts_table(title: str, facts: Sequence[tuple[str, str]]) -> Table:
    """Make a table of names and values in two columns."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(
        box=box.SIMPLE_HEAD, show_header=False, title=Text(printable(title)), title_justify="left", title_style="bold"
    )
    table.add_column(style="cyan", no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in facts:
        table.add_row(name, Text(printable(value)))
    return table


def rows_table(columns: Mapping[str, str], rows: Iterable[Sequence[str]], title: str = "") -> Table:
    """Make a table with a heading for each column.

    Args:
        columns: their kinds by heading: ``text`` is folded, ``number`` is on the right, ``word`` on the left.
        rows: the cells of each row.
        title: heading of the table; empty for none.
    """
    from rich import box
    from rich.table import Table
    from rich.text import Text

    heading = Text(printable(title)) if title else None
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title=heading, title_justify="left", title_style="bold")
    for name, kind in columns.items():
        if kind == "text":
            table.add_column(name, overflow="fold")
        else:
            table.add_column(name, justify="right" if kind == "number" else "left", no_wrap=True)
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    return table


def counts_text(counts: Mapping[str, int]) -> str:
    """List the numbers of results by status."""
    statuses = ("ok", "low_confidence", "no_scale", "error")
    return ", ".join(f"{counts[status]} {status}" for status in statuses if status in counts)


def scale_text(gsd: float | None, low: float | None, high: float | None) -> str:
    """Format a scale with its interval."""
    return quantity_text(gsd, low, high, "m/px") or "none: nothing of known size found"


def quantity_text(value: float | None, low: float | None, high: float | None, unit: str) -> str:
    """Format a quantity with its interval; empty without a value."""
    return "" if value is None else with_interval(value, low, high, unit)


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
            print(f"interrupted: finished {kept} are kept; run the same command to resume", file=sys.stderr)
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
    return f"{record.n_vehicles} kept of {record.details.n_detections} found{by_hand and f'; {by_hand}'}"
