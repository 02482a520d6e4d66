"""Numbers of metadata, from all blocks of a file that state them."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING, TypeVar

from vehanchor.imagery.metadata.makers import PIX4D
from vehanchor.options.option import FOOT_M

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from vehanchor.imagery.metadata.exif import ExifTags
    from vehanchor.imagery.metadata.makers import Maker
    from vehanchor.imagery.metadata.xmp import Properties

_Value = TypeVar("_Value", str, float)

_NUMBER = re.compile(
    r"(?P<sign>[+-]?)"
    r"(?P<digits>\d+(?:[.,]\d*)?|[.,]\d+)"
    r"(?P<exponent>[eE][+-]?\d{1,3})?"
    r"(?:\s*/\s*(?P<denominator>\d+(?:\.\d*)?))?"
    r"\s*(?P<unit>\D*)"
)
_THOUSANDS = re.compile(r"[1-9]\d{0,2},\d{3}")
"""Digits with an ambiguous comma: a decimal one in some countries, one of thousands in others."""

_LENS_TOLERANCE = 0.02
"""Relative difference of equal numbers; EXIF's focal length often has one decimal."""

_TEXT_TOLERANCE = 1e-3
"""Relative difference of texts of one number, each rounded."""

_SHOWN_CHARS = 32
_MAX_WHOLE = 1e9

_TIFF_NAMESPACE = "http://ns.adobe.com/tiff/1.0"
_EXIF_NAMESPACE = "http://ns.adobe.com/exif/1.0"
_GPANO_NAMESPACE = "http://ns.google.com/photos/1.0/panorama"
_CAMERA_RAW_NAMESPACE = "http://ns.adobe.com/camera-raw-settings/1.0"
IN_XMP = {
    "Make": _TIFF_NAMESPACE,
    "Model": _TIFF_NAMESPACE,
    "ImageWidth": _TIFF_NAMESPACE,
    "ImageLength": _TIFF_NAMESPACE,
    "FocalLength": _EXIF_NAMESPACE,
    "FocalLengthIn35mmFilm": _EXIF_NAMESPACE,
    "FocalPlaneXResolution": _EXIF_NAMESPACE,
    "FocalPlaneResolutionUnit": _EXIF_NAMESPACE,
    "DigitalZoomRatio": _EXIF_NAMESPACE,
    "PixelXDimension": _EXIF_NAMESPACE,
    "PixelYDimension": _EXIF_NAMESPACE,
    "CustomRendered": _EXIF_NAMESPACE,
    "LensModel": "http://cipa.jp/exif/1.0",
    "Lens": "http://ns.adobe.com/exif/1.0/aux",
    "ProjectionType": _GPANO_NAMESPACE,
    "FullPanoWidthPixels": _GPANO_NAMESPACE,
    "UsePanoramaViewer": _GPANO_NAMESPACE,
    "ModelType": PIX4D,
    "HasCrop": _CAMERA_RAW_NAMESPACE,
    "AlreadyApplied": _CAMERA_RAW_NAMESPACE,
}
"""Namespaces of the properties that makers share: tags that programs copy from EXIF into XMP under
the same names, the projection of the picture, and what editors did to it."""

# Units that a quantity may have, each with its factor; without a unit, the factor is 1.
METRES = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    **dict.fromkeys(("ft", "feet", "'"), FOOT_M),
}
DEGREES = dict.fromkeys(("\N{DEGREE SIGN}", "deg", "degree", "degrees"), 1.0)
PIXELS = dict.fromkeys(("px", "pixel", "pixels"), 1.0)
_MILLIMETRES = {"mm": 1.0}


