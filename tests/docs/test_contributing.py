"""CONTRIBUTING.md names files, modules, tests and names that exist, and the limits of the house."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.skill.test_house import FUNCTION_LINES, MODULE_LINES, MODULES, SERVER_FLOORS
from vehanchor.records.ruler_registry import RULERS

TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
RECIPES = TEXT.partition("\n## Recipes\n")[2]
PACKAGES = ("research", "tests", "vehanchor", "vehanchor_server")
# Names of other projects, and files that a recipe makes.
OTHER_NAMES = {"Annotated", "Field", "None"}

_CODE = re.compile(r"`([^`]+)`")
_SUFFIX = re.compile(r"\.(?:csv|ipynb|json|md|onnx|py|toml|txt)$")


def codes(text: str) -> list[str]:
    """List the texts in backticks; line breaks are spaces."""
    return [" ".join(code.split()) for code in _CODE.findall(text)]


def missing_paths(text: str) -> list[str]:
    """List the paths that do not exist; of a path with a placeholder, its folder counts."""
    missing = []
    for code in codes(text):
        is_path = "/" in code or _SUFFIX.search(code)
        if not is_path or " " in code or code.startswith("["):
            continue
        path = Path(re.sub(r"<.*", "", code).rpartition("/")[0] if "<" in code else code)
        if "/" not in code and any((ROOT / "skill/vehanchor/models/bundled").glob(code)):
            continue
        if not (ROOT / path).exists():
            missing.append(code)
    return missing


def missing_modules(text: str) -> list[str]:
    """List the modules, alone or after ``python -m``, that do not exist."""
    missing = []
    for code in codes(text):
        name = code.removeprefix("python -m ").partition(" ")[0]
        if name.partition(".")[0] not in PACKAGES or "." not in name or "/" in name:
            continue
        if not _is_module(name):
            missing.append(name)
    return missing


def missing_names(text: str) -> list[str]:
    """List the names of code, such as classes and tests, that no file contains."""
    missing = []
    for code in codes(text):
        name = code.removesuffix("()").rpartition(".")[2]
        is_name = re.fullmatch(r"_?[A-Za-z]\w*", name) and "/" not in code
        # Words without capitals or underscores, such as "dev", also occur elsewhere.
        is_special = name.lower() != name or "_" in name
        if not is_name or not is_special or name in OTHER_NAMES or _SUFFIX.search(code):
            continue
        if not re.search(rf"\b{name}\b", SOURCES):
            missing.append(code)
    return missing


def misplaced_names(text: str) -> list[str]:
    """List the names that are not in the file after them, as in "`RULERS` in `registry.py`"."""
    misplaced = []
    for name, path in re.findall(r"`(\w+)`\s(?:in|of)\s`([^`<]+\.\w+)`", text):
        if not re.search(rf"\b{name}\b", (ROOT / path).read_text(encoding="utf-8")):
            misplaced.append(f"{name} in {path}")
    return misplaced


def _is_module(name: str) -> bool:
    try:
        return find_spec(name) is not None
    except ModuleNotFoundError:
        return False


SOURCES = "\n".join(
    path.read_text(encoding="utf-8")
    for folder in ("skill", "server", "research", "tests")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if path != Path(__file__)
)


def test_the_paths_of_the_recipes_exist() -> None:
    assert not missing_paths(RECIPES)


def test_the_modules_of_the_recipes_exist() -> None:
    assert not missing_modules(RECIPES)


def test_the_names_of_the_recipes_exist() -> None:
    assert not missing_names(RECIPES)


def test_the_names_of_the_recipes_are_in_the_files_after_them() -> None:
    assert not misplaced_names(RECIPES)


def test_a_name_that_moved_is_misplaced() -> None:
    text = "See `BUNDLED_MODELS` in\n`skill/vehanchor/models/zoo.py`, `load` of `tests/needs.py`."
    assert misplaced_names(text) == ["load in tests/needs.py"]


@pytest.mark.parametrize(
    "code",
    [
        "skill/vehanchor/records/gsd_estimates.py",
        "tests/skill/scale/test_length.py",
        "skill/vehanchor/ruler/<ruler>.py",
        "requirement/",
        "readme.md.md",
    ],
)
def test_a_renamed_path_is_missing(code: str) -> None:
    assert missing_paths(f"See `{code}`.") == [code]


@pytest.mark.parametrize("name", ["research.results.pages", "tests.record"])
def test_a_renamed_module_is_missing(name: str) -> None:
    assert missing_modules(f"Run `python -m {name} --record`.") == [name]


@pytest.mark.parametrize("name", ["BUNDLED_" + "NETWORKS", "Short" + "Field", "test_no_" + "rule"])
def test_a_renamed_class_or_test_is_missing(name: str) -> None:
    assert missing_names(f"See `{name}`.") == [name]


def test_the_recipes_name_many_files() -> None:
    paths = {code for code in codes(RECIPES) if "/" in code and " " not in code}
    assert len(paths) >= 60


def test_the_rules_state_the_limits_of_the_house() -> None:
    rules = f"- No module exceeds {MODULE_LINES} lines, no function {FUNCTION_LINES}."
    assert rules in TEXT


def _folders(package: str) -> set[str]:
    """Subpackages of a package."""
    names = {name.split(".")[1] for name in MODULES if name.startswith(f"{package}.")}
    root = MODULES[package].parent
    return {name for name in names if (root / name).is_dir()}


@pytest.mark.parametrize("package", ["vehanchor", "vehanchor_server"])
def test_the_tree_has_every_folder_of_a_package(package: str) -> None:
    tree = TEXT.partition("```text\n")[2].partition("```")[0]
    named = set(re.findall(r"\b(\w+)/", tree))
    assert _folders(package) <= named
    assert _folders("vehanchor_server") <= {room for rooms in SERVER_FLOORS for room in rooms}


def test_the_table_of_rulers_has_every_ruler() -> None:
    document = (ROOT / "docs/how-to/rulers.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \|", document, flags=re.MULTILINE)
    ours = [kind for kind, path in RULERS.items() if path.startswith("vehanchor.")]
    assert sorted(rows) == sorted(ours)
