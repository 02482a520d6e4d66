"""Memory of processes that work on many photographs."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from vehanchor.analysis.heap import huge_pages_in_new_processes
from vehanchor.analysis.isolated_process import IsolatedProcess

if TYPE_CHECKING:
    from collections.abc import Callable

_VARIABLE = "GLIBC_TUNABLES"


def _prepare() -> Callable[[str, object], str | None]:
    return _variable


def _variable(name: str, _report: object) -> str | None:
    return os.environ.get(name)


def test_a_process_of_its_own_has_huge_pages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(_VARIABLE, raising=False)
    process = IsolatedProcess[str, "str | None"](_prepare, remedy="")
    process.start()
    try:
        assert process.run(_VARIABLE) == "glibc.malloc.hugetlb=1"
    finally:
        process.close()
    assert _VARIABLE not in os.environ


def test_the_settings_of_the_user_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(_VARIABLE, "glibc.malloc.check=3")
    with huge_pages_in_new_processes():
        assert os.environ[_VARIABLE] == "glibc.malloc.check=3"
    assert os.environ[_VARIABLE] == "glibc.malloc.check=3"
