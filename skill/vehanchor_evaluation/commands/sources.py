"""How commands are given images of known scale: ``--dota``, ``--table``, ``--geotiff`` and their like."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from vehanchor.cli.options import (
    open_detector,
)
from vehanchor.cli.terminal import printable, tile_progress
from vehanchor.errors import InvalidParameterError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from vehanchor.detection.detector import Detector
    from vehanchor.estimate import ScaleOptions
    from vehanchor_evaluation.known_scale import FileIssue, KnownScaleSet
    from vehanchor_evaluation.search import SearchedImage

__all__ = [
    "CacheOption",
    "DotaOption",
    "FilesCommand",
    "GeotiffOption",
    "LabelClassOption",
    "LabelsOption",
    "LimitOption",
    "SetOption",
    "SplitOption",
    "TableOption",
    "WorkersOption",
    "search",
    "survey",
    "tell_issues",
]

_MAX_WORKERS = 4  # by default: each holds an image in memory
_SHOWN_ISSUES = 10

DotaOption = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="A split of DOTA: images/ and labelTxt*/ with 'gsd:' lines.", show_default=False),
]
TableOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="CSV with the columns file,gsd_m_per_px, files relative to it; set and split where there are any.",
        show_default=False,
    ),
]
GeotiffOption = Annotated[
    list[Path] | None,
    typer.Option(metavar="FILES", help="Georeferenced images, or folders of them: the file tells the scale."),
]
LabelsOption = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="Folder of DOTA's labels. Default: the latest labelTxt*/ of oriented boxes."),
]
LabelClassOption = Annotated[
    list[str] | None,
    typer.Option("--label-class", metavar="NAME", help="Labelled class that counts. Default: small-vehicle."),
]
SetOption = Annotated[str | None, typer.Option("--set", metavar="NAME", help="Only this set of the table.")]
SplitOption = Annotated[str | None, typer.Option(metavar="NAME", help="Only this split of the table, as in 'val'.")]
LimitOption = Annotated[int | None, typer.Option(metavar="N", min=1, help="Only the first N images.")]
WorkersOption = Annotated[
    int | None,
    typer.Option(metavar="N", min=1, help="Images searched at the same time. Default: one per core, at most 4."),
]
CacheOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE", help="Where detections are kept, so that a run can go on and tables can share a search."
    ),
]


class FilesCommand(TyperCommand):
    """A command whose ``--geotiff`` takes files as a shell's wildcard gives them: Typer wants the name before each."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Put the option's name before each file that follows it."""
        spread: list[str] = []
        files = False
        for arg in args:
            if arg.startswith("-"):
                files = arg == "--geotiff"
                if not files:
                    spread.append(arg)
            else:
                spread += ["--geotiff", arg] if files else [arg]
        return super().parse_args(ctx, spread)


def survey(
    dota: Path | None,
    table: Path | None,
    geotiff: Sequence[Path] | None,
    *,
    labels: Path | None = None,
    set_name: str | None = None,
    split: str | None = None,
    limit: int | None = None,
) -> KnownScaleSet:
    """The images that the options name.

    Raises:
        InvalidParameterError: not exactly one source, or one that holds no image of known scale.
    """
    from vehanchor_evaluation.dota import survey_dota
    from vehanchor_evaluation.geotiff import survey_geotiffs
    from vehanchor_evaluation.table import survey_table

    if sum(source is not None for source in (dota, table, geotiff or None)) != 1:
        raise InvalidParameterError("name the images by one of --dota DIR, --table FILE and --geotiff FILES")
    if dota is not None:
        data = survey_dota(dota, labels)
    elif table is not None:
        data = survey_table(table)
    else:
        data = survey_geotiffs(geotiff or [])
    chosen = data.chosen(set_name=set_name, split=split, limit=limit)
    if data.images and not chosen.images:
        sets = ", ".join(sorted({f"{image.set or '-'} ({image.split or '-'})" for image in data.images}))
        raise InvalidParameterError(f"no image of set {set_name!r} and split {split!r}; there are {sets}")
    if not chosen.images:
        tell_issues(data.issues)
        raise InvalidParameterError(f"no image of known scale in {data.source!r}")
    return chosen


def tell_issues(issues: Iterable[FileIssue]) -> None:
    """What was wrong with which file, to stderr, the first few of each reason."""
    by_reason: dict[str, list[FileIssue]] = {}
    for issue in issues:
        by_reason.setdefault(issue.reason, []).append(issue)
    for reason, some in sorted(by_reason.items()):
        for issue in some[:_SHOWN_ISSUES]:
            about = "" if str(issue.file) in issue.message else f"{issue.file}: "
            print(printable(f"warning[{reason}]: {about}{issue.message}"), file=sys.stderr)
        if len(some) > _SHOWN_ISSUES:
            print(f"warning[{reason}]: and {len(some) - _SHOWN_ISSUES} more files", file=sys.stderr)


def search(
    data: KnownScaleSet,
    model: str | None,
    classes: Sequence[str] | None,
    options: Sequence[ScaleOptions],
    *,
    workers: int | None,
    cache: Path | None,
) -> tuple[Detector, dict[Path, SearchedImage | FileIssue]]:
    """Run the detector over the images, under a progress bar; what the cache knows is not searched again.

    Args:
        data: the images.
        model: file or name of the detector.
        classes: of the model, that count as vehicles.
        options: all that will be used on what is found, checked against the model before the work.
        workers: images at the same time; None for a good number.
        cache: file of what was found so far, and will be.

    Returns:
        The detector, and what was found in each file or why it could not be searched.
    """
    from vehanchor.estimate import ScaleOptions
    from vehanchor.estimate import open_detector as check_options
    from vehanchor_evaluation.known_scale import DATASET_LIMITS
    from vehanchor_evaluation.search import DetectionLog, search_images, search_settings

    n_workers = workers or min(_MAX_WORKERS, os.cpu_count() or 1)
    detector = open_detector(model, classes, threads=max(1, (os.cpu_count() or 1) // n_workers))
    for choice in {id(choice): choice for choice in options}.values():
        check_options(detector, choice)
    search_options = ScaleOptions(min_score=options[0].min_score, limits=DATASET_LIMITS)
    log = DetectionLog(cache, search_settings(detector, search_options, classes))
    files = [image.path for image in data.images]
    with tile_progress(1, lines_on_terminal=False) as step:
        progress = step(0, f"{len(files)} images")
        try:
            found = dict(search_images(files, detector, search_options, log=log, workers=n_workers, progress=progress))
        except KeyboardInterrupt:
            if cache is not None:
                n_done = sum(log.get(file) is not None for file in files)
                print(f"stopped after {n_done} of {len(files)} images; the same command goes on there", file=sys.stderr)
            raise
    return detector, found
