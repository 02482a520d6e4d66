"""Reference lengths by country (ISO 3166-1 alpha-2): the national mean if it is published, else that of the region.

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
    "CH": 4.33,  # new cars of 2011; 4.49 in 2024. RTS, 2024, quoted by eco-auto.info
    "DE": 4.40,  # new cars of 2017. CAR, University of Duisburg-Essen, May 2018 (AFP)
    "FR": 4.21,  # new cars of 2019, 99 % of the market. L'argus, "Voiture moyenne"
    "GB": 4.30,  # the most popular cars about 2020. RAC Foundation, "Standing still"
    "IN": 3.72,  # cars, jeeps and vans in traffic. Chandra and Kumar, J. Transp. Eng. 129(2), 2003
    "NL": 4.20,  # cars in use built in 2016; 4.41 of 2024. Statistics Netherlands (CBS), 2025
    # light vehicles offered in 2013; 5.243 in 2023. JATO Dynamics, February 2024 (Motor1)
    "US": 5.158,
}
"""Mean body length in metres, of the year nearest to a fleet's mean age of about ten years."""

_NAMES = (
    "Albania AL, Argentina AR, Austria AT, Bangladesh BD, Belarus BY, Belgium BE, Bhutan BT, "
    "Bolivia BO, "
    "Bosnia and Herzegovina BA, Brazil BR, Bulgaria BG, Canada CA, Chile CL, Colombia CO, Costa "
    "Rica CR, Croatia HR, "
    "Cuba CU, Cyprus CY, Czechia CZ, Denmark DK, Dominican Republic DO, Ecuador EC, El Salvador "
    "SV, England GB, "
    "Estonia EE, Finland FI, France FR, Germany DE, Great Britain GB, Greece GR, Guatemala GT, "
    "Guyana GY, Haiti HT, "
    "Honduras HN, Hungary HU, Iceland IS, India IN, Ireland IE, Italy IT, Jamaica JM, Latvia "
    "LV, Lithuania LT, "
    "Luxembourg LU, Maldives MV, Malta MT, Mexico MX, Moldova MD, Montenegro ME, Nepal NP, "
    "Netherlands NL, "
    "Nicaragua NI, North Macedonia MK, Norway NO, Pakistan PK, Panama PA, Paraguay PY, Peru PE, "
    "Poland PL, "
    "Portugal PT, Romania RO, Russia RU, Scotland GB, Serbia RS, Slovakia SK, Slovenia SI, "
    "Spain ES, Sri Lanka LK, "
    "Suriname SR, Sweden SE, Switzerland CH, The Netherlands NL, Ukraine UA, United Kingdom GB, "
    "United States US, "
    "UK GB, Uruguay UY, USA US, Venezuela VE, Wales GB"
)
COUNTRY_CODES = {
    name.lower(): code for name, _, code in (each.rpartition(" ") for each in _NAMES.split(", "))
}
"""Codes by English names of countries, in lower case."""

_MEASURED_IN = {"europe": "FR", "north_america": "US", "south_asia": "IN"}
_REGION_COUNTRIES = {
    "europe": "AD AL AT BA BE BG BY CH CY CZ DE DK ES FR GB GG GI GR HR HU IE IM IT JE LI LU MC "
    "MD ME MK MT NL PL PT "
    "RO RS RU SI SK SM UA VA",
    "northern_europe": "AX EE FI FO IS LT LV NO SE SJ",
    "north_america": "BM CA GL PM US",
    "south_america": "AG AI AR AW BB BL BO BQ BR BS BZ CL CO CR CU CW DM DO EC FK GD GF GP GT "
    "GY HN HT JM KN KY LC MF "
    "MQ MS MX NI PA PE PR PY SR SV SX TC TT UY VC VE VG VI",
    "south_asia": "BD BT IN LK MV NP PK",
}
"""Codes by region, after the United Nations' geoscheme (M49), with four changes.

The British Isles and Denmark are in ``europe``, because ``northern_europe`` was measured in Estonia. Central America
and the Caribbean are in ``south_america``. Afghanistan and Iran are left out of ``south_asia``, measured in Nepal.
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
        Metres: the published mean times the mean of the model's ratios, else the length of the
            country's
        region; None if neither is known.
    """
    code = country.upper()
    ratios = [
        math.log(region_lengths_m[region] / COUNTRY_LENGTHS_M[there])
        for region, there in _MEASURED_IN.items()
        if region in region_lengths_m
    ]
    if code in COUNTRY_LENGTHS_M and ratios:
        return COUNTRY_LENGTHS_M[code] * math.exp(math.fsum(ratios) / len(ratios))
    return region_lengths_m.get(COUNTRY_REGIONS.get(code, ""))
