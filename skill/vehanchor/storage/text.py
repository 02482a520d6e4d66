"""Text of files that other programs write, such as spreadsheets and the consoles of Windows."""

from __future__ import annotations

_BYTE_ORDER_MARKS = (b"\xff\xfe", b"\xfe\xff")
# Encoding of programs in Western Europe, if a file is not UTF-8.
_OTHER_ENCODING = "cp1252"


def decoded(content: bytes) -> str:
    """Decode a file in UTF-8, UTF-16 with a byte order mark, or Windows-1252.

    Raises:
        UnicodeDecodeError: it is in none of them.
    """
    if content.startswith(_BYTE_ORDER_MARKS):
        return content.decode("utf-16")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode(_OTHER_ENCODING)
