"""Reference lengths by country (ISO 3166-1 alpha-2): from a published mean, else of the region.

Published means are of makes and models; reference lengths are modal lengths of what a model
measures. The ratio of the two is measured where both are known, in France, India or Nepal, and the
United States. The bundled networks have 0.94, 0.99 and 0.91 there.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

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

COUNTRY_CODES = {
    "albania": "AL",
    "argentina": "AR",
    "austria": "AT",
    "bangladesh": "BD",
    "belarus": "BY",
    "belgium": "BE",
    "bhutan": "BT",
    "bolivia": "BO",
    "bosnia and herzegovina": "BA",
    "brazil": "BR",
    "bulgaria": "BG",
    "canada": "CA",
    "chile": "CL",
    "colombia": "CO",
    "costa rica": "CR",
    "croatia": "HR",
    "cuba": "CU",
    "cyprus": "CY",
    "czechia": "CZ",
    "denmark": "DK",
    "dominican republic": "DO",
    "ecuador": "EC",
    "el salvador": "SV",
    "england": "GB",
    "estonia": "EE",
    "finland": "FI",
    "france": "FR",
    "germany": "DE",
    "great britain": "GB",
    "greece": "GR",
    "guatemala": "GT",
    "guyana": "GY",
    "haiti": "HT",
    "honduras": "HN",
    "hungary": "HU",
    "iceland": "IS",
    "india": "IN",
    "ireland": "IE",
    "italy": "IT",
    "jamaica": "JM",
    "latvia": "LV",
    "lithuania": "LT",
    "luxembourg": "LU",
    "maldives": "MV",
    "malta": "MT",
    "mexico": "MX",
    "moldova": "MD",
    "montenegro": "ME",
    "nepal": "NP",
    "netherlands": "NL",
    "nicaragua": "NI",
    "north macedonia": "MK",
    "norway": "NO",
    "pakistan": "PK",
    "panama": "PA",
    "paraguay": "PY",
    "peru": "PE",
    "poland": "PL",
    "portugal": "PT",
    "romania": "RO",
    "russia": "RU",
    "scotland": "GB",
    "serbia": "RS",
    "slovakia": "SK",
    "slovenia": "SI",
    "spain": "ES",
    "sri lanka": "LK",
    "suriname": "SR",
    "sweden": "SE",
    "switzerland": "CH",
    "the netherlands": "NL",
    "ukraine": "UA",
    "united kingdom": "GB",
    "united states": "US",
    "uk": "GB",
    "uruguay": "UY",
    "usa": "US",
    "venezuela": "VE",
    "wales": "GB",
}
"""Codes by English names of countries, in lower case."""

# Country in which the reference length of a region was measured, if its mean is published.
_MEASURED_IN = {"europe": "FR", "north_america": "US", "south_asia": "IN"}
_REGION_COUNTRIES = {
    "europe": (
        "AD AL AT BA BE BG BY CH CY CZ DE DK ES FR GB GG GI GR HR HU IE IM IT JE LI LU MC MD ME "
        "MK MT NL PL PT RO RS RU SI SK SM UA VA"
    ),
    "northern_europe": "AX EE FI FO IS LT LV NO SE SJ",
    "north_america": "BM CA GL PM US",
    "south_america": (
        "AG AI AR AW BB BL BO BQ BR BS BZ CL CO CR CU CW DM DO EC FK GD GF GP GT GY HN HT JM KN "
        "KY LC MF MQ MS MX NI PA PE PR PY SR SV SX TC TT UY VC VE VG VI"
    ),
    "south_asia": "BD BT IN LK MV NP PK",
}
"""Codes by region, after the United Nations' geoscheme (M49), with four changes.

The British Isles and Denmark are in ``europe``, because ``northern_europe`` was measured in
Estonia. Central America and the Caribbean are in ``south_america``. Afghanistan and Iran are left
out of ``south_asia``, which was measured in Nepal.
"""
REGIONS = tuple(_REGION_COUNTRIES)
"""Regions with a reference length in the bundled models; other models may have others."""
COUNTRY_REGIONS: dict[str, str] = {
    code: region for region, codes in _REGION_COUNTRIES.items() for code in codes.split()
}
"""Region by country."""


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
    # A detector's boxes differ from bodies by one ratio, the geometric mean over the regions.
    log_ratios = [
        math.log(region_lengths_m[region] / COUNTRY_LENGTHS_M[measured_country])
        for region, measured_country in _MEASURED_IN.items()
        if region in region_lengths_m
    ]
    if code in COUNTRY_LENGTHS_M and log_ratios:
        ratio = math.exp(math.fsum(log_ratios) / len(log_ratios))
        return COUNTRY_LENGTHS_M[code] * ratio
    return region_lengths_m.get(COUNTRY_REGIONS.get(code, ""))
