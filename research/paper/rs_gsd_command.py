"""Command ``python -m research.paper rs-gsd``: a benchmark of areas from iSAID and DOTA."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from research.paper.rs_gsd import CATEGORIES, DEFAULT_ENTRIES, build_benchmark
from research.paper.service import plain_command
from vehanchor.cli.terminal import work_progress
from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.commands.sources import print_issues
from vehanchor_evaluation.report import write_issues


@dataclass(frozen=True, kw_only=True)
class RsGsdRequest:
    """Options of the command, one per field."""

    isaid: Annotated[
        list[Path], typer.Option(metavar="DIR", help="iSAID's instance images; repeatable.")
    ]
    dota: Annotated[
        list[Path],
        typer.Option(
            metavar="DIR", help="The same split of DOTA, images/ and labelTxt*/; one per --isaid."
        ),
    ]
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the benchmark.")]
    entries: Annotated[
        int, typer.Option(min=0, metavar="N", help="Entries; 0 for every object.")
    ] = DEFAULT_ENTRIES
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Seed of the choice.")] = 0
    category: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Category to choose from; repeatable. Default: eight."),
    ] = None


@plain_command(RsGsdRequest)
def rs_gsd(request: RsGsdRequest) -> None:
    """Choose a hundred objects of iSAID as the paper does.

    Measure them with 'vehanchor evaluate area --segments'.
    """
    if len(request.isaid) != len(request.dota):
        raise InvalidParameterError("give a --dota DIR for each --isaid DIR")
    with work_progress("files") as tell:
        built = build_benchmark(
            list(zip(request.isaid, request.dota, strict=True)),
            request.out,
            entries=request.entries or None,
            seed=request.seed,
            categories=tuple(request.category or CATEGORIES),
            progress=partial(tell, name="reading masks"),
        )
    if built.issues:
        print_issues(built.issues)
        write_issues(request.out / "left_out.csv", built.issues)
    print(f"{request.out}: {sum(built.entries.values())} entries")
    for category, available in built.available.items():
        print(f"  {category}: {built.entries.get(category, 0)} of {available}")
