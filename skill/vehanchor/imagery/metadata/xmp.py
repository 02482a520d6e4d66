"""Properties of known names in an XMP packet, read from untrusted bytes.

Regular expressions with bounded repetitions find them, whether the packet is XML or damaged. Depth
is ignored but for the structures among the names. Nothing is expanded: a document type or an entity
refuses the packet.
"""

from __future__ import annotations

import html
import re
from functools import cache
from typing import TypeAlias
from xml.parsers import expat

from vehanchor.imagery.metadata.blocks import MAX_XMP_BYTES

Properties: TypeAlias = dict[tuple[str, str], list[str]]
"""All texts of a property by namespace, without a final slash, and name; the field of a structure is
``Structure/Field``."""

_PREFIX = re.compile(r"xmlns:([\w.-]{1,32})\s{0,8}=\s{0,8}[\"']([^\"'<>]{1,256})[\"']")
_WIDE = {
    b"\xff\xfe": "utf-16-le",
    b"\xfe\xff": "utf-16-be",
    b"<\0": "utf-16-le",
    b"\0<": "utf-16-be",
}
_DECLARATION = re.compile(r"<!(?:DOCTYPE|ENTITY)")


def read_xmp(packet: bytes, names: tuple[str, ...]) -> tuple[Properties, str]:
    """Read a packet's properties.

    Args:
        packet: bytes from ``<?xpacket`` or ``<x:xmpmeta`` on; those after ``MAX_XMP_BYTES`` are
            left out.
        names: of the properties to find.

    Returns:
        The properties, and why the packet was refused, as a clause; empty if it was read.
    """
    packet = packet[:MAX_XMP_BYTES].strip(b" \r\n\t")
    text = packet.decode(_WIDE.get(packet[:2], "utf-8-sig"), "replace").strip("\0\ufeff \r\n\t")
    if _DECLARATION.search(text):
        return {}, "its XMP declares a document type or entities, which no camera writes"
    spaces = {prefix: address.rstrip("/") for prefix, address in _PREFIX.findall(text)}
    structures, statement = _patterns(names)
    parts = [("", text), *((f"{each['outer']}/", each[0]) for each in structures.finditer(text))]
    found: Properties = {}
    for outer, part in parts:
        for each in statement.finditer(part):
            value = html.unescape(
                each["element"] if each["attribute"] is None else each["attribute"]
            ).strip()
            if value and outer + each["name"] in names and each["prefix"] in spaces:
                found.setdefault((spaces[each["prefix"]], outer + each["name"]), []).append(value)
    return found, "" if found or _is_xml(text) else DAMAGED


DAMAGED = "its XMP is damaged"
"""Reason of a packet that is no XML and has none of the names."""


def _is_xml(text: str) -> bool:
    try:
        expat.ParserCreate("utf-8").Parse(text.encode("utf-8", "replace"), True)
    except expat.ExpatError:
        return False
    return True


@cache
def _patterns(names: tuple[str, ...]) -> tuple[re.Pattern[str], re.Pattern[str]]:
    """Patterns of the structures among these names, and of a property as an attribute or an element."""
    outer = (
        "|".join(sorted({re.escape(name.partition("/")[0]) for name in names if "/" in name}))
        or "(?!)"
    )
    inner = "|".join(sorted({re.escape(name.rpartition("/")[2]) for name in names})) or "(?!)"
    structure = rf"<[\w.-]{{1,32}}:(?P<outer>{outer})\b(?:[^<>]{{0,512}}/>|.{{0,1024}}?</[\w.-]{{1,32}}:(?P=outer)>)"
    statement = (
        rf"[\s<](?P<prefix>[\w.-]{{1,32}}):(?P<name>{inner})\s{{0,64}}"
        r"(?:=\s{0,64}(?P<quote>[\"'])(?P<attribute>[^\"'<]{0,256})(?P=quote)"
        r"|(?:\s[^<>]{0,256}(?<!/))?>(?P<element>[^<]{0,256})(?=<))"
    )
    return re.compile(structure, re.DOTALL), re.compile(statement)
