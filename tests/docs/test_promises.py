"""SECURITY.md promises what tests hold, and nothing else."""

from __future__ import annotations

import re

from tests.conftest import ROOT

_TEXT = (ROOT / "SECURITY.md").read_text(encoding="utf-8")
MAX_WORDS = 600


def test_each_promise_has_a_test_that_names_it_and_no_test_names_another() -> None:
    promised = re.findall(r"^- \*\*([a-z-]+)\*\*: ", _TEXT.partition("## Promises")[2], flags=re.MULTILINE)
    texts = [file.read_text(encoding="utf-8") for file in (ROOT / "tests").rglob("test_*.py")]
    kept = {name for text in texts for name in re.findall(r"mark\.promise\(\"([a-z-]+)\"\)", text)}
    assert sorted(promised) == sorted(kept)


def test_every_line_of_the_promises_is_one() -> None:
    section = _TEXT.partition("## Promises")[2].partition("## Limits")[0]
    lines = re.findall(r"^- .*", section, flags=re.MULTILINE)
    assert all(re.match(r"- \*\*[a-z-]+\*\*: ", line) for line in lines)
    assert len(lines) > 25


def test_the_notes_are_short_enough_to_be_read() -> None:
    assert len(_TEXT.split()) <= MAX_WORDS
