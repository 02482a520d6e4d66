"""Text of files that other programs write, such as spreadsheets and the consoles of Windows."""

from __future__ import annotations

_BYTE_ORDER_MARKS = (b"\xff\xfe", b"\xfe\xff")
# Encoding of programs in Western Europe, if a file is not UTF-8.
_OTHER_ENCODING = "cp1252"


def decoded(content: bytes) -> str:
    """Decode a file in UTF-8, UTF-16, or Windows-1252.

    Without a byte order mark, UTF-16 is recognised by the zero in its first character.

    Raises:
        UnicodeDecodeError: it is in none of them.
    """
    if content.startswith(_BYTE_ORDER_MARKS):
        return content.decode("utf-16")
    if content[:2].count(0) == 1:
        return content.decode("utf-16-be" if content[0] == 0 else "utf-16-le")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode(_OTHER_ENCODING)
