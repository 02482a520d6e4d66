"""Properties of known names in an XMP packet, read from untrusted bytes.

Regular expressions with bounded repetitions find them, whether the packet is XML or damaged. The
depth of an element is ignored, except in the structures among the names. Nothing is expanded: a
packet with a document type or an entity is refused.
"""

from __future__ import annotations

import html
import re
from functools import cache
from typing import TypeAlias
from xml.parsers import expat

from vehanchor.imagery.metadata.blocks import MAX_XMP_BYTES

Properties: TypeAlias = dict[tuple[str, str], list[str]]
"""All texts of a property, by namespace (without a final slash) and name.

The field of a structure has the name ``Structure/Field``.
"""

DAMAGED = "its XMP is damaged"
"""Reason to refuse a packet that is not XML and has none of the names."""

_NAMESPACE = re.compile(r"xmlns:([\w.-]{1,32})\s{0,8}=\s{0,8}[\"']([^\"'<>]{1,256})[\"']")
_WIDE_ENCODINGS = {
    b"\xff\xfe": "utf-16-le",
    b"\xfe\xff": "utf-16-be",
    b"<\0": "utf-16-le",
    b"\0<": "utf-16-be",
}
"""Encodings by a packet's first two bytes: a byte order mark or "<"; all others are UTF-8."""

_DECLARATION = re.compile(r"<!(?:DOCTYPE|ENTITY)")
_NO_MATCH = "(?!)"


def read_xmp(packet: bytes, names: tuple[str, ...]) -> tuple[Properties, str]:
    """Read a packet's properties.

    Args:
        packet: bytes from ``<?xpacket`` or ``<x:xmpmeta`` on; those after ``MAX_XMP_BYTES`` are
            left out.
        names: names of the properties to find.

    Returns:
        The properties, and why the packet was refused, as a clause; empty if it was read.
    """
    text = _decode(packet)
    if _DECLARATION.search(text):
        return {}, "its XMP declares a document type or entities, which no camera writes"
    namespaces = {}
    for prefix, address in _NAMESPACE.findall(text):
        namespaces[prefix] = address.rstrip("/")
    structure_pattern, property_pattern = _patterns(names)
    # A field has its structure's name before it; outside of structures there is none.
    parts = [("", text)]
    for structure in structure_pattern.finditer(text):
        parts.append((f"{structure['outer']}/", structure[0]))
    properties: Properties = {}
    for structure_name, part in parts:
        for match in property_pattern.finditer(part):
            name = structure_name + match["name"]
            escaped = match["element"] if match["attribute"] is None else match["attribute"]
            value = html.unescape(escaped).strip()
            namespace = namespaces.get(match["prefix"])
            if value and name in names and namespace is not None:
                properties.setdefault((namespace, name), []).append(value)
    if properties or _is_xml(text):
        return properties, ""
    return properties, DAMAGED


def _decode(packet: bytes) -> str:
    """Decode a packet of UTF-8 or UTF-16; invalid bytes become replacement characters."""
    packet = packet[:MAX_XMP_BYTES].strip(b" \r\n\t")
    encoding = _WIDE_ENCODINGS.get(packet[:2], "utf-8-sig")
    return packet.decode(encoding, "replace").strip("\0\ufeff \r\n\t")


def _is_xml(text: str) -> bool:
    """Test whether a text is well-formed XML."""
    try:
        parser = expat.ParserCreate("utf-8")
        parser.Parse(text.encode("utf-8", "replace"), True)
    except expat.ExpatError:
        return False
    return True


@cache
def _patterns(names: tuple[str, ...]) -> tuple[re.Pattern[str], re.Pattern[str]]:
    """Make the patterns of the structures among these names, and of a property.

    A property is an attribute or an element. All repetitions are bounded, so that a hostile packet
    cannot make the search slow.
    """
    structures = {name.partition("/")[0] for name in names if "/" in name}
    properties = {name.rpartition("/")[2] for name in names}
    outer = _alternatives(structures)
    inner = _alternatives(properties)
    structure = (
        rf"<[\w.-]{{1,32}}:(?P<outer>{outer})\b"
        r"(?:[^<>]{0,512}/>|.{0,1024}?</[\w.-]{1,32}:(?P=outer)>)"
    )
    statement = (
        rf"[\s<](?P<prefix>[\w.-]{{1,32}}):(?P<name>{inner})\s{{0,64}}"
        r"(?:=\s{0,64}(?P<quote>[\"'])(?P<attribute>(?:(?!(?P=quote))[^<]){0,256})(?P=quote)"
        r"|(?:\s[^<>]{0,256}(?<!/))?>(?P<element>[^<]{0,256})(?=<))"
    )
    return re.compile(structure, re.DOTALL), re.compile(statement)


def _alternatives(names: set[str]) -> str:
    """Make a pattern that matches one of these names; without names, it matches nothing."""
    return "|".join(sorted(map(re.escape, names))) or _NO_MATCH