class Statements:
    """Statements of all EXIF blocks and XMP packets of a file.

    If two statements of one quantity differ, neither is used.

    Args:
        tags: tags of the EXIF blocks.
        packets: properties of the XMP packets.
        refused: why blocks were not used, as clauses.

    Attributes:
        refused: why blocks and statements were not used, as clauses.
    """

    def __init__(
        self, tags: Sequence[ExifTags], packets: Sequence[Properties], refused: Sequence[str]
    ) -> None:
        self.refused = list(refused)
        self._tags = tags
        self._texts: dict[tuple[str, str], list[str]] = {}
        for packet in packets:
            for (namespace, name), texts in packet.items():
                # Some programs flatten the names of structures, so all are flattened.
                key = (namespace, _flat(name))
                self._texts.setdefault(key, []).extend(texts)

    def text(self, name: str) -> str:
        """Read a tag's text from the first EXIF block that has it, or from XMP."""
        in_exif = self._tag_values(name, str)
        in_xmp = self._texts_in_xmp(name)
        for text in (*in_exif, *in_xmp):
            printable = "".join(filter(str.isprintable, text)).strip()
            if printable:
                return printable
        return ""

    def whole(self, name: str) -> int | None:
        """Read a tag's whole number from the first block that has a positive one."""
        for value in self._numbers(name):
            if 0 < value < _MAX_WHOLE:
                return int(value)
        return None

    def sizes(self, width_name: str, height_name: str) -> list[tuple[float, float]]:
        """List the pairs of two tags, above 0, in the EXIF blocks and in XMP."""
        pairs: list[tuple[float, float]] = []
        for block in self._tags:
            width = block.get(width_name)
            height = block.get(height_name)
            if isinstance(width, float) and isinstance(height, float):
                pairs.append((width, height))
        widths = [_number(text, PIXELS) for text in self._texts_in_xmp(width_name)]
        heights = [_number(text, PIXELS) for text in self._texts_in_xmp(height_name)]
        # A damaged packet can lack one of them.
        for width, height in zip(widths, heights, strict=False):
            if width is not None and height is not None:
                pairs.append((width, height))
        return [(width, height) for width, height in pairs if width > 0 and height > 0]

    def lens_number(self, name: str) -> float | None:
        """Read a tag's number.

        Returns:
            None for 0, which is "unknown" in the standard, and for two numbers that differ.
        """
        positive = [value for value in self._numbers(name) if value > 0]
        return self._agreed(name, positive, _LENS_TOLERANCE)

    def quantity(self, maker: Maker, name: str, units: Mapping[str, float]) -> float | None:
        """Read a maker's property; None if it is missing, not a number, or stated differently."""
        label = f"{maker.name} {name}"
        values = []
        for text in self._texts_of(maker, name):
            value = _number(text, units)
            if value is None:
                shown = text[:_SHOWN_CHARS]
                self.refused.append(f"{label} is {shown!r}, which is not understood")
            else:
                values.append(value)
        return self._agreed(label, values, _TEXT_TOLERANCE)

    def word(self, maker: Maker, name: str) -> str:
        """Read a maker's property as a word in lower case; empty if it is missing or ambiguous."""
        words = {text.strip().casefold() for text in self._texts_of(maker, name)}
        return words.pop() if len(words) == 1 else ""

    def focal(self, maker: Maker) -> tuple[float | None, str]:
        """Read a maker's focal length with its unit, ``mm`` or ``px``."""
        units_name = f"{maker.focal}Units"
        texts = self._texts_of(maker, units_name)
        unit_text = texts[0].casefold() if texts else ""
        if unit_text in PIXELS:
            unit = "px"
        elif unit_text in _MILLIMETRES:
            unit = "mm"
        elif not unit_text:
            unit = maker.focal_unit
        else:
            self.refused.append(
                f"{maker.name} {units_name} is {unit_text[:_SHOWN_CHARS]!r}, which is not "
                "understood"
            )
            return None, ""
        units = PIXELS if unit == "px" else _MILLIMETRES
        return self.quantity(maker, maker.focal, units), unit

    def _tag_values(self, name: str, kind: type[_Value]) -> list[_Value]:
        """List a tag's values of one type in all EXIF blocks."""
        values = [block.get(name) for block in self._tags]
        return [value for value in values if isinstance(value, kind)]

    def _texts_in_xmp(self, name: str) -> list[str]:
        """List the texts of a tag that programs copy into XMP."""
        namespace = IN_XMP.get(name, "")
        return self._texts.get((namespace, name), [])

    def _texts_of(self, maker: Maker, name: str) -> list[str]:
        """List all texts of a maker's property."""
        flat_name = _flat(name)
        if ":" in maker.namespace:
            return self._texts.get((maker.namespace, flat_name), [])
        texts: list[str] = []
        for (namespace, property_name), property_texts in self._texts.items():
            if property_name == flat_name and maker.namespace in namespace.lower():
                texts.extend(property_texts)
        return texts

    def _numbers(self, name: str) -> list[float]:
        """List a tag's numbers in all EXIF blocks, then in XMP."""
        in_xmp = [_number(text, _MILLIMETRES) for text in self._texts_in_xmp(name)]
        readable = [value for value in in_xmp if value is not None]
        return [*self._tag_values(name, float), *readable]

    def _agreed(self, label: str, values: Sequence[float], tolerance: float) -> float | None:
        """Choose the first of several statements; None, with a reason, if they differ."""
        if not values:
            return None
        lowest = min(values)
        highest = max(values)
        if highest - lowest > tolerance * abs(highest):
            self.refused.append(f"{label} is both {lowest:.6g} and {highest:.6g}")
            return None
        return values[0]


def _flat(name: str) -> str:
    """Join the names of a structure and its field."""
    return name.replace("/", "")


def _number(text: str, units: Mapping[str, float]) -> float | None:
    """Read a decimal number or a fraction, with one of these units or without.

    Returns:
        None for anything else, and for an ambiguous comma.
    """
    match = _NUMBER.fullmatch(text.strip())
    if match is None or _THOUSANDS.fullmatch(match["digits"]):
        return None
    unit = match["unit"].strip().casefold()
    factor = units.get(unit) if unit else 1.0
    denominator = float(match["denominator"] or 1)
    if factor is None or denominator == 0:
        return None
    digits = match["digits"].replace(",", ".")
    numerator = float(f"{match['sign']}{digits}{match['exponent'] or ''}")
    value = numerator / denominator * factor
    return value if math.isfinite(value) else None
