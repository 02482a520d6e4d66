"""What keeps the suite honest: quick tests read no clock, and CI misses no program."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from tests.conftest import (
    LONGER,
    ROOT,
    has_marker,
    pytest_collection_modifyitems,
)
from tests.needs import needed_module, needed_program

CLOCKS = {"monotonic", "perf_counter", "process_time", "time", "thread_time"}


def _marks(nodes: list[ast.expr]) -> set[str]:
    return {
        each.attr for node in nodes for each in ast.walk(node) if isinstance(each, ast.Attribute)
    }


def _quick_tests(tree: ast.Module) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    """The test functions that a plain ``pytest`` runs."""
    tests = [node for node in tree.body if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    of_all = [
        node.value
        for node in tree.body
        if isinstance(node, ast.Assign)
        and any(isinstance(t, ast.Name) and t.id == "pytestmark" for t in node.targets)
    ]
    return [
        test
        for test in tests
        if test.name.startswith("test_") and not _marks([*of_all, *test.decorator_list]) & LONGER
    ]


def _reads_a_clock(node: ast.AST) -> bool:
    return any(
        isinstance(each, ast.Call)
        and isinstance(each.func, ast.Attribute)
        and isinstance(each.func.value, ast.Name)
        and (each.func.value.id, each.func.attr) in {("time", clock) for clock in CLOCKS}
        for each in ast.walk(node)
    )


def _timed(source: str) -> list[str]:
    """The quick tests that read a clock."""
    return [test.name for test in _quick_tests(ast.parse(source)) if _reads_a_clock(test)]


def test_no_quick_test_reads_a_clock() -> None:
    timed = {
        str(path.relative_to(ROOT)): _timed(path.read_text(encoding="utf-8"))
        for path in _test_files()
    }
    assert not {path: names for path, names in timed.items() if names}


def _test_files() -> list[Path]:
    return sorted((ROOT / "tests").rglob("test_*.py"))


@pytest.mark.parametrize(
    ("file", "marker", "named"),
    [
        ("packaging/test_nginx.py", "nginx", True),
        ("packaging/test_nginx.py", "slow", False),
        ("skill/records/test_interop.py", "slow", True),  # by the cases of tests.records
    ],
)
def test_a_file_names_its_markers_or_the_module_that_sets_them(
    file: str, marker: str, named: bool
) -> None:
    assert has_marker(ROOT / "tests" / file, marker) is named


def test_a_marker_that_its_file_does_not_name_is_refused(request: pytest.FixtureRequest) -> None:
    item = request.node
    item.add_marker("qgis")
    with pytest.raises(pytest.UsageError, match="is marked qgis"):
        pytest_collection_modifyitems([item])


PROGRAM = "a-program-that-nobody-has"


@pytest.mark.parametrize(
    ("ci", "without", "outcome"),
    [
        (None, None, pytest.skip.Exception),
        ("true", None, pytest.fail.Exception),
        ("true", "another", pytest.fail.Exception),
        ("true", f"another {PROGRAM}", pytest.skip.Exception),
    ],
)
def test_a_missing_program_skips_here_and_fails_in_ci_unless_it_is_excused(
    monkeypatch: pytest.MonkeyPatch,
    ci: str | None,
    without: str | None,
    outcome: type[BaseException],
) -> None:
    for name, value in (("CI", ci), ("VEHANCHOR_CI_WITHOUT", without)):
        if value is None:
            monkeypatch.delenv(name, raising=False)
        else:
            monkeypatch.setenv(name, value)
    with pytest.raises(outcome, match=PROGRAM):
        needed_program(PROGRAM, "build it")
    with pytest.raises(outcome, match=PROGRAM):
        needed_module(f"{PROGRAM}.part", "build it")
