"""Reference lengths by country (ISO 3166-1 alpha-2): from a published mean, else of the region.

Published means are of makes and models; reference lengths are modal lengths of what a model
measures. The ratio of the two is measured where both are known, in France, India or Nepal, and the
United States. The bundled networks have 0.94, 0.99 and 0.91 there.
"""

from __future__ import annotations

import csv
import math
import re
import unicodedata
from importlib import resources
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

COUNTRY_LENGTHS_M: dict[str, float] = {
    # New cars of 2011; 4.49 in 2024. RTS, 2024, quoted by eco-auto.info.
    "CH": 4.33,
    # New cars of 2017. CAR, University of Duisburg-Essen, May 2018 (AFP).
    "DE": 4.40,
    # New cars of 2019, 99 % of the market. L'argus, "Voiture moyenne".
    "FR": 4.21,
    # The most popular cars about 2020. RAC Foundation, "Standing still".
    "GB": 4.30,
    # Cars, jeeps and vans in traffic. Chandra and Kumar, J. Transp. Eng. 129(2), 2003.
    "IN": 3.72,
    # Cars in use built in 2016; 4.41 of 2024. Statistics Netherlands (CBS), 2025.
    "NL": 4.20,
    # Light vehicles offered in 2013; 5.243 in 2023. JATO Dynamics, February 2024 (Motor1).
    "US": 5.158,
}
"""Mean body length in metres, of the year nearest to a fleet's mean age of about ten years."""

# Country in which the reference length of a region was measured, if its mean is published.
_MEASURED_IN = {"europe": "FR", "north_america": "US", "south_asia": "IN"}
_TABLE = "countries.csv"


class Country(NamedTuple):
    """Country by ISO 3166-1, and its region.

    Attributes:
        code: its alpha-2 code.
        region: the region whose cars stand for its own, after the United Nations' geoscheme (M49)
            with four changes; an empty string where no cars were measured. The British Isles and
            Denmark are in ``europe``, because ``northern_europe`` was measured in Estonia. Central
            America and the Caribbean are in ``south_america``. Afghanistan and Iran are not in
            ``south_asia``, which was measured in Nepal.
        names: its English names, in lower case without accents.
    """

    code: str
    region: str
    names: tuple[str, ...]


def _read_countries() -> dict[str, Country]:
    """Read all countries of ISO 3166-1 from the table beside this module, by code."""
    countries = {}
    text = resources.files(__package__).joinpath(_TABLE).read_text(encoding="utf-8")
    for row in csv.DictReader(text.splitlines()):
        names = tuple(row["names"].split("|"))
        countries[row["code"]] = Country(row["code"], row["region"], names)
    return countries


COUNTRIES: Mapping[str, Country] = _read_countries()
"""Countries by code."""

COUNTRY_REGIONS: Mapping[str, str] = {
    code: country.region for code, country in COUNTRIES.items() if country.region
}
"""Region by country, without countries whose cars nobody has measured."""

REGIONS = tuple(sorted(set(COUNTRY_REGIONS.values())))
"""Regions with a reference length in the bundled models; other models may have others."""


def country_code(place: str) -> str | None:
    """Find the code of a country by its code in any case, or by its English name in any spelling.

    Returns:
        The alpha-2 code; None if no country is called so.
    """
    code = place.strip().upper()
    if code in COUNTRIES:
        return code
    straight = place.replace("\N{RIGHT SINGLE QUOTATION MARK}", "'")
    decomposed = unicodedata.normalize("NFKD", straight)
    ascii_name = decomposed.encode("ascii", "ignore").decode().lower().replace("&", " and ")
    words = re.findall(r"[a-z']+", ascii_name)
    name = " ".join(words)
    for country in COUNTRIES.values():
        if name in country.names:
            return country.code
    return None


def country_length(country: str, region_lengths_m: Mapping[str, float]) -> float | None:
    """Compute a detector's reference length for a country.

    Args:
        country: ISO 3166-1 alpha-2 code, upper or lower case.
        region_lengths_m: the detector's reference lengths by region.

    Returns:
        Metres: the published mean times the mean of the detector's ratios, else the length of the
        country's region; None if neither is known.
    """
    code = country.upper()
    if not uses_published_mean(code, region_lengths_m):
        return region_lengths_m.get(COUNTRY_REGIONS.get(code, ""))
    # A detector's boxes differ from bodies by one ratio, the geometric mean over the regions.
    log_ratios = [
        math.log(region_lengths_m[region] / COUNTRY_LENGTHS_M[measured_country])
        for region, measured_country in _MEASURED_IN.items()
        if region in region_lengths_m
    ]
    ratio = math.exp(math.fsum(log_ratios) / len(log_ratios))
    return COUNTRY_LENGTHS_M[code] * ratio


def uses_published_mean(code: str, region_lengths_m: Mapping[str, float]) -> bool:
    """Test whether the length of a country is from its published mean, not from its region.

    Args:
        code: ISO 3166-1 alpha-2 code in capitals.
        region_lengths_m: as in ``country_length``.
    """
    is_ratio_known = any(region in region_lengths_m for region in _MEASURED_IN)
    return code in COUNTRY_LENGTHS_M and is_ratio_known
