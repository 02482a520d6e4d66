"""Output of commands: results, errors, warnings and progress."""

from __future__ import annotations

import errno
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from vehanchor.errors import OutOfMemoryError, OutputError, VehAnchorError
from vehanchor.records.contradiction import contradiction_text
from vehanchor.records.escaping import as_json, on_one_line
from vehanchor.records.text import by_hand_text

if TYPE_CHECKING:
    from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate, Notice

    Facts: TypeAlias = list[tuple[str, str]]
    """Values of a record with their names, as text for people."""

# Exit statuses.
BAD_INPUT = 2
UNFORESEEN = 1
INTERRUPTED = 130
NOT_OK = 3  # with --strict: a result that is not usable
FAILED = 1  # a self-test, or every image of a batch
# Of tables, in characters: the space between columns, and the shortest name.
_GAP = 2
_LEAST_NAME = 8
_ELLIPSIS = "..."
_MAX_NAMES = 3  # listed in one sentence
# Time between lines of progress if stderr is not a terminal.
_LINE_EVERY_S = 10.0

AsJson: TypeAlias = Annotated[
    bool, typer.Option("--json", help="Print one JSON object and nothing else.")
]

Strict: TypeAlias = Annotated[
    bool,
    typer.Option(
        "--strict",
        help=f"Exit with status {NOT_OK} if a result is not ok: low confidence or no scale.",
    ),
]


class DefectError(VehAnchorError, code="internal_error"):
    """Unforeseen exception, reported as an error of the command line."""

    @classmethod
    def of(cls, error: Exception) -> DefectError:
        """Describe an unforeseen exception in one line."""
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        return cls(
            f"{reason}. This is a defect of vehanchor; for details, set VEHANCHOR_TRACEBACK=1"
        )


def exit_strictly(strict: bool, statuses: Iterable[str]) -> None:
    """Exit with ``NOT_OK`` if the caller chose ``--strict`` and a result is not usable."""
    if strict and any(status != "ok" for status in statuses):
        raise typer.Exit(NOT_OK)


def report(error: VehAnchorError, about: str = "") -> None:
    """Print an error in one line on stderr, with its subject if the message does not name it."""
    message = str(error)
    if about and about not in message:
        message = f"{about}: {message}"
    print(printable(f"error[{error.code}]: {message}"), file=sys.stderr, flush=True)


@contextmanager
def exit_on_error() -> Iterator[None]:
    """Convert an exception of a command to one line on stderr and an exit status.

    With the environment variable ``VEHANCHOR_TRACEBACK``, an unforeseen exception goes on.
    """
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
        if os.environ.get("VEHANCHOR_TRACEBACK") or is_full(error):
            raise
        if isinstance(error, ImportError):
            _exit_on_unmet_requirement(error)
        report(DefectError.of(error))
        raise typer.Exit(UNFORESEEN) from None


def is_full(error: Exception) -> bool:
    """Test whether a standard stream cannot be written, because its disk is full.

    Errors of files have their names.
    """
    if not isinstance(error, OSError) or error.filename is not None:
        return False
    return error.errno in (errno.ENOSPC, errno.EDQUOT)


def report_full(error: OSError) -> None:
    """Report that the standard output cannot be written."""
    report(OutputError(f"cannot write to the standard output: {error.strerror}"))


def _exit_on_unmet_requirement(error: ImportError) -> None:
    """Exit with the package that a failed import lacks; return if the error is our own.

    Another project's requirements in the same environment can replace a package by an older one.
    """
    from vehanchor.cli.requirements import unmet_requirement

    unmet = unmet_requirement(error)
    if unmet is None:
        return
    print(
        f"error[installation_incomplete]: {printable(str(error))}: {unmet}. Install it again in an "
        "environment of its own: pip install vehanchor",
        file=sys.stderr,
    )
    raise typer.Exit(BAD_INPUT)


