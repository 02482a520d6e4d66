"""Text of files that other programs write, such as spreadsheets and the consoles of Windows."""

from __future__ import annotations

# The marks of UTF-32 go first, because one of them begins with that of UTF-16.
_BYTE_ORDER_MARKS = {
    b"\xff\xfe\0\0": "utf-32",
    b"\0\0\xfe\xff": "utf-32",
    b"\xff\xfe": "utf-16",
    b"\xfe\xff": "utf-16",
}
# Encodings without a mark, by which of the first four bytes are zero: a first letter of ASCII.
_ZEROS = {
    (False, True, True, True): "utf-32-le",
    (True, True, True, False): "utf-32-be",
    (False, True, False, True): "utf-16-le",
    (True, False, True, False): "utf-16-be",
}
# Encoding of programs in Western Europe, if a file is not UTF-8.
_OTHER_ENCODING = "cp1252"


def decoded(content: bytes) -> str:
    """Decode a file in UTF-8, UTF-16, UTF-32, or Windows-1252.

    Without a byte order mark, UTF-16 and UTF-32 are recognised by the zeros in their first
    characters.

    Raises:
        UnicodeDecodeError: it is in none of them.
    """
    for mark, encoding in _BYTE_ORDER_MARKS.items():
        if content.startswith(mark):
            return content.decode(encoding)
    zeros = tuple(byte == 0 for byte in content[:4])
    if zeros in _ZEROS:
        return content.decode(_ZEROS[zeros])
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode(_OTHER_ENCODING)
