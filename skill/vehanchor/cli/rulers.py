"""``vehanchor rulers``: rulers, and things of known size."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from vehanchor.cli.terminal import exit_on_error, facts_table, print_json, print_table

if TYPE_CHECKING:
    from vehanchor.rulers.standards import Standard


def rulers(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="Things of known size, as railway_gauge; default: all."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object per thing and line.")] = False,
) -> None:
    """List the rulers, and the things of known size for --known-length X1 Y1 X2 Y2 NAME."""
    from vehanchor.records.ruler_kinds import RULERS
    from vehanchor.rulers.registry import ruler_class
    from vehanchor.rulers.standards import check_name, standards

    with exit_on_error():
        for name in names or ():
            check_name(name)
        chosen = [standards()[name.partition("/")[0]] for name in names or standards()]
        if as_json:
            for each in chosen:
                print_json({**each._asdict(), "variants": [variant._asdict() for variant in each.variants]})
            return
        if names:
            for each in chosen:
                print_table(facts_table(each.name, _facts(each)))
            return
        print_table(facts_table("Rulers", [(kind, ruler_class(kind).help) for kind in RULERS]))
        title = "Things of known size, from where to where; with a country: NAME/DE"
        print_table(facts_table(title, [(each.name, f"{_lengths(each)}: {each.between}") for each in chosen]))


def _lengths(standard: Standard) -> str:
    return ", ".join(f"{each.metres:g}" for each in standard.variants) + " m"


def _facts(standard: Standard) -> list[tuple[str, str]]:
    lengths = [
        f"{each.metres:g} m +- {100 * each.log_sd:.2g} %{': ' + ', '.join(each.countries) if each.countries else ''}"
        for each in standard.variants
    ]
    return [
        ("between", standard.between),
        *(("length", length) for length in lengths),
        ("chance of another thing", f"{100 * standard.chance_wrong:.0f} %"),
        ("source", standard.source),
    ]
