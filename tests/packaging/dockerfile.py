"""Reads our Dockerfile: stages of instructions, continued lines joined, comments left out."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Instruction:
    """One instruction: its keyword, flags such as ``--from=build`` and the rest of the line."""

    keyword: str
    flags: tuple[str, ...]
    text: str

    @property
    def words(self) -> list[str]:
        """The words of an exec form (``["a", "b"]``) or of a plain line."""
        return list(json.loads(self.text)) if self.text.startswith("[") else shlex.split(self.text)


@dataclass
class Stage:
    """The instructions after one FROM."""

    base: str
    name: str | None
    instructions: list[Instruction] = field(default_factory=list)

    def all(self, keyword: str) -> list[Instruction]:
        """The instructions with this keyword."""
        return [instruction for instruction in self.instructions if instruction.keyword == keyword]

    def last(self, keyword: str) -> Instruction:
        """The one that counts where a later one replaces an earlier one."""
        return self.all(keyword)[-1]

    @property
    def environment(self) -> dict[str, str]:
        """What its ENV instructions set."""
        return dict(word.split("=", 1) for instruction in self.all("ENV") for word in instruction.words)


def read_dockerfile(path: Path) -> list[Stage]:
    """The stages of a Dockerfile."""
    text = re.sub(r"^\s*#.*\n", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    stages: list[Stage] = []
    for line in text.replace("\\\n", " ").splitlines():
        if not line.strip():
            continue
        keyword, rest = line.strip().split(None, 1)
        if keyword == "FROM":
            base, *name = rest.split()
            stages.append(Stage(base, name[1] if name else None))
            continue
        flags = re.match(r"(?:--\S+\s+)*", rest)
        assert flags is not None
        given = flags.group().split()
        stages[-1].instructions.append(Instruction(keyword, tuple(given), rest[flags.end() :].strip()))
    return stages
