"""``vehanchor evaluate area``, for the command line to mount."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vehanchor.cli.options import DetectorOption
from vehanchor.cli.terminal import tile_progress, told_errors
from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.commands.sources import WorkersOption, search, tell_issues

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.estimate import ScaleOptions
    from vehanchor_evaluation.area import AreaTrial
    from vehanchor_evaluation.rs_gsd import BenchmarkEntry, Recipe

__all__ = ["area"]

_MAX_WORKERS = 4  # by default: each holds an image in memory
_DATA, _CHOICE, _MODELS = "Data: iSAID with DOTA, or masks, or a benchmark built before", "Choice of entries", "Models"


def area(
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Where results go; a run that was interrupted goes on there.")
    ],
    isaid: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR", help="iSAID: its instance pictures, or COCO files; repeatable.", rich_help_panel=_DATA
        ),
    ] = None,
    dota: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="DIR",
            help="DOTA's split of the same images, with images/ and labelTxt*/; one for each --isaid.",
            rich_help_panel=_DATA,
        ),
    ] = None,
    segments: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="A folder with index.csv and numbered 16-bit masks.", rich_help_panel=_DATA),
    ] = None,
    split: Annotated[
        str | None, typer.Option(metavar="NAME", help="Take this split of the index only.", rich_help_panel=_DATA)
    ] = None,
    benchmark: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="A benchmark that an earlier run has built.", rich_help_panel=_DATA),
    ] = None,
    entries: Annotated[
        int, typer.Option(min=0, metavar="N", help="Entries; 0 takes every object.", rich_help_panel=_CHOICE)
    ] = 100,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Of the choice.", rich_help_panel=_CHOICE)] = 0,
    category: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME",
            help="Category to choose from; repeatable. Default: the 8 of the benchmark for iSAID, else all.",
            rich_help_panel=_CHOICE,
        ),
    ] = None,
    min_side: Annotated[
        int, typer.Option(min=2, metavar="PX", help="Shortest side of an object's box.", rich_help_panel=_CHOICE)
    ] = 15,
    build_only: Annotated[
        bool, typer.Option("--build-only", help="Build the benchmark and measure nothing.", rich_help_panel=_CHOICE)
    ] = False,
    limit: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Measure the first entries only; categories take turns.")
    ] = None,
    workers: WorkersOption = None,
    detector: DetectorOption = None,
    segmenter: Annotated[
        tuple[str, str] | None,
        typer.Option(
            metavar="ENCODER DECODER",
            help="ONNX files of a promptable segmenter. Default: the bundled.",
            rich_help_panel=_MODELS,
        ),
    ] = None,
    reference_length: Annotated[
        float | None,
        typer.Option(metavar="M", help="Modal vehicle length, metres. Default: the model's.", rich_help_panel=_MODELS),
    ] = None,
    region: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Take the model's length of a region: europe, ...", rich_help_panel=_MODELS),
    ] = None,
) -> None:
    """Error of measured areas: the paper's Table II, its two sources told apart, on objects with true masks.

    Writes area.csv (each entry), area.json and area.md (the table), area_left_out.csv, and the benchmark itself, which
    'evaluate vlm' asks language models about.
    """
    with told_errors():
        from vehanchor_evaluation.rs_gsd import CATEGORIES, Recipe

        given = [value for value in (isaid, segments, benchmark) if value]
        if len(given) != 1 or len(isaid or ()) != len(dota or ()):
            raise InvalidParameterError(
                "name the data one way: --isaid DIR with --dota DIR, or --segments DIR, or --benchmark DIR"
            )
        recipe = Recipe(
            isaid=tuple(str(path.resolve()) for path in isaid or ()),
            dota=tuple(str(path.resolve()) for path in dota or ()),
            segments=None if segments is None else str(segments.resolve()),
            split=split,
            entries=entries or None,
            seed=seed,
            categories=tuple(category) if category else CATEGORIES if isaid else None,
            min_side_px=min_side,
        )
        n_workers = workers or min(_MAX_WORKERS, os.cpu_count() or 1)
        folder = benchmark or _built(recipe, out / "benchmark", n_workers)
        if build_only:
            _print_benchmark(folder)
            return
        from vehanchor.estimate import ScaleOptions

        options = ScaleOptions(reference_length_m=reference_length, region=region)
        _measure(folder, out, options, detector, segmenter, limit, n_workers)


# --- The benchmark ---------------------------------------------------------------------------------------------------


def _built(recipe: Recipe, folder: Path, workers: int) -> Path:
    """The benchmark's folder; what its data lack is told, and kept beside it."""
    from vehanchor_evaluation.report import write_issues
    from vehanchor_evaluation.rs_gsd import open_benchmark

    with tile_progress(1, lines_on_terminal=False) as step:
        issues = open_benchmark(recipe, folder, workers=workers, progress=step(0, "reading masks"))
    if issues:
        tell_issues(issues)
        write_issues(folder / "left_out.csv", issues)
    return folder