@contextmanager
def work_progress(unit: str, *, lines: bool = False) -> Iterator[Callable[..., None]]:
    """Report progress on stderr: by a bar on a terminal, else by a line every ten seconds.

    Args:
        unit: what is counted, in the plural.
        lines: write lines on a terminal, too.

    Yields:
        The callback, for the numbers of finished and of all units and, optionally, the name of the
        work.
    """
    if lines or not sys.stderr.isatty():
        yield _progress_lines(unit)
    else:
        with _progress_bar() as update:
            yield update


def _progress_lines(unit: str) -> Callable[..., None]:
    """Make a callback that prints a line if the last one is old enough."""
    last_s = time.monotonic()

    def print_line(done: int, total: int, name: str = "") -> None:
        nonlocal last_s
        if time.monotonic() - last_s < _LINE_EVERY_S:
            return
        last_s = time.monotonic()
        line = f"{name} {done} of {total} {unit}".lstrip()
        print(printable(line), file=sys.stderr, flush=True)

    return print_line


@contextmanager
def _progress_bar() -> Iterator[Callable[..., None]]:
    """Show a progress bar while the block runs; yield the callback that updates it."""
    from rich import progress
    from rich.console import Console
    from rich.markup import escape

    columns = (
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        progress.MofNCompleteColumn(),
        progress.TimeRemainingColumn(),
    )
    # By default, rich redirects stdout to stderr.
    with progress.Progress(
        *columns, console=Console(stderr=True), transient=True, redirect_stdout=False
    ) as bar:
        task = bar.add_task("", total=None)

        def update(done: int, total: int, name: str = "") -> None:
            description = escape(printable(name))
            bar.update(task, completed=done, total=total, description=description)

        yield update


@contextmanager
def failures_as_json(sources: Iterable[str], as_json: bool) -> Iterator[None]:
    """Print a JSON object for each image of a block that an error ends; the error goes on.

    Args:
        sources: images of the block.
        as_json: whether the command prints JSON; otherwise, nothing is printed here.
    """
    try:
        yield
    except VehAnchorError as error:
        if as_json:
            for source in sources:
                print_error_as_json(source, error)
        raise


def print_error_as_json(source: str, error: VehAnchorError) -> None:
    """Print the error of an image as one JSON object in one line on stdout."""
    print_json({"photograph": source, "error": {"code": error.code, "message": str(error)}})


def print_json(record: Mapping[str, Any]) -> None:
    """Print one JSON object in one line on stdout."""
    # JSON is ASCII here, so that the bytes are the same in every locale.
    print(as_json(record), flush=True)


def printable(text: str, *, lines: bool = False) -> str:
    """Escape characters that a terminal would obey.

    Args:
        text: any text.
        lines: keep line ends, for texts of our own.
    """
    if lines:
        own_lines = text.split("\n")
        return "\n".join(on_one_line(line) for line in own_lines)
    return on_one_line(text)


def print_facts(title: str, facts: Iterable[tuple[str, str]]) -> None:
    """Print names and values in two columns under a title."""
    columns = {"name": "name", "value": "text"}
    print_rows(columns, facts, title, heading=False)


