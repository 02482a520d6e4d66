"""The Markdown that users read, and the code in it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from tests.conftest import ROOT

DOCUMENTS = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    ROOT / "SECURITY.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]

# Why a block is not run here. Readers see the reason in its title.
REASONS = {
    "installs",
    "needs Docker",
    "needs Kubernetes",
    "needs Ray",
    "needs files of your own",
    "needs pipx and uvx",
    "needs ultralytics",
    "runs the tests",
    "runs until it is stopped",
}

_FENCE = re.compile(r'^```(\w+)(?: title="([^"]*)")?\n(.*?)^```$', flags=re.DOTALL | re.MULTILINE)


@dataclass(frozen=True)
class Block:
    """Fenced block of a document."""

    language: str
    reason: str | None
    text: str

    @property
    def commands(self) -> list[str]:
        """Return the commands of a console block: lines after ``$``, split at ``&&``."""
        lines = [line[2:] for line in self.text.splitlines() if line.startswith("$ ")]
        return [part.strip() for line in lines for part in line.split("&&")]


def blocks(document: Path) -> list[Block]:
    """Return all fenced blocks of a document, in order."""
    text = document.read_text(encoding="utf-8")
    fenced = [Block(match[1], match[2], match[3]) for match in _FENCE.finditer(text)]
    assert text.count("```") == 2 * len(fenced), f"{document}: a fence of another form"
    return fenced
