"""Numbers of metadata, from all blocks of a file that state them."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from vehanchor.imagery.metadata.exif import ExifTags
    from vehanchor.imagery.metadata.makers import Maker
    from vehanchor.imagery.metadata.xmp import Properties

_NUMBER = re.compile(
    r"([+-]?)(\d+(?:[.,]\d*)?|[.,]\d+)([eE][+-]?\d{1,3})?(?:\s*/\s*(\d+(?:\.\d*)?))?\s*(\D*)"
)
_THOUSANDS = re.compile(r"[1-9]\d{0,2},\d{3}")  # in some countries a fraction, in others thousands
_EQUAL = 0.02  # relative: EXIF's focal length often has one decimal
_EQUAL_TEXTS = 1e-3  # relative: texts of one number, rounded
_SHOWN_CHARS = 32


_LENS_TAGS = (
    *("FocalLength", "FocalLengthIn35mmFilm", "FocalPlaneXResolution", "FocalPlaneResolutionUnit"),
    *("DigitalZoomRatio", "PixelXDimension", "PixelYDimension"),
)
IN_XMP = {
    **dict.fromkeys(("Make", "Model"), "http://ns.adobe.com/tiff/1.0"),
    **dict.fromkeys(_LENS_TAGS, "http://ns.adobe.com/exif/1.0"),
}
"""Namespaces of the tags that programs copy from EXIF into XMP, under the same names."""

METRES = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("ft", "feet", "'"), 0.3048),
}
DEGREES = dict.fromkeys(("\N{DEGREE SIGN}", "deg", "degree", "degrees"), 1.0)
PIXELS = dict.fromkeys(("px", "pixel", "pixels"), 1.0)
_MILLIMETRES = {"mm": 1.0}
"""Units that a quantity may have, each with its factor; without a unit, the factor is 1."""


class Statements:
    """Statements of all EXIF blocks and XMP packets of a file.

    If two statements of one quantity differ, neither is used.

    Args:
        tags: tags of the EXIF blocks.
        packets: properties of the XMP packets.
        refused: what was not used so far, as clauses.

    Attributes:
        refused: what was not used, and why.
    """

    def __init__(
        self, tags: Sequence[ExifTags], packets: Sequence[Properties], refused: Sequence[str]
    ) -> None:
        self.refused = list(refused)
        self._tags = tags
        self._texts: dict[tuple[str, str], list[str]] = {}
        for packet in packets:
            for (space, name), texts in packet.items():
                # some programs flatten names
                self._texts.setdefault((space, name.replace("/", "")), []).extend(texts)

    def text(self, name: str) -> str:
        """Read a tag's text from the first EXIF block that has it, or from XMP."""
        texts = [value for each in self._tags if isinstance(value := each.get(name), str)]
        texts += self._texts.get((IN_XMP.get(name, ""), name), [])
        return next(
            (clean for each in texts if (clean := "".join(filter(str.isprintable, each)).strip())),
            "",
        )

    def whole(self, name: str) -> int | None:
        """Read a tag's whole number from the first block that has a positive one."""
        values = self._numbers(name)
        return next((int(value) for value in values if 0 < value < 1e9), None)

    def lens_number(self, name: str) -> float | None:
        """Read a tag's number; None for 0, which is "unknown" in the standard, and for two numbers that differ."""
        return self._agreed(name, [value for value in self._numbers(name) if value > 0], _EQUAL)

    def quantity(self, maker: Maker, name: str, units: Mapping[str, float]) -> float | None:
        """Read a maker's property; None if it is missing, no number, or stated with two values."""
        label = f"{maker.name} {name}"
        values = []
        for text in self._of(maker, name):
            value = _number(text, units)
            if value is None:
                self.refused.append(f"{label} is {text[:_SHOWN_CHARS]!r}, which is not understood")
            else:
                values.append(value)
        return self._agreed(label, values, _EQUAL_TEXTS)

    def focal(self, maker: Maker) -> tuple[float | None, str]:
        """Read a maker's focal length with its unit, ``mm`` or ``px``."""
        named = "".join(self._of(maker, f"{maker.focal}Units")[:1]).casefold()
        if named and named not in {**PIXELS, **_MILLIMETRES}:
            self.refused.append(
                f"{maker.name} {maker.focal}Units is {named[:_SHOWN_CHARS]!r}, which is not "
                "understood"
            )
            return None, ""
        unit = "px" if named in PIXELS or (not named and maker.focal_unit == "px") else "mm"
        return self.quantity(maker, maker.focal, PIXELS if unit == "px" else _MILLIMETRES), unit

    def _of(self, maker: Maker, name: str) -> list[str]:
        """All texts of a maker's property."""
        flat = name.replace("/", "")
        if ":" in maker.namespace:
            return self._texts.get((maker.namespace, flat), [])
        texts = (
            each
            for (space, own), each in self._texts.items()
            if own == flat and maker.namespace in space.lower()
        )
        return [text for each in texts for text in each]

    def _numbers(self, name: str) -> list[float]:
        values = [value for each in self._tags if isinstance(value := each.get(name), float)]
        texts = self._texts.get((IN_XMP.get(name, ""), name), [])
        return values + [
            value for text in texts if (value := _number(text, _MILLIMETRES)) is not None
        ]

    def _agreed(self, label: str, values: Sequence[float], equal: float) -> float | None:
        if not values:
            return None
        least = min(values)
        most = max(values)
        if most - least > equal * abs(most):
            self.refused.append(f"{label} is both {least:.6g} and {most:.6g}")
            return None
        return values[0]


def _number(text: str, units: Mapping[str, float]) -> float | None:
    """Read a decimal number or a fraction with one of these units, or without; None for anything else."""
    matched = _NUMBER.fullmatch(text.strip())
    if matched is None or _THOUSANDS.fullmatch(matched[2]):
        return None
    sign, digits, exponent, denominator, named = matched.groups()
    factor = units.get(named.strip().casefold()) if named.strip() else 1.0
    over = float(denominator or 1)
    if factor is None or not over:
        return None
    value = float(f"{sign}{digits.replace(',', '.')}{exponent or ''}") / over * factor
    return value if math.isfinite(value) else None