def print_rows(
    columns: Mapping[str, str],
    rows: Iterable[Sequence[str]],
    title: str = "",
    *,
    heading: bool = True,
) -> None:
    """Print a table on stdout, as wide as the terminal.

    Args:
        columns: kinds of the columns by heading: ``text`` is folded, ``number`` is on the right,
            ``word`` is on the left, ``name`` is coloured, ``file`` is shortened in the middle, so
            that a row takes one line.
        rows: the cells of each row.
        title: title of the table; empty for none.
        heading: print the headings of the columns.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(soft_wrap=False, highlight=False)
    printable_rows = [[printable(cell) for cell in row] for row in rows]
    if "file" in columns.values():
        printable_rows = _with_short_names(columns, printable_rows, console.width)
    table = Table(
        box=box.SIMPLE_HEAD,
        pad_edge=not heading,
        padding=(0, _GAP - 1, 0, 0) if heading else (0, 1),
        show_header=heading,
        show_edge=not heading,
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
    for row in printable_rows:
        cells = [Text(cell) for cell in row]
        table.add_row(*cells)
    console.print(table)


def _with_short_names(
    columns: Mapping[str, str], rows: Sequence[Sequence[str]], width: int
) -> list[list[str]]:
    """Shorten the cells of ``file`` columns, so that each row fits into one line.

    Args:
        columns: kinds of the columns by heading.
        rows: the cells of each row.
        width: of the terminal, columns.
    """
    headings = list(columns)
    kinds = list(columns.values())
    widths = [len(heading) for heading in headings]
    for row in rows:
        cell_widths = map(len, row)
        widths = list(map(max, widths, cell_widths))
    n_left = width - _GAP * (len(kinds) - 1)
    n_left -= sum(widest for widest, kind in zip(widths, kinds, strict=True) if kind != "file")
    # Names that need less than their share leave the rest to the wider ones.
    file_columns = [number for number, kind in enumerate(kinds) if kind == "file"]
    file_columns.sort(key=widths.__getitem__)
    for rank, number in enumerate(file_columns):
        share = n_left // (len(file_columns) - rank)
        least = max(_LEAST_NAME, len(headings[number]))
        widths[number] = max(least, min(widths[number], share))
        n_left -= widths[number]
    shortened = [list(row) for row in rows]
    for cells in shortened:
        for number in file_columns:
            cells[number] = shortened_name(cells[number], widths[number])
    return shortened


def shortened_name(name: str, width: int) -> str:
    """Shorten a name in the middle: photographs of a folder differ at the end."""
    if len(name) <= width:
        return name
    n_kept = width - len(_ELLIPSIS)
    n_first = n_kept // 4
    n_last = n_kept - n_first
    return f"{name[:n_first]}{_ELLIPSIS}{name[-n_last:]}"


def counts_text(counts: Mapping[str, int]) -> str:
    """List the numbers of results by status."""
    statuses = ("ok", "low_confidence", "no_scale", "error")
    return ", ".join(f"{counts[status]} {status}" for status in statuses if status in counts)


STATUS_TEXTS = {
    "ok": "ok",
    "low_confidence": "low_confidence: use another source of scale",
    "no_scale": "no_scale: no ruler found",
}
"""Texts of statuses beside a confidence."""


def first_names(names: Sequence[str]) -> str:
    """List the first names, and the number of the others."""
    text = ", ".join(names[:_MAX_NAMES])
    if len(names) > _MAX_NAMES:
        n_more = len(names) - _MAX_NAMES
        text += f" and {n_more} more"
    return text


def print_written(paths: Iterable[Path]) -> None:
    """Name the files that a command wrote, one per line on stderr."""
    for path in paths:
        print(printable(f"wrote {path}"), file=sys.stderr)


def print_warnings(warnings: Iterable[Notice], about: str = "") -> None:
    """Print the warnings of a record on stderr, one per line."""
    prefix = f"{about}: " if about else ""
    for notice in warnings:
        line = f"warning[{notice.code}]: {prefix}{notice.message}"
        print(printable(line), file=sys.stderr)


@contextmanager
def resumable(journal: object, kept: str = "photographs") -> Iterator[None]:
    """Report after Ctrl-C that the journal, if there is one, keeps the results so far.

    Args:
        journal: the journal or its path; None without one.
        kept: what the journal keeps, in the plural.
    """
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
    folders = [PurePath(name).parent for name in names]
    try:
        folder = os.path.commonpath(folders)
    except ValueError:  # Some names are absolute and others are not.
        folder = ""
    if folder in ("", "."):
        return "", list(names)
    return folder, [os.path.relpath(name, folder) for name in names]


def contradiction_fact(record: GsdEstimate | AreaMeasurement | DistanceMeasurement) -> Facts:
    """Begin the facts of a record with what contradicts the file's own scale; empty without."""
    text = contradiction_text(record)
    return [("check first", text)] if text else []


def vehicles_text(record: GsdEstimate) -> str:
    """Count the vehicles of an estimate."""
    if record.n_vehicles is None:
        return "not searched"
    text = f"{record.n_vehicles} kept of {record.details.n_detections} found"
    by_hand = by_hand_text(record)
    return f"{text}; {by_hand}" if by_hand else text
