"""Product and laboratory stay apart."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.conftest import ROOT

MODULE_LINES = 450
RESEARCH = sorted((ROOT / "research").rglob("*.py"))


def _imported(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def _importers_of(package: str, paths: list[Path]) -> list[str]:
    return [
        path.relative_to(ROOT).as_posix()
        for path in paths
        if any(name == package or name.startswith(f"{package}.") for name in _imported(path))
    ]


@pytest.mark.parametrize("folder", ["skill", "server", "examples", "docs", ".ci", "tests"])
def test_nothing_outside_imports_the_research(folder: str) -> None:
    paths = [path for path in sorted((ROOT / folder).rglob("*.py")) if ROOT / "tests/research" not in path.parents]
    assert not _importers_of("research", paths)


def test_the_tests_of_training_import_the_research() -> None:
    assert _importers_of("research.training", sorted((ROOT / "tests/research").rglob("*.py")))


@pytest.mark.parametrize("folder", ["tests", "research/training"])
def test_nothing_imports_a_benchmark_but_another_benchmark(folder: str) -> None:
    assert not _importers_of("research.benchmarks", sorted((ROOT / folder).rglob("*.py")))


def test_no_module_of_the_research_is_too_long_to_be_read_at_once() -> None:
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in RESEARCH}
    assert not {path: lines for path, lines in lengths.items() if lines > MODULE_LINES}
