"""Simple properties of an XMP packet, read from untrusted bytes.

Expat parses the packet. A document type or an entity ends the parsing; depth, elements and lengths are bounded.
"""

from __future__ import annotations

from typing import NamedTuple
from xml.parsers import expat

from vehanchor.imagery.metadata.blocks import MAX_XMP_BYTES

_MAX_DEPTH, _MAX_ELEMENTS, _MAX_TEXT = 32, 4096, 256
_RDF = "http://www.w3.org/1999/02/22-rdf-syntax-ns#"
_META = "adobe:ns:meta/"


class XmpPacket(NamedTuple):
    """Properties of a packet.

    Attributes:
        properties: text by namespace and name; a field of a structure is named ``Structure/Field``.
        refused: why the packet was refused, as a clause; empty if it was read or is merely damaged.
    """

    properties: dict[tuple[str, str], str]
    refused: str = ""


class _RefusedError(Exception):
    """The packet holds something that no camera writes."""


def read_xmp(packet: bytes) -> XmpPacket:
    """Read a packet's properties; none if it is damaged or refused.

    Args:
        packet: bytes from ``<?xpacket`` or ``<x:xmpmeta`` on.
    """
    if len(packet) > MAX_XMP_BYTES:
        return XmpPacket({}, f"its XMP has {len(packet)} bytes")
    reader = _Reader()
    try:
        reader.parser.Parse(packet.strip(b"\0 \r\n\t"), True)
    except _RefusedError as error:
        return XmpPacket({}, str(error))
    except (expat.ExpatError, LookupError, ValueError):  # not XML, or an unknown encoding
        return XmpPacket({})
    return XmpPacket(reader.properties)


class _Reader:
    """Handlers that collect properties while expat parses."""

    def __init__(self) -> None:
        self.properties: dict[tuple[str, str], str] = {}
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
        raise _RefusedError("its XMP declares a document type or entities, which no camera writes")

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
        self.properties.setdefault((name[0], path), text)


def _split(name: str) -> tuple[str, str]:
    space, _, local = name.rpartition(" ")
    return space, local
