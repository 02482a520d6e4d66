"""CI keeps its promises: one list of commands, versions with hashes, nothing left out unseen."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from itertools import chain
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import pytest
import yaml

from tests.conftest import ROOT

RUN = ROOT / ".ci/run"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
WORKFLOW = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8"))


def _steps() -> list[str]:
    steps = re.search(r"^STEPS=\((.*)\)$", RUN.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert steps is not None
    return steps.group(1).split()


def _locked(name: str) -> dict[tuple[str, str], int]:
    """The number of hashes of each package and version."""
    text = (ROOT / "requirements" / name).read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    pins = [re.match(r"([a-z0-9-]+)==(\S+)", line) for line in lines]
    return {
        (pin.group(1), pin.group(2)): line.count("--hash=sha256:")
        for pin, line in zip(pins, lines, strict=True)
        if pin
    }


def _wanted(extras: list[str]) -> set[str]:
    lists = [
        PROJECT["dependencies"],
        *(PROJECT["optional-dependencies"][extra] for extra in extras),
    ]
    names = {
        re.split(r"[^\w-]", each)[0].lower().replace("_", "-")
        for each in chain.from_iterable(lists)
    }
    return names - {"vehanchor"}


def test_the_workflow_runs_every_step_and_nothing_of_its_own() -> None:
    named: set[str] = set()
    for job in WORKFLOW["jobs"].values():
        for command in (step["run"] for step in job["steps"] if "run" in step):
            matrix = job["strategy"]["matrix"].get("steps", [])
            for text in [command.replace("${{ matrix.steps }}", steps) for steps in matrix] or [
                command
            ]:
                assert text.startswith("bash .ci/run "), "a command that nobody can run at home"
                named |= set(text.split()[2:])
    assert named == {*_steps(), "qgis", "smoke"}


def test_every_python_that_the_package_names_is_tested() -> None:
    classified = {
        each.rpartition(" ")[2] for each in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", each)
    }
    assert set(WORKFLOW["jobs"]["linux"]["strategy"]["matrix"]["python"]) == classified


def test_every_marker_that_the_quick_tests_leave_out_has_a_step() -> None:
    options = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"][
        "pytest"
    ]["ini_options"]
    left_out = set(re.findall(r"not (\w+)", options["addopts"]))
    assert left_out == set(re.findall(r"pytest -m (\w+)", RUN.read_text(encoding="utf-8")))


def test_a_step_that_does_not_exist_is_refused_before_anything_is_installed() -> None:
    done = subprocess.run(
        ["bash", str(RUN), "lint", "nonsense"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "no step nonsense" in done.stderr


def test_all_that_may_be_installed_has_a_version_and_hashes() -> None:
    extras = [extra for extra in PROJECT["optional-dependencies"] if extra != "train"]
    locked = _locked("all.txt")
    assert _wanted(extras) <= {name for name, _ in locked}
    assert all(locked.values())


def test_the_container_gets_what_ci_tests() -> None:
    locked = _locked("image.txt")
    assert _wanted(["geo"]) <= {name for name, _ in locked}
    assert all(locked.values())
    assert set(locked) <= set(_locked("all.txt"))


def test_the_locks_name_no_index() -> None:
    for path in sorted(Path(ROOT / "requirements").glob("*.txt")):
        assert not re.search(
            r"https?:|file:|--(?:extra-)?index|--find-links", path.read_text(encoding="utf-8")
        )


@pytest.fixture(scope="module")
def supply() -> ModuleType:
    """`.ci/supply.py` as a module."""
    loader = SourceFileLoader("supply", str(ROOT / ".ci/supply.py"))
    spec = spec_from_loader("supply", loader)
    assert spec is not None
    module = module_from_spec(spec)
    loader.exec_module(module)
    return module


@pytest.mark.promise("audit")
def test_a_vulnerability_and_a_package_that_nobody_looked_up_both_fail_the_audit(
    supply: ModuleType,
) -> None:
    known = {"name": "a", "version": "1", "vulns": [{"id": "PYSEC-1", "fix_versions": ["2"]}]}
    clean: dict[str, Any] = {"name": "b", "version": "1", "vulns": []}
    skipped = {"name": "c", "skip_reason": "not found"}
    assert supply.verdict({"dependencies": [clean]}) == []
    assert supply.verdict({"dependencies": [clean, known]}) == ["a 1: PYSEC-1, fixed in 2"]
    assert supply.verdict({"dependencies": [clean, skipped]}) == ["c: not looked up: not found"]


@pytest.mark.parametrize("answer", [{}, {"dependencies": []}])
def test_an_audit_that_looked_at_nothing_fails(supply: ModuleType, answer: dict[str, Any]) -> None:
    assert supply.verdict(answer)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks into Linux wheels")
def test_the_libraries_inside_opencvs_wheel_are_named(supply: ModuleType) -> None:
    names = {
        each["name"]
        for each in supply.native(Path(cv2.__file__).parents[1], "opencv-python-headless")
    }
    assert {"avcodec", "crypto", "png16"} <= names


@pytest.mark.parametrize(
    ("file", "name", "version"),
    [
        ("libcrypto-5409cd36.so.1.1.1k", "crypto", "1.1.1k"),
        ("libgdal-7562cabc.so.36.3.10.2", "gdal", "36.3.10.2"),
        ("libonnxruntime.so.1.31.1", "onnxruntime", "1.31.1"),
    ],
)
def test_a_library_s_name_and_version_are_read_from_its_file(
    supply: ModuleType, tmp_path: Path, file: str, name: str, version: str
) -> None:
    (tmp_path / "some_wheel-1.dist-info").mkdir()
    (tmp_path / "some_wheel-1.dist-info/RECORD").write_text(f"some_wheel.libs/{file},sha256=0,1\n")
    (tmp_path / "some_wheel.libs").mkdir()
    (tmp_path / "some_wheel.libs" / file).write_bytes(b"")
    assert [(e["name"], e["version"]) for e in supply.native(tmp_path, "some-wheel")] == [
        (name, version)
    ]
