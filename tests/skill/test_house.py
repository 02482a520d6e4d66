"""The house rules: imports between rooms, parts that can be taken away, and lengths.

Product and laboratory stay apart: what a user installs imports no research.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from itertools import product
from pathlib import Path
from typing import NamedTuple

import hypothesis
import pytest

from tests.conftest import ROOT

MODULE_LINES = 600
FUNCTION_LINES = 80


class Shape(NamedTuple):
    """Limits on the rooms of a package: its subpackages, and its modules outside of these.

    Attributes:
        floors: longest chain of rooms that import each other.
        arrows: imports from one room to another; a new one needs a reason.
        root_modules: modules outside subpackages.
    """

    floors: int
    arrows: int
    root_modules: int


SHAPES = {
    # Images, detections, rulers and scales need one logistic function: ``odds`` is in no room.
    "vehanchor": Shape(floors=14, arrows=116, root_modules=4),
    "vehanchor_server": Shape(floors=9, arrows=48, root_modules=10),
}
# The rooms of the server, from the ground up: a room imports only rooms of lower floors.
SERVER_FLOORS = (
    ("errors", "base_model", "settings", "request_log"),
    ("images", "sandbox", "app_page", "models"),
    ("resources",),
    ("calls",),
    ("services",),
    ("tools",),
    ("app", "schemas"),
    ("transport",),
    ("command",),
)
LABORATORY = ("benchmarks", "paper", "results", "training")  # tests may use the scenes
FOLDERS = (ROOT / "skill", ROOT / "server")
COMMANDS = (
    "vehanchor.cli",
    "vehanchor_evaluation.commands",
    "vehanchor_flight.commands",
    "vehanchor_server.command",
)
# Modules that a package never imports, not even inside a function.
FORBIDDEN = {
    "vehanchor": (
        "vehanchor_flight",
        "vehanchor_evaluation",
        "vehanchor_server",
        "mcp",
        "starlette",
    ),
    "vehanchor_flight": ("vehanchor_evaluation", "vehanchor_server", "mcp"),
    "vehanchor_evaluation": ("vehanchor_flight", "vehanchor_server", "mcp"),
    "vehanchor_server": ("vehanchor_evaluation", "vehanchor.cli"),
}


def _modules() -> dict[str, Path]:
    """The modules of library and server, by name."""
    modules = {}
    for folder in FOLDERS:
        for path in sorted(folder.rglob("*.py")):
            parts = path.relative_to(folder).with_suffix("").parts
            if parts[-1] == "__init__":
                parts = parts[:-1]
            modules[".".join(parts)] = path
    return modules


MODULES = _modules()


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _trees() -> dict[str, ast.Module]:
    """The modules of library and server, parsed."""
    return {name: _tree(path) for name, path in MODULES.items()}


def _research() -> list[Path]:
    return sorted((ROOT / "research").rglob("*.py"))


def _below(name: str, package: str) -> bool:
    return name == package or name.startswith(f"{package}.")


def _is_below_any(name: str, packages: Iterable[str]) -> bool:
    return any(_below(name, package) for package in packages)


def _imported(tree: ast.Module) -> set[str]:
    """What a module imports anywhere: at its top, for types only, or inside a function."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            source = node.module or ""
            for alias in node.names:
                member = f"{source}.{alias.name}"
                names.add(member if member in MODULES else source)
    return names


@cache
def _imports() -> dict[str, set[str]]:
    """What each module of library and server imports."""
    return {name: _imported(tree) for name, tree in _trees().items()}


def _room(name: str) -> str:
    """Subpackage, or module outside of these, to which a module belongs."""
    return ".".join(name.split(".")[:2])


def _rooms(package: str) -> dict[str, set[str]]:
    """The rooms of a package, each with those that it imports."""
    members = [name for name in MODULES if _below(name, package)]
    rooms: dict[str, set[str]] = {_room(name): set() for name in members}
    for name in members:
        imported = {_room(module) for module in _imports()[name] if module in members}
        rooms[_room(name)] |= imported - {_room(name)}
    return rooms


def _functions(tree: ast.Module) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    return (
        node for node in ast.walk(tree) if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
    )


def test_no_import_is_relative() -> None:
    nodes = (
        (name, node)
        for name, tree in _trees().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom)
    )
    assert not [name for name, node in nodes if node.level]


def test_no_import_comes_back_to_where_it_began() -> None:
    graph = {name: imported & MODULES.keys() for name, imported in _imports().items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def _floors(package: str) -> dict[str, int]:
    """The floor of each room: one above the highest that it imports; fail on a circle."""
    rooms = _rooms(package)
    floors: dict[str, int] = {}
    try:
        for room in TopologicalSorter(rooms).static_order():
            floors[room] = 1 + max((floors[imported] for imported in rooms[room]), default=0)
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))
    return floors


@pytest.mark.parametrize("package", SHAPES)
def test_rooms_form_no_circle_and_few_floors(package: str) -> None:
    floors = _floors(package)
    highest_first = sorted(floors.items(), key=lambda room: room[1], reverse=True)
    assert max(floors.values()) <= SHAPES[package].floors, highest_first


@pytest.mark.parametrize("package", SHAPES)
def test_few_rooms_import_each_other(package: str) -> None:
    arrows = sorted((room, other) for room, others in _rooms(package).items() for other in others)
    assert len(arrows) <= SHAPES[package].arrows, arrows


