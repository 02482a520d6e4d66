"""Recipes for other programs call them as their installed packages say; nothing is imported."""

from __future__ import annotations

import ast
import sysconfig
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.docs.documents import blocks
from tests.needs import environment

pytestmark = [pytest.mark.frameworks, pytest.mark.timeout(600)]

PAGE = ROOT / "docs" / "how-to" / "resample.md"
# Calls of the page: file of the package, class, and method; of a dataclass, its fields.
CALLS = {
    "load_model": ("deepforest/main.py", "deepforest", "load_model"),
    "predict_tile": ("deepforest/main.py", "deepforest", "predict_tile"),
    "BuildingFootprintExtractor": ("geoai/extract.py", "BuildingFootprintExtractor", "__init__"),
    "process_raster": ("geoai/extract.py", "ObjectDetector", "process_raster"),
    "SpeedEstimator": ("ultralytics/solutions/config.py", "SolutionConfig", None),
}


@pytest.fixture(scope="module")
def packages() -> Path:
    """The folder of the packages, without their dependencies."""
    python = environment(
        ROOT / "tests" / "examples" / "recipes.requirements.txt", dependencies=False
    )
    base = str(python.parent.parent)
    return Path(sysconfig.get_path("purelib", vars={"base": base, "platbase": base}))


def _calls() -> dict[str, ast.Call]:
    """The calls of the page that are compared, by the name of what is called."""
    calls = {}
    for block in blocks(PAGE):
        if block.language != "python":
            continue
        for node in ast.walk(ast.parse(block.text)):
            if isinstance(node, ast.Call):
                function = node.func
                name = function.attr if isinstance(function, ast.Attribute) else ""
                if name in CALLS:
                    calls[name] = node
    return calls


def _parameters(source: Path, class_name: str, method: str | None) -> list[str]:
    """The parameters of a method after ``self``; without a method the fields of the class."""
    tree = ast.parse(source.read_text(encoding="utf-8"))
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    [found] = [node for node in classes if node.name == class_name]
    if method is None:
        fields = [node.target for node in found.body if isinstance(node, ast.AnnAssign)]
        return [field.id for field in fields if isinstance(field, ast.Name)]
    methods = [node for node in found.body if isinstance(node, ast.FunctionDef)]
    [definition] = [node for node in methods if node.name == method]
    _, *parameters = [argument.arg for argument in definition.args.args]
    return parameters


def test_the_page_has_all_calls() -> None:
    assert set(_calls()) == set(CALLS)


@pytest.mark.parametrize("name", CALLS)
def test_a_call_fits_the_signature_of_its_package(packages: Path, name: str) -> None:
    file, class_name, method = CALLS[name]
    call = _calls()[name]
    parameters = _parameters(packages / file, class_name, method)
    assert len(call.args) <= len(parameters)
    assert {keyword.arg for keyword in call.keywords} <= set(parameters)
