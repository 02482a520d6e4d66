"""Interlaced films: frames that OpenCV reports as decoded, but cannot convert to pixels.

FFmpeg's converter refuses interlaced frames since version 8, and OpenCV 5 ignores that: it returns
what was in memory before, black or another picture, the same for all frames. Equal frames alone
prove nothing, because nothing may move. Either of two more signs proves it: the parameters of H.264
allow interlaced frames; or the coded frames hold much, and not the same. This was seen with MPEG-2,
MPEG-4 and DV, too.

The flag ``frame_mbs_only_flag`` stands in the sequence parameter set, ITU-T H.264, 7.3.2.1.1.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

# Profiles whose parameter set describes colours, too.
_PROFILES_WITH_COLOURS = frozenset({44, 83, 86, 100, 110, 118, 122, 128, 138, 244})
_SET_TYPE = 7
_MAX_SET_BYTES = 4096
# Bits of the longest number that a parameter set may have.
_MAX_NUMBER_BITS = 32
_FRAMES = 12
# FFV1 learns from the frames before, so that it writes equal frames with different bytes. Of the 21
# codecs that OpenCV's FFmpeg writes no other one does, for 14 equal frames of noise and of a smooth
# picture. FFV1 can be interlaced, too, and only its frames' headers say so.
_LEARNING_CODECS = frozenset(
    {
        int(cv2.VideoWriter.fourcc(*"FFV1")),
        int(cv2.VideoWriter.fourcc(*"ffv1")),
    }
)
# Least bytes of a coded frame that changes the picture before it. Frames in which nothing moves
# have some hundreds, or, if each is coded by itself, are equal. A choice.
_LEAST_CONTENT_BYTES = 1024

RAW = (int(cv2.CAP_PROP_FORMAT), -1)
"""Parameters of ``cv2.VideoCapture`` that open a film without decoding."""


def returns_no_frames(film: cv2.VideoCapture, raw_film: cv2.VideoCapture) -> bool:
    """Test whether a film is interlaced and its first frames are all the same.

    Args:
        film: the film at its beginning; it is read.
        raw_film: the same film, opened without decoding (``RAW``).
    """
    first = None
    for _ in range(_FRAMES):
        is_readable, frame = film.read()
        if not is_readable:
            continue
        if first is None:
            first = frame.copy()
        elif not np.array_equal(first, frame):
            return False
    if first is None:
        return False
    if _allows_interlaced(_extra_data(raw_film)):
        return True
    if int(film.get(cv2.CAP_PROP_FOURCC)) in _LEARNING_CODECS:
        return False
    return _have_content(_packets(raw_film))


def _packets(raw_film: cv2.VideoCapture) -> list[bytes]:
    """Read the first coded frames of a film."""
    packets = []
    for _ in range(_FRAMES):
        is_readable, packet = raw_film.read()
        if is_readable and packet is not None:
            packets.append(np.asarray(packet, np.uint8).tobytes())
    return packets


def _have_content(packets: Sequence[bytes]) -> bool:
    """Test whether coded frames change the picture from one to the next."""
    with_content = {packet for packet in packets if len(packet) >= _LEAST_CONTENT_BYTES}
    return len(with_content) > 1


def _extra_data(raw_film: cv2.VideoCapture) -> bytes:
    """Read the parameter sets of a film's codec; empty if there are none."""
    index = raw_film.get(cv2.CAP_PROP_CODEC_EXTRADATA_INDEX)
    if index <= 0:
        return b""
    is_readable, block = raw_film.retrieve(None, int(index))
    if not is_readable or block is None:
        return b""
    return np.asarray(block, np.uint8).tobytes()


def _allows_interlaced(extra_data: bytes) -> bool:
    """Test whether the parameter set of an H.264 film allows interlaced frames.

    Args:
        extra_data: an ``avcC`` record (ISO 14496-15) or units with start codes (Annex B).
    """
    parameters = _parameter_set(extra_data[:_MAX_SET_BYTES])
    if parameters is None:
        return False
    try:
        return not _has_only_frames(_Bits(parameters))
    except IndexError:  # truncated
        return False


def _parameter_set(extra_data: bytes) -> bytes | None:
    """Find the first sequence parameter set, without its first byte; None without one."""
    if extra_data[:1] == b"\x01":
        # Six bytes of the record and two of the length come before the set.
        unit = extra_data[8:]
    else:
        _, _, unit = extra_data.partition(b"\0\0\1")
    if not unit or unit[0] & 0x1F != _SET_TYPE:
        return None
    return unit[1:].replace(b"\0\0\3", b"\0\0")


class _Bits:
    """Reader of bits; it raises ``IndexError`` at the end."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._position = 0

    def flag(self) -> int:
        """Read one bit."""
        byte = self._data[self._position // 8]
        bit = byte >> (7 - self._position % 8) & 1
        self._position += 1
        return bit

    def skip(self, n_bits: int) -> None:
        """Skip bits."""
        self._position += n_bits

    def number(self) -> int:
        """Read an Exp-Golomb number; for one with a sign, the result has no meaning."""
        n_zeros = 0
        while not self.flag():
            n_zeros += 1
            if n_zeros > _MAX_NUMBER_BITS:
                raise IndexError
        value = 1
        for _ in range(n_zeros):
            value = 2 * value + self.flag()
        return value - 1


def _has_only_frames(bits: _Bits) -> bool:
    """Read ``frame_mbs_only_flag`` of a sequence parameter set."""
    profile = 0
    for _ in range(8):
        profile = 2 * profile + bits.flag()
    bits.skip(16)  # constraints and level
    bits.number()  # seq_parameter_set_id
    if profile in _PROFILES_WITH_COLOURS:
        _skip_colours(bits)
    bits.number()  # log2_max_frame_num_minus4
    order_type = bits.number()
    if order_type == 0:
        bits.number()  # log2_max_pic_order_cnt_lsb_minus4
    elif order_type == 1:
        bits.skip(1)
        bits.number()
        bits.number()
        for _ in range(min(bits.number(), 255)):
            bits.number()
    bits.number()  # max_num_ref_frames
    bits.skip(1)
    bits.number()  # width
    bits.number()  # height
    return bool(bits.flag())


def _skip_colours(bits: _Bits) -> None:
    """Skip the description of colours.

    Raises:
        IndexError: scaling lists, which no camera writes, are not read.
    """
    chroma_format = bits.number()
    if chroma_format == 3:
        bits.skip(1)
    bits.number()  # bit_depth_luma_minus8
    bits.number()  # bit_depth_chroma_minus8
    bits.skip(1)
    has_scaling_lists = bits.flag()
    if has_scaling_lists:
        raise IndexError
