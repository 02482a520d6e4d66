"""Processor features that make eight-bit models fast.

ONNX Runtime runs int8 models everywhere. They are faster than float32 only on processors with dot products of bytes:
VNNI on x86, and the dot products of Armv8.2. Linux lists these features, and all of Apple's own processors have them.
Other systems do not report them without an extra package.
"""

from __future__ import annotations

import platform
from functools import cache
from pathlib import Path

_CPU_INFO = Path("/proc/cpuinfo")
_FEATURES = frozenset({"avx512_vnni", "avx_vnni", "amx_int8", "asimddp"})  # Linux's names


def lists_byte_dot_products(cpu_info: str) -> bool:
    """Test whether the text of ``/proc/cpuinfo`` lists dot products of bytes."""
    for line in cpu_info.splitlines():
        name, _, listed = line.partition(":")
        if name.strip() in ("flags", "Features"):
            return not _FEATURES.isdisjoint(listed.split())
    return False


@cache
def has_byte_dot_products() -> bool:
    """Test whether this processor is known to have dot products of bytes."""
    system = platform.system()
    if system == "Darwin":
        return platform.machine() == "arm64"
    try:
        return system == "Linux" and lists_byte_dot_products(_CPU_INFO.read_text(encoding="utf-8", errors="replace"))
    except OSError:
        return False
