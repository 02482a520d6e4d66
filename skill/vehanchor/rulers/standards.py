"""Catalogue of things of known size, ``standards.toml``: lengths by a rule or a custom, with spreads and sources."""

from __future__ import annotations

import tomllib
from difflib import get_close_matches
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any, NamedTuple

from vehanchor.errors import KnownLengthError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

_NEAREST = 3
_CUTOFF = 0.4  # of likeness, so that nearly every wrong name has a nearest one


class Variant(NamedTuple):
    """Length of a thing in some countries.

    Attributes:
        metres: mean length.
        log_sd: standard deviation of its log.
        weight: relative to the other variants.
        countries: two-letter codes; empty for all countries.
    """

    metres: float
    log_sd: float
    weight: float = 1.0
    countries: tuple[str, ...] = ()


class Standard(NamedTuple):
    """Thing of known size.

    Attributes:
        name: in options and tables.
        between: ends of the line to draw.
        chance_wrong: 0..1, chance that the thing is another one.
        source: rule or survey behind the lengths.
        variants: lengths, with their countries.
    """

    name: str
    between: str
    chance_wrong: float
    source: str
    variants: tuple[Variant, ...]

    @property
    def label(self) -> str:
        """Name in messages."""
        return self.name.replace("_", " ")

    def of_places(self, countries: frozenset[str]) -> tuple[Variant, ...]:
        """Select the variants of some countries, with weights that add up to 1; all variants if none is theirs."""
        known = [each for each in self.variants if countries & set(each.countries)]
        chosen = known or self.variants
        total = sum(each.weight for each in chosen)
        return tuple(each._replace(weight=each.weight / total) for each in chosen)


@cache
def standards() -> Mapping[str, Standard]:
    """Read the catalogue, by name."""
    regions, table = _catalogue()
    found = {}
    for name, entry in table.items():
        variants = tuple(
            Variant(**{**each, "countries": _expanded(each.get("countries", ()), regions)})
            for each in entry["variants"]
        )
        found[name] = Standard(name, **{**entry, "variants": variants})
    return found


def lengths_of(what: str, region: str | None = None) -> tuple[Standard, tuple[Variant, ...]]:
    """Find a thing of known size and its lengths.

    Args:
        what: its name, with an optional country, as "railway_gauge/ES".
        region: region of the image; the country is used instead if it is named.

    Raises:
        KnownLengthError: the thing is not in the catalogue, or the country is no two-letter code.
    """
    check_name(what)
    name, _, country = what.partition("/")
    countries = frozenset((country,)) if country else frozenset(_catalogue()[0].get(region or "", ()))
    standard = standards()[name]
    return standard, standard.of_places(countries)


def check_name(what: str | None) -> None:
    """Check the name of a thing of known size; None is valid.

    Raises:
        KnownLengthError: the thing is not in the catalogue, or the country is no two-letter code.
    """
    if what is None:
        return
    name, slash, country = what.partition("/")
    if name not in standards():
        nearest = get_close_matches(name.lower(), standards(), _NEAREST, _CUTOFF) or list(standards())[:_NEAREST]
        raise KnownLengthError(
            f"there is no thing of known size {name!r}: the nearest are {', '.join(nearest)}; 'vehanchor rulers' lists "
            f"all {len(standards())}"
        )
    if slash and not (len(country) == 2 and country.isascii() and country.isupper()):
        raise KnownLengthError(f"the country in {what!r} is {country!r}: use two capital letters, as in {name}/DE")


@cache
def _catalogue() -> tuple[dict[str, tuple[str, ...]], dict[str, dict[str, Any]]]:
    text = files("vehanchor.rulers").joinpath("standards.toml").read_text(encoding="utf-8")
    table = tomllib.loads(text)
    return table.pop("regions"), table


def _expanded(countries: Iterable[str], regions: Mapping[str, Iterable[str]]) -> tuple[str, ...]:
    """Replace regions by their countries."""
    return tuple(code for each in countries for code in regions.get(each, (each,)))