@pytest.mark.parametrize("package", SHAPES)
def test_few_modules_lie_outside_subpackages(package: str) -> None:
    loose = [
        room for room in _rooms(package) if room != package and MODULES[room].name != "__init__.py"
    ]
    assert len(loose) <= SHAPES[package].root_modules, loose


def test_no_import_of_the_server_points_upward() -> None:
    floors = {
        f"vehanchor_server.{room}": floor
        for floor, rooms in enumerate(SERVER_FLOORS)
        for room in rooms
    }
    rooms = _rooms("vehanchor_server")
    assert rooms.keys() - {"vehanchor_server"} == floors.keys()
    upward = [
        f"{room} imports {imported}"
        for room, floor in floors.items()
        for imported in rooms[room]
        if floors[imported] >= floor
    ]
    assert not upward


@pytest.mark.parametrize("package", FORBIDDEN)
def test_a_package_imports_only_what_it_may(package: str) -> None:
    offences = []
    for name in MODULES:
        if not _below(name, package) or _is_below_any(name, COMMANDS[1:]):
            continue
        for imported in _imports()[name]:
            if _is_below_any(imported, FORBIDDEN[package]):
                offences.append(f"{name} imports {imported}")
    assert not offences


def test_only_commands_import_the_command_line() -> None:
    offences = []
    for name in MODULES:
        if _is_below_any(name, (*COMMANDS, "vehanchor.__main__")):
            continue
        if any(_is_below_any(module, ("vehanchor.cli", "typer")) for module in _imports()[name]):
            offences.append(name)
    assert not offences


@pytest.mark.parametrize(
    ("folder", "laboratories"),
    [
        *product(("skill", "server", "examples"), (("research",),)),
        *product(("docs", ".ci", "tests"), (tuple(f"research.{name}" for name in LABORATORY),)),
        ("research/training", ("research.benchmarks",)),
    ],
)
def test_the_product_imports_no_research_and_its_tests_only_scenes(
    folder: str, laboratories: tuple[str, ...]
) -> None:
    offences = []
    for path in (ROOT / folder).rglob("*.py"):
        if ROOT / "tests/research" in path.parents:
            continue
        if any(_is_below_any(module, laboratories) for module in _imported(_tree(path))):
            offences.append(path)
    assert not offences


def test_no_module_is_too_long_to_be_read_at_once() -> None:
    lengths = {
        path: len(path.read_text(encoding="utf-8").splitlines())
        for path in (*MODULES.values(), *_research())
    }
    assert not {path: lines for path, lines in lengths.items() if lines > MODULE_LINES}


def test_every_function_fits_a_screen() -> None:
    lengths = {
        f"{path}: {function.name}": (function.end_lineno or 0) - function.lineno + 1
        for path in (*MODULES.values(), *_research())
        for function in _functions(_tree(path))
    }
    assert not {name: lines for name, lines in lengths.items() if lines > FUNCTION_LINES}


def test_no_module_is_a_drawer_for_odds_and_ends() -> None:
    assert not [
        name
        for name in MODULES
        if name.rpartition(".")[2] in {"utils", "util", "common", "helpers", "misc"}
    ]


def test_importing_the_library_loads_nothing_else() -> None:
    code = "import sys, vehanchor; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, check=True, text=True
    ).stdout.split()
    others = (
        "vehanchor.cli",
        "vehanchor_flight",
        "vehanchor_evaluation",
        "vehanchor_server",
        "typer",
        "mcp",
        "numpy",
    )
    assert not [name for name in loaded if _is_below_any(name, others)]


TAKE_AWAY = """
import importlib, sys

away, modules = sys.argv[1], sys.argv[2:]

class Away:
    def find_spec(self, name, path=None, target=None):
        if name == away or name.startswith(away + "."):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Away())
for module in modules:
    importlib.import_module(module)

import numpy as np
import vehanchor

assert vehanchor.estimate_gsd(np.zeros((64, 64, 3), dtype=np.uint8)).status == "no_scale"
if away != "vehanchor.cli":
    from vehanchor.cli.app import main

    sys.argv = ["vehanchor", "--help"]
    main()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "away", ["vehanchor_flight", "vehanchor_evaluation", "vehanchor_server", "vehanchor.cli"]
)
def test_the_rest_works_without(away: str) -> None:
    gone = COMMANDS if away == "vehanchor.cli" else (away,)
    rest = [name for name in MODULES if not _is_below_any(name, (*gone, "vehanchor.__main__"))]
    assert len(rest) > 50
    done = subprocess.run(
        [sys.executable, "-c", TAKE_AWAY, away, *rest],
        capture_output=True,
        check=False,
        text=True,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    if away != "vehanchor.cli":
        brings = {
            "vehanchor_flight": "flight",
            "vehanchor_evaluation": "calibrate",
            "vehanchor_server": "serve",
        }
        shown = {line.split()[1] for line in done.stdout.splitlines() if len(line.split()) > 1}
        assert "estimate" in shown
        assert brings.pop(away) not in shown
        assert set(brings.values()) <= shown


def test_no_property_is_held_to_a_deadline() -> None:
    assert hypothesis.settings.default is not None
    assert hypothesis.settings.default.deadline is None
