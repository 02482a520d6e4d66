"""The course of ``vehanchor measure`` and ``vehanchor distance``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vehanchor.cli.outputs import check_outputs, write_outputs
from vehanchor.cli.terminal import (
    exit_on_error,
    exit_strictly,
    facts_table,
    failures_as_json,
    print_json,
    print_table,
    print_warnings,
    tile_progress,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path


def show_measured(
    image: str,
    measure: Callable[[Callable[[int, int], None]], Any],
    facts: Callable[[Any], Sequence[tuple[str, str]]],
    outputs: Mapping[str, Path],
    *,
    as_json: bool,
    strict: bool,
) -> None:
    """Measure, print the record, and write the files; an error ends the command.

    Args:
        image: the photograph.
        measure: makes the analysis; it gets the progress of the search.
        facts: lists the facts of a record for people.
        outputs: files by the names of their options.
        as_json: print one JSON object and nothing else.
        strict: exit with another status if the record is not ok.
    """
    with exit_on_error():
        with failures_as_json([image], as_json):
            check_outputs([image], outputs.items())
            with tile_progress(1, lines_on_terminal=as_json) as step:
                analysis = measure(step(0, image))
        record = analysis.measurement
        if as_json:
            print_json({"source": image, **record.model_dump(mode="json")})
        else:
            print_table(facts_table(image, facts(record)))
            print_warnings(record.warnings)
        write_outputs(analysis, outputs)
        exit_strictly(strict, [record.status])
