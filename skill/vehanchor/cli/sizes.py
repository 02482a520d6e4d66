"""``vehanchor models --sizes``: things of known size."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.cli.terminal import facts_table, print_json, print_table

if TYPE_CHECKING:
    from vehanchor.rulers.standards import Standard, Variant


def print_sizes(*, as_json: bool) -> None:
    """Print the things of known size for --known-length X1 Y1 X2 Y2 NAME."""
    from vehanchor.rulers.standards import standards

    for each in standards().values():
        if as_json:
            print_json({**each._asdict(), "variants": [variant._asdict() for variant in each.variants]})
        else:
            print_table(facts_table(each.name, _facts(each)))


def _facts(standard: Standard) -> list[tuple[str, str]]:
    return [
        ("between", standard.between),
        *(("length", _length(each)) for each in standard.variants),
        ("chance of another thing", f"{100 * standard.chance_wrong:.0f} %"),
        ("source", standard.source),
    ]


def _length(variant: Variant) -> str:
    countries = f": {', '.join(variant.countries)}" if variant.countries else ""
    return f"{variant.metres:g} m +- {100 * variant.log_sd:.2g} %{countries}"
