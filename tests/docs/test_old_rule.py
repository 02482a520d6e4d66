"""Nothing but the published method acts on a confidence of 0.5: a scale is usable from a chance of 0.9 on."""

from __future__ import annotations

import re
import subprocess

import pytest

from tests.conftest import ROOT

FOLDERS = ("skill", "server", "examples", "docs", "schemas", "README.md", "CONTRIBUTING.md")
OLD_RULE = re.compile(
    r"""
    confidence\W{0,6}(<|>=?|&[lg]t;=?|\u2265)\s*0?\.5(?!\d)
    | \b([Bb]elow|[Uu]nder|[Aa]t\ least)\ 0\.5(?!\d)
    | confidence\ of\ 0\.5(?!\d)
    | \b0\.5\ (and|or)\ more\b
    | (FALLBACK|UNSURE)_CONFIDENCE
    | p_within_20
    """,
    re.VERBOSE,
)
ALLOWED = {
    "skill/vehanchor/scale/paper.py": "",
    "docs/concepts.md": "than five cars it stays below 0.5",
}
"""By file, a part of each line that may name the rule: it is about the preset ``paper``."""


def _texts() -> dict[str, str]:
    listed = subprocess.run(["git", "ls-files", "-co", "--exclude-standard", *FOLDERS], cwd=ROOT, capture_output=True)
    names = listed.stdout.decode().splitlines()
    assert len(names) > 300
    found = {}
    for name in names:
        try:
            found[name] = (ROOT / name).read_text(encoding="utf-8")
        except (UnicodeDecodeError, FileNotFoundError):
            continue
    return found


def test_nothing_acts_on_the_old_rule() -> None:
    left = [
        f"{name}:{number}: {line.strip()[:160]}"
        for name, text in _texts().items()
        for number, line in enumerate(text.splitlines(), 1)
        if OLD_RULE.search(line) and not (name in ALLOWED and ALLOWED[name] in line)
    ]
    assert not left, "\n".join(left)


@pytest.mark.parametrize(
    ("line", "old"),
    [
        ("if (record.confidence < 0.5) {", True),
        ("| `status` | `ok` (confidence >= 0.5)", True),
        ("confidence &lt; 0.5", True),
        ("Below 0.5 use another source", True),
        ("a confidence below 0.55", False),
        ("confidence >= 0.9", False),
        ("their scores are 0.5 to 0.7", False),
    ],
)
def test_the_old_rule_is_recognised(line: str, old: bool) -> None:
    assert bool(OLD_RULE.search(line)) is old
