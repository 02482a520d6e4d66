"""Options for images of known scale: ``--dota``, ``--table``, ``--geotiff`` and related ones."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from vehanchor.cli.scale_option import KnownLengthsFile
from vehanchor.cli.terminal import printable, work_progress

if TYPE_CHECKING:
    from collections.abc import Iterable

    from vehanchor.cli.cli_options import ParsedOptions
    from vehanchor.detection.detector import Detector
    from vehanchor.engine import Engine
    from vehanchor.options import ScaleOptions
    from vehanchor.rulers.known_length_table import KnownLengthTable
    from vehanchor_evaluation.known_scale import FileIssue, KnownScaleSet
    from vehanchor_evaluation.search import SearchedImage

# Issues of one reason that are printed; a count stands for the others.
_MAX_SHOWN_ISSUES = 10

WorkersOption = Annotated[
    int | None,
    typer.Option(
        metavar="N", min=1, help="Images searched in parallel. Default: one per core, at most 4."
    ),
]


class FilesCommand(TyperCommand):
    """Command whose ``--geotiff`` accepts several files, as a shell wildcard expands to."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the option's name before each file that follows it, as Typer needs."""
        expanded: list[str] = []
        is_geotiff = False
        for arg in args:
            if arg == "--geotiff":
                is_geotiff = True
            elif arg.startswith("-"):
                is_geotiff = False
                expanded.append(arg)
            elif is_geotiff:
                expanded += ["--geotiff", arg]
            else:
                expanded.append(arg)
        return super().parse_args(ctx, expanded)


@dataclass(frozen=True, kw_only=True)
class KnownScaleRequest:
    """Options for images of known scale and their search, one per field."""

    dota: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="A split of DOTA: images/ and labelTxt*/ with 'gsd:' lines.",
            show_default=False,
        ),
    ] = None
    table: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="CSV with the columns file,gsd_m_per_px and optionally set and split; files "
            "relative to it.",
            show_default=False,
        ),
    ] = None
    geotiff: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILES", help="Georeferenced images, or folders of them."),
    ] = None
    labels: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Folder of DOTA labels. Default: the latest labelTxt*/ with oriented boxes.",
        ),
    ] = None
    label_classes: Annotated[
        list[str] | None,
        typer.Option(
            "--label-class", metavar="NAME", help="Label class of vehicles. Default: small-vehicle."
        ),
    ] = None
    set_name: Annotated[
        str | None, typer.Option("--set", metavar="NAME", help="Only this set of the table.")
    ] = None
    split: Annotated[
        str | None, typer.Option(metavar="NAME", help="Only this split of the table, e.g. val.")
    ] = None
    limit: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Only the first N images.")
    ] = None
    known_lengths: KnownLengthsFile = None
    workers: WorkersOption = None
    cache: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="File of stored detections, to resume a run or share its search."
        ),
    ] = None

    def survey(self) -> KnownScaleSet:
        """Find the images; if there are none, print the issues to stderr.

        Raises:
            InvalidParameterError: there is not exactly one source, or it has no image of known
                scale.
        """
        from vehanchor.errors import InvalidParameterError
        from vehanchor_evaluation.survey import survey_known_scale

        data = survey_known_scale(
            dota=self.dota,
            table=self.table,
            geotiff=self.geotiff or (),
            labels=self.labels,
            set_name=self.set_name,
            split=self.split,
            limit=self.limit,
        )
        if not data.images:
            print_issues(data.issues)
            raise InvalidParameterError(f"no image of known scale in {data.source!r}")
        return data

    def lines(self, images: Iterable[Path]) -> KnownLengthTable:
        """Read the lines of known length of these images.

        Raises:
            KnownLengthError: the table cannot be read, or has none of these images.
        """
        from vehanchor.rulers.known_length_table import lines_in

        return lines_in(self.known_lengths, images)

    def search(
        self,
        data: KnownScaleSet,
        detector: Detector,
        options: ScaleOptions,
        *,
        cache: Path | None,
    ) -> dict[Path, SearchedImage | FileIssue]:
        """Search the images that the cache lacks, with a progress bar."""
        from vehanchor_evaluation.search import search_known_scale

        n_done = 0
        with work_progress("images") as show_progress:

            def count_progress(done: int, total: int) -> None:
                nonlocal n_done
                n_done = done
                show_progress(done, total)

            try:
                return search_known_scale(
                    data,
                    detector,
                    options,
                    cache=cache,
                    workers=self.workers,
                    progress=count_progress,
                )
            except KeyboardInterrupt:
                if cache is not None:
                    message = f"stopped after {n_done} of {len(data.images)} images"
                    print(f"{message}; the same command resumes", file=sys.stderr)
                raise


def open_shared(
    parsed: ParsedOptions,
    workers: int | None,
    segmenter: tuple[str | Path, str | Path] | None = None,
) -> Engine:
    """Open the engine of the options for parallel images, which share the cores."""
    from vehanchor_evaluation.search import default_workers

    engine = parsed.engine(segmenter=segmenter)
    n_workers = workers or default_workers()
    cores_per_worker = max(1, (os.cpu_count() or 1) // n_workers)
    threads = engine.runtime.threads or cores_per_worker
    return engine.replace(runtime=replace(engine.runtime, threads=threads))


def print_issues(issues: Iterable[FileIssue]) -> None:
    """Print the first few issues of each reason to stderr."""
    by_reason: dict[str, list[FileIssue]] = {}
    for issue in issues:
        by_reason.setdefault(issue.reason, []).append(issue)
    for reason, alike in sorted(by_reason.items()):
        for issue in alike[:_MAX_SHOWN_ISSUES]:
            message = issue.message
            if str(issue.file) not in message:
                message = f"{issue.file}: {message}"
            print(printable(f"warning[{reason}]: {message}"), file=sys.stderr)
        n_more = len(alike) - _MAX_SHOWN_ISSUES
        if n_more > 0:
            print(f"warning[{reason}]: and {n_more} more files", file=sys.stderr)
