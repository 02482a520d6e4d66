"""Output of commands: results, errors, warnings and progress."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Annotated, Any, Protocol, TextIO, TypeAlias

import typer

from vehanchor.errors import OutOfMemoryError, VehAnchorError
from vehanchor.records.foreign_text import on_one_line
from vehanchor.records.text import by_hand_text, significant, with_interval

if TYPE_CHECKING:
    from rich.table import Table

    from vehanchor.records import GsdEstimate, Notice

BAD_INPUT, UNFORESEEN, INTERRUPTED = 2, 1, 130  # exit statuses
NOT_OK = 3  # with --strict: a result that is not usable
FAILED = 1  # a self-test, or every image of a batch
_LINE_EVERY_S = 10.0  # if stderr is not a terminal

Strict: TypeAlias = Annotated[
    bool,
    typer.Option("--strict", help=f"Exit with status {NOT_OK} if a result is not ok: low confidence or no scale."),
]


def exit_strictly(strict: bool, statuses: Iterable[str]) -> None:
    """Exit with ``NOT_OK`` if the caller chose ``--strict`` and a result is not usable."""
    if strict and any(status != "ok" for status in statuses):
        raise typer.Exit(NOT_OK)


def seldom(words: Callable[[int, int], str], stream: TextIO) -> Callable[[int, int], None]:
    """Report progress in one line every ten seconds, for logs."""
    last = time.monotonic()

    def tell(done: int, total: int) -> None:
        nonlocal last
        if time.monotonic() - last >= _LINE_EVERY_S:
            last = time.monotonic()
            print(words(done, total), file=stream, flush=True)

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
def tile_progress(
    n_images: int, *, lines_on_terminal: bool
) -> Iterator[Callable[[int, str], Callable[[int, int], None] | None]]:
    """Show a progress bar if stderr is a terminal; yield a function that makes the callback for an image's tiles."""
    if lines_on_terminal or not sys.stderr.isatty():
        yield lambda number, source: seldom(
            lambda done, total: f"{printable(source)}: {done} of {total} tiles (image {number + 1} of {n_images})",
            sys.stderr,
        )
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeRemainingColumn(),
    )
    # By default, rich redirects stdout to stderr.
    with Progress(*columns, console=Console(stderr=True), transient=True, redirect_stdout=False) as bar:
        task = bar.add_task("", total=None)

        def step(number: int, source: str) -> Callable[[int, int], None]:
            count = f"{number + 1}/{n_images} " if n_images > 1 else ""
            bar.reset(task, total=None, description=escape(printable(count + Path(source).name)))
            return lambda done, total: bar.update(task, completed=done, total=total)

        yield step


def failure(source: str, error: VehAnchorError) -> dict[str, Any]:
    """Make the JSON object of a failed image."""
    return {"source": source, "error": {"code": error.code, "message": str(error)}}


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


TEXT: dict[str, Any] = {"overflow": "fold"}
NUMBER: dict[str, Any] = {"justify": "right", "no_wrap": True}
WORD: dict[str, Any] = {"no_wrap": True}


def columns_table(columns: Mapping[str, dict[str, Any]], rows: Iterable[Sequence[str]], title: str = "") -> Table:
    """Make a table with headings; each column is a ``TEXT``, ``NUMBER`` or ``WORD``."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    shown = Text(printable(title)) if title else None
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title=shown, title_justify="left", title_style="bold")
    for heading, kind in columns.items():
        table.add_column(heading, **kind)
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    return table


def span_text(low: float | None, high: float | None, digits: int = 3) -> str:
    """Format an interval in a cell of a table."""
    return "-" if low is None or high is None else f"{significant(low, digits)} to {significant(high, digits)}"


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


class Warned(Protocol):
    """Record with warnings."""

    @property
    def warnings(self) -> Sequence[Notice]:
        """Further facts, each with a stable code."""
        ...


def print_warnings(record: Warned, about: str) -> None:
    """Print the warnings of a record on stderr, one per line."""
    prefix = f"{about}: " if about else ""
    for notice in record.warnings:
        print(printable(f"warning[{notice.code}]: {prefix}{notice.message}"), file=sys.stderr)


@contextmanager
def resumable(journal: Path | None) -> Iterator[None]:
    """Report after Ctrl-C that a journal keeps the results so far."""
    try:
        yield
    except KeyboardInterrupt:
        if journal is not None:
            print("interrupted: finished photographs are kept; run the same command to resume", file=sys.stderr)
        raise typer.Exit(INTERRUPTED) from None


@contextmanager
def image_progress(work: Callable[[int, int], str] | None = None) -> Iterator[Callable[[int, int], None]]:
    """Report finished images on stderr: a bar on a terminal, a line now and then in a log.

    Args:
        work: names the present work by the numbers of finished and of all images; None for no name.
    """
    name = work or (lambda _done, _total: "")
    if not sys.stderr.isatty():
        yield seldom(lambda done, total: f"{name(done, total)} {done} of {total} images".lstrip(), sys.stderr)
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    named = (TextColumn("{task.description}"),) if work else ()
    columns = (*named, MofNCompleteColumn(), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True, redirect_stdout=False) as bar:
        task = bar.add_task("", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total, description=name(done, total))


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
