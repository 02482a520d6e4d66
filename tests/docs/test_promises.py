"""Each sentence of SECURITY.md that promises something names a test that exists."""

from __future__ import annotations

import re
from functools import cache

import pytest

from tests.conftest import ROOT

_TEXT, _, _TESTS = (ROOT / "SECURITY.md").read_text(encoding="utf-8").partition("\n## Tests\n")
_NOTE = re.compile(r"^\[\^([a-z-]+)\]: (.+)$", re.MULTILINE)
_NOTES = dict(_NOTE.findall(_TESTS))


@cache
def _functions() -> frozenset[str]:
    """Names of all tests."""
    texts = (file.read_text(encoding="utf-8") for file in (ROOT / "tests").rglob("test_*.py"))
    return frozenset(name for text in texts for name in re.findall(r"def (test_\w+)\(", text))


def _passages() -> list[str]:
    """The protections of the table, and the rules of paths and workers, each on one line."""
    table = [line.split("|")[2].strip() for line in _TEXT.splitlines() if line.startswith("| ")][1:]
    rules = re.findall(r"### (?:Paths|Workers)\n(.+?)\nLimitations?:", _TEXT, flags=re.DOTALL)
    bullets = [bullet for text in rules for bullet in re.split(r"\n- ", text)[1:]]
    return [" ".join(each.split()) for each in table + bullets]


def sentences(passage: str) -> list[str]:
    """Split a passage into sentences with their notes."""
    return [each.strip() for each in re.split(r"(?<=\.|\])\s+(?=[A-Z`])(?![^(]*\))", passage) if each.strip()]


def test_there_are_passages_to_check() -> None:
    assert len(_passages()) >= 25
    assert len(_NOTES) >= 50


@pytest.mark.parametrize("passage", _passages(), ids=lambda passage: passage[:40])
def test_every_promise_names_a_test(passage: str) -> None:
    assert re.search(r"\[\^[a-z-]+\]", passage), "no promise of it is tested"
    promises = [each for each in sentences(passage) if not re.search(r"\[\^[a-z-]+\]$", each)]
    assert not promises


def test_every_named_test_exists() -> None:
    used = set(re.findall(r"\[\^([a-z-]+)\]", _TEXT))
    assert used == set(_NOTES)
    named = {test for note in _NOTES.values() for test in re.findall(r"`(test_\w+)`", note)}
    assert named
    assert not named - _functions()
