"""Product and laboratory stay apart."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.conftest import ROOT

MODULE_LINES, FUNCTION_LINES = 450, 60
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


@pytest.mark.parametrize("folder", ["skill", "server", "examples"])
def test_the_product_imports_no_research(folder: str) -> None:
    assert not _importers_of("research", sorted((ROOT / folder).rglob("*.py")))


@pytest.mark.parametrize("folder", ["docs", ".ci", "tests"])
@pytest.mark.parametrize("package", ["benchmarks", "paper", "results", "training"])
def test_only_scenes_are_used_elsewhere(folder: str, package: str) -> None:
    paths = [path for path in sorted((ROOT / folder).rglob("*.py")) if ROOT / "tests/research" not in path.parents]
    assert not _importers_of(f"research.{package}", paths)


def test_the_tests_of_training_import_the_research() -> None:
    assert _importers_of("research.training", sorted((ROOT / "tests/research").rglob("*.py")))


@pytest.mark.parametrize("folder", ["tests", "research/training"])
def test_nothing_imports_a_benchmark_but_another_benchmark(folder: str) -> None:
    assert not _importers_of("research.benchmarks", sorted((ROOT / folder).rglob("*.py")))


def test_the_research_keeps_the_limits_of_the_house() -> None:
    texts = {path: path.read_text(encoding="utf-8") for path in RESEARCH}
    assert not [path for path, text in texts.items() if len(text.splitlines()) > MODULE_LINES]
    assert not [
        f"{path}: {node.name}"
        for path, text in texts.items()
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        if (node.end_lineno or 0) - node.lineno + 1 > FUNCTION_LINES
    ]