def _print_benchmark(folder: Path) -> None:
    from collections import Counter

    from vehanchor_evaluation.rs_gsd import load_benchmark

    built = load_benchmark(folder)[0]
    counts = Counter(entry.category for entry in built.entries)
    images = len({entry.image for entry in built.entries})
    print(f"{folder}: {len(built.entries)} entries in {images} images")
    for category, available in built.available.items():
        print(f"  {category}: {counts[category]} of {available}")


# --- The run ---------------------------------------------------------------------------------------------------------


def _measure(
    folder: Path,
    out: Path,
    options: ScaleOptions,
    detector: str | None,
    segmenter: tuple[str, str] | None,
    limit: int | None,
    workers: int,
) -> None:
    from vehanchor.models.zoo import resolve_segmenter
    from vehanchor.segmentation.segmenter import load_segmenter
    from vehanchor_evaluation.area import MaskLog, area_trials, segment_entries, summarise_area
    from vehanchor_evaluation.area_report import area_markdown, area_report, write_area_report
    from vehanchor_evaluation.known_scale import FileIssue, KnownScaleImage, KnownScaleSet
    from vehanchor_evaluation.rs_gsd import load_benchmark

    built, benchmark_sha = load_benchmark(folder)
    entries = built.entries[:limit]
    segmenting = load_segmenter(*resolve_segmenter(segmenter), threads=max(1, (os.cpu_count() or 1) // workers))
    masks = MaskLog(out / "masks.jsonl", f"{benchmark_sha}/{segmenting.card.sha256}")
    with tile_progress(1, lines_on_terminal=False) as step:
        issues = segment_entries(
            built, folder, entries, segmenting, masks, workers=workers, progress=step(0, f"{len(entries)} objects")
        )
    images = {entry.image: KnownScaleImage(Path(entry.image), entry.gsd_m_per_px) for entry in entries}
    detecting, searched = search(
        KnownScaleSet(str(folder), tuple(images.values())),
        detector,
        None,
        [options],
        workers=workers,
        cache=out / "detections.jsonl",
    )
    scales = {}
    for image, found in searched.items():
        if isinstance(found, FileIssue):
            issues.append(found)
        else:
            scales[str(image)] = found.analysis(detecting.card, options).estimate
    trials = area_trials(entries, masks.trials, scales)
    rows = summarise_area(trials)
    facts = _facts(trials, entries, detecting.card.name, segmenting.card.name)
    run: dict[str, Any] = {
        "detector": {"name": detecting.card.name, "sha256": detecting.card.sha256},
        "segmenter": {"name": segmenting.card.name, "sha256": segmenting.card.sha256},
        "reference_length_m": options.reference_length_m,
        "region": options.region,
        "limit": limit,
    }
    tell_issues(issues)
    report = area_report(built, benchmark_sha, run, rows, facts, issues)
    write_area_report(out, "area", report, trials, issues)
    print(area_markdown(report), end="")


def _facts(trials: Sequence[AreaTrial], entries: Sequence[BenchmarkEntry], detector: str, segmenter: str) -> list[str]:
    """What the table rests on."""
    import numpy as np

    facts = [
        f"{len(trials)} of {len(entries)} entries measured, in {len({trial.image for trial in trials})} images",
        f"detector {detector}, segmenter {segmenter}; no scale, or no mask, counts as an error of 100 %",
    ]
    if trials:
        iou = np.array([trial.mask_iou for trial in trials])
        n_without = sum(trial.gsd_m_per_px is None for trial in trials)
        facts.append(f"masks: IoU median {np.median(iou):.3f}, mean {iou.mean():.3f}")
        facts.append(f"scale: none for {n_without} entries ({n_without / len(trials):.0%})")
    return facts
