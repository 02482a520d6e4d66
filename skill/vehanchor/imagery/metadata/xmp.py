"""Simple properties of an XMP packet, read from untrusted bytes.

Expat parses the packet. A document type or an entity ends the parsing; depth, elements and lengths are bounded. Where a
packet is damaged, a regular expression finds the properties of known names.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cache
from typing import NamedTuple, TypeAlias
from xml.parsers import expat

from vehanchor.imagery.metadata.blocks import MAX_XMP_BYTES

Properties: TypeAlias = dict[tuple[str, str], list[str]]
"""All texts of a property by namespace, without a final slash, and name; the field of a structure is
``Structure/Field``."""

_MAX_DEPTH, _MAX_ELEMENTS, _MAX_TEXT = 32, 4096, 256
_RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
_META = "adobe:ns:meta"
_PREFIX = re.compile(r"xmlns:([\w.-]{1,32})\s{0,8}=\s{0,8}[\"']([^\"'<>]{1,256})[\"']")
_WIDE = {b"\xff\xfe": "utf-16-le", b"\xfe\xff": "utf-16-be", b"<\0": "utf-16-le", b"\0<": "utf-16-be"}
_DECLARATION = re.compile(r"<!(?:DOCTYPE|ENTITY)")


class XmpPacket(NamedTuple):
    """Properties of a packet.

    Attributes:
        properties: of the packet.
        refused: why the packet was refused, as a clause; empty if it was read.
    """

    properties: Properties
    refused: str = ""


class _RefusedError(Exception):
    """The packet holds something that no camera writes."""


def read_xmp(packet: bytes, names: Iterable[str] = ()) -> XmpPacket:
    """Read a packet's properties.

    Args:
        packet: bytes from ``<?xpacket`` or ``<x:xmpmeta`` on; those after ``MAX_XMP_BYTES`` are left out.
        names: of the properties to find in a damaged packet.
    """
    packet = packet[:MAX_XMP_BYTES].strip(b" \r\n\t")
    wide = _WIDE.get(packet[:2])
    text = packet.decode(wide or "utf-8-sig", "replace").strip("\0\ufeff \r\n\t")
    reader = _Reader()
    try:
        reader.parser.Parse(text.encode("utf-8", "replace") if wide else packet.strip(b"\0"), True)
    except _RefusedError as error:
        return XmpPacket({}, str(error))
    except (expat.ExpatError, LookupError, ValueError):  # not XML, or an unknown encoding
        if _DECLARATION.search(text):
            return XmpPacket({}, _DECLARES)
        found = _damaged_properties(text, tuple(names))
        return XmpPacket(found, "" if found else DAMAGED)
    return XmpPacket(reader.properties)


DAMAGED = "its XMP is damaged"
"""Reason of a packet that is no XML and has none of the names."""

_DECLARES = "its XMP declares a document type or entities, which no camera writes"


def _damaged_properties(text: str, names: tuple[str, ...]) -> Properties:
    """Find properties of these names in text that is no XML."""
    spaces = {prefix: address.rstrip("/") for prefix, address in _PREFIX.findall(text)}
    structures, statement = _patterns(names)
    parts = [("", text), *((f"{each['outer']}/", each[0]) for each in structures.finditer(text))]
    found: Properties = {}
    for outer, part in parts:
        for each in statement.finditer(part):
            value = (each["element"] if each["attribute"] is None else each["attribute"]).strip()
            if value and outer + each["name"] in names and each["prefix"] in spaces:
                found.setdefault((spaces[each["prefix"]], outer + each["name"]), []).append(value)
    return found


@cache
def _patterns(names: tuple[str, ...]) -> tuple[re.Pattern[str], re.Pattern[str]]:
    """Patterns of the structures among these names, and of a property as an attribute or an element."""
    outer = "|".join(sorted({re.escape(name.partition("/")[0]) for name in names if "/" in name})) or "(?!)"
    inner = "|".join(sorted({re.escape(name.rpartition("/")[2]) for name in names})) or "(?!)"
    structure = rf"<[\w.-]{{1,32}}:(?P<outer>{outer})\b(?:[^<>]{{0,512}}/>|.{{0,1024}}?</[\w.-]{{1,32}}:(?P=outer)>)"
    statement = (
        rf"[\s<](?P<prefix>[\w.-]{{1,32}}):(?P<name>{inner})\s{{0,64}}"
        r"(?:=\s{0,64}(?P<quote>[\"'])(?P<attribute>[^\"'<]{0,256})(?P=quote)|>(?P<element>[^<]{0,256})<)"
    )
    return re.compile(structure, re.DOTALL), re.compile(statement)


class _Reader:
    """Handlers that collect properties while expat parses."""

    def __init__(self) -> None:
        self.properties: Properties = {}
        self._open: list[tuple[str, str]] = []
        self._text: list[str] = []
        self._n_elements = 0
        self.parser = expat.ParserCreate(namespace_separator=" ")
        self.parser.buffer_text = True
        self.parser.StartDoctypeDeclHandler = self._refuse
        self.parser.EntityDeclHandler = self._refuse
        self.parser.StartElementHandler = self._start
        self.parser.EndElementHandler = self._end
        self.parser.CharacterDataHandler = self._characters

    def _refuse(self, *_: object) -> None:
        raise _RefusedError(_DECLARES)

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        self._n_elements += 1
        if self._n_elements > _MAX_ELEMENTS or len(self._open) >= _MAX_DEPTH:
            raise _RefusedError("its XMP is nested deeper, or longer, than a camera writes")
        self._open.append(_split(name))
        self._text.clear()
        for key, value in attributes.items():
            self._keep(_split(key), value)

    def _end(self, _: str) -> None:
        last = self._open.pop()
        self._keep(last, "".join(self._text))
        self._text.clear()

    def _characters(self, text: str) -> None:
        if len(self._text) < _MAX_TEXT:
            self._text.append(text[:_MAX_TEXT])

    def _keep(self, name: tuple[str, str], text: str) -> None:
        text = text.strip()
        if name[0] in (_RDF, _META, "") or not text or len(text) > _MAX_TEXT:
            return
        outer = [each for each in self._open if each[0] not in (_RDF, _META, "")]
        path = "/".join([*(each[1] for each in outer[-1:]), name[1]])
        self.properties.setdefault((name[0], path), []).append(text)


def _split(name: str) -> tuple[str, str]:
    space, _, local = name.rpartition(" ")
    return space.rstrip("/"), local
