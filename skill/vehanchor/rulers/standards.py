"""Catalogue of things of known size, ``standards.toml``: lengths, their spreads and sources."""

from __future__ import annotations

import tomllib
from difflib import get_close_matches
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, NamedTuple

from pydantic import TypeAdapter

from vehanchor.errors import KnownLengthError
from vehanchor.scale.countries import COUNTRY_REGIONS, country_code

if TYPE_CHECKING:
    from collections.abc import Mapping

# Names in the error about an unknown one.
_MAX_NEAREST = 5
_MAX_SHOWN_CHARS = 60


# Largest spread of a length that a rule fixes.
_EXACT_LOG_SD = 0.01


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
        """Test whether the length is used in a country or region.

        A country also has the lengths of its region, a region those of its countries.

        Args:
            place: code or English name of a country, or name of a region.
        """
        code = country_code(place) or place.upper()
        if place in self.countries or code in self.countries:
            return True
        if COUNTRY_REGIONS.get(code) in self.countries:
            return True
        regions = [COUNTRY_REGIONS.get(country) for country in self.countries]
        return place in regions


class Standard(NamedTuple):
    """Thing of known size.

    Attributes:
        name: name in options and tables.
        between: ends of the line to draw.
        chance_wrong: 0..1, chance that a caller takes something else for the thing.
        source: rule or survey behind the lengths.
        variants: lengths, with their countries.
    """

    name: str
    between: str
    chance_wrong: float
    source: str
    variants: tuple[Variant, ...]

    def lengths_in(self, place: str | None) -> tuple[Variant, ...]:
        """Select the lengths of a country or region, with weights that add up to 1.

        Args:
            place: code of a country or name of a region. All lengths are returned if it is None,
                or if no length is used there.
        """
        variants = self.variants
        if place:
            variants = tuple(variant for variant in variants if variant.is_of(place))
        if not variants:
            variants = self.variants
        total = sum(variant.weight for variant in variants)
        weighted = []
        for variant in variants:
            share = variant.weight / total
            weighted.append(variant._replace(weight=share))
        return tuple(weighted)


@cache
def standards() -> Mapping[str, Standard]:
    """Read the catalogue, by name."""
    file = files("vehanchor.rulers").joinpath("standards.toml")
    table = tomllib.loads(file.read_text(encoding="utf-8"))
    entries = {}
    for name, entry in table.items():
        entries[name] = {"name": name, **entry}
    return TypeAdapter(dict[str, Standard]).validate_python(entries)


def lengths_of(what: str, region: str | None = None) -> tuple[Standard, tuple[Variant, ...]]:
    """Find a thing of known size and its lengths.

    Args:
        what: its name, as ``check_name`` allows it, with an optional country, such as
            "railway_gauge/ES".
        region: country or region of the image; a country in the name is used instead.
    """
    name, _, country = what.partition("/")
    standard = standards()[name]
    return standard, standard.lengths_in(country or region)


def describe_lengths(standard: Standard) -> list[str]:
    """Describe each length of a thing with its spread and countries, such as "2.5 m +- 3 %: DE"."""
    lengths = []
    for variant in standard.variants:
        length = f"{variant.metres:g} m +- {100 * variant.log_sd:.2g} %"
        if variant.countries:
            length += f": {', '.join(variant.countries)}"
        lengths.append(length)
    return lengths


def exact_kind(what: str) -> str | None:
    """Return the kind of a thing whose size a rule fixes, such as "tennis"; None for a custom.

    Things of one kind, such as the length and the width of a court, are mistaken together. The
    kind is the first word of the name.

    Args:
        what: name of the thing, as in ``lengths_of``.
    """
    standard, _ = lengths_of(what)
    if any(variant.log_sd > _EXACT_LOG_SD for variant in standard.variants):
        return None
    return standard.name.partition("_")[0]


def check_name(what: str | None) -> None:
    """Check the name of a thing of known size; None is valid.

    Raises:
        KnownLengthError: the thing is not in the catalogue, and the message names the nearest ones;
            or the country is not a two-letter code.
    """
    if what is None:
        return
    name, slash, country = what.partition("/")
    if name not in standards():
        shown = name[:_MAX_SHOWN_CHARS]
        # Without a cutoff there are always nearest names, however far off.
        catalogue = standards()
        names = get_close_matches(shown.lower(), catalogue, n=_MAX_NEAREST, cutoff=0.0)
        nearest = "; ".join(f"{thing}: {catalogue[thing].between}" for thing in names)
        raise KnownLengthError(
            f"there is no thing of known size {shown!r}. The nearest are {nearest}. For all names, "
            "run 'vehanchor models --sizes', or call view_image with known_sizes"
        )
    are_capitals = country.isascii() and country.isupper()
    is_code = are_capitals and len(country) == 2
    if slash and not is_code:
        raise KnownLengthError(
            f"the country in {what!r} is {country!r}: use two capital letters, as in {name}/DE"
        )
