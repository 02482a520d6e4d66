"""Which processors are quick with eight bits, by what the system says of them."""

from __future__ import annotations

import platform
from typing import TYPE_CHECKING

import pytest

from vehanchor.models import precision
from vehanchor.models.precision import has_byte_dot_products, lists_byte_dot_products

if TYPE_CHECKING:
    from pathlib import Path

_XEON = "processor\t: 0\nmodel name\t: Intel(R) Xeon(R)\nflags\t\t: fpu sse avx512f avx512_vnni\n\nprocessor\t: 1\n"
_OLD = "processor\t: 0\nflags\t\t: fpu sse avx2 avx512f\nvmx flags\t: avx512_vnni\n"
_GRAVITON = "processor\t: 0\nBogoMIPS\t: 243.75\nFeatures\t: fp asimd asimddp\n"


@pytest.mark.parametrize(("text", "has"), [(_XEON, True), (_OLD, False), (_GRAVITON, True), ("", False)])
def test_linux_names_dot_products_among_a_processors_features(text: str, has: bool) -> None:
    assert lists_byte_dot_products(text) is has


@pytest.mark.parametrize(("system", "machine", "has"), [("Darwin", "arm64", True), ("Darwin", "x86_64", False)])
def test_apples_own_processors_have_them(monkeypatch: pytest.MonkeyPatch, system: str, machine: str, has: bool) -> None:
    monkeypatch.setattr(platform, "system", lambda: system)
    monkeypatch.setattr(platform, "machine", lambda: machine)
    assert has_byte_dot_products.__wrapped__() is has


def test_where_nothing_tells_there_are_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(platform, "system", lambda: "Linux")
    monkeypatch.setattr(precision, "_CPU_INFO", tmp_path / "absent")
    assert has_byte_dot_products.__wrapped__() is False
    monkeypatch.setattr(platform, "system", lambda: "Windows")
    assert has_byte_dot_products.__wrapped__() is False
