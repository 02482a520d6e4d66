"""Catalogue of things of known size, ``standards.toml``: lengths by a rule or a custom, with spreads and sources."""

from __future__ import annotations

import tomllib
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, NamedTuple

from pydantic import TypeAdapter

from vehanchor.errors import KnownLengthError
from vehanchor.scale.countries import COUNTRY_REGIONS

if TYPE_CHECKING:
    from collections.abc import Mapping


class Variant(NamedTuple):
    """Length of a thing in some countries.

    Attributes:
        metres: mean length.
        log_sd: standard deviation of its log.
        weight: relative to the other variants.
        countries: ISO 3166-1 codes, and regions of ``vehanchor.scale.countries``; empty for all
            countries.
    """

    metres: float
    log_sd: float
    weight: float = 1.0
    countries: tuple[str, ...] = ()

    def is_of(self, place: str) -> bool:
        """Tell whether the length is that of a country or region, by name; a region has those of its countries."""
        code = place.upper()
        return (
            place in self.countries
            or code in self.countries
            or COUNTRY_REGIONS.get(code) in self.countries
            or any(COUNTRY_REGIONS.get(country) == place for country in self.countries)
        )


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

    def lengths_in(self, place: str | None) -> tuple[Variant, ...]:
        """Select the lengths of a country or region, with weights that add up to 1; all lengths if none is of it."""
        chosen = [each for each in self.variants if place and each.is_of(place)] or self.variants
        total = sum(each.weight for each in chosen)
        return tuple(each._replace(weight=each.weight / total) for each in chosen)


@cache
def standards() -> Mapping[str, Standard]:
    """Read the catalogue, by name."""
    table = tomllib.loads(
        files("vehanchor.rulers").joinpath("standards.toml").read_text(encoding="utf-8")
    )
    return TypeAdapter(dict[str, Standard]).validate_python(
        {name: {"name": name, **entry} for name, entry in table.items()}
    )


def lengths_of(what: str, region: str | None = None) -> tuple[Standard, tuple[Variant, ...]]:
    """Find a thing of known size and its lengths.

    Args:
        what: its name, as ``check_name`` allows it, with an optional country, as
            "railway_gauge/ES".
        region: country or region of the image; the country in the name is used instead if there is
            one.
    """
    name, _, country = what.partition("/")
    standard = standards()[name]
    return standard, standard.lengths_in(country or region)


def check_name(what: str | None) -> None:
    """Check the name of a thing of known size; None is valid.

    Raises:
        KnownLengthError: the thing is not in the catalogue, or the country is no two-letter code.
    """
    if what is None:
        return
    name, slash, country = what.partition("/")
    if name not in standards():
        known = "; ".join(f"{each.name}: {each.between}" for each in standards().values())
        raise KnownLengthError(f"there is no thing of known size {name!r}. Known are {known}")
    if slash and not (len(country) == 2 and country.isascii() and country.isupper()):
        raise KnownLengthError(
            f"the country in {what!r} is {country!r}: use two capital letters, as in {name}/DE"
        )
