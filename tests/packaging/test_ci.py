"""CI runs every check by one list of commands, with locked versions and hashes."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
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
    """Count the hashes of each package and version."""
    text = (ROOT / "requirements" / name).read_text(encoding="utf-8").replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    pins = [re.match(r"([a-z0-9-]+)==(\S+)", line) for line in lines]
    return {
        (pin.group(1), pin.group(2)): line.count("--hash=sha256:")
        for pin, line in zip(pins, lines, strict=True)
        if pin
    }


def _wanted(extras: list[str]) -> set[str]:
    """Return the names of all packages that the project and its extras require."""
    requirements = [*PROJECT["dependencies"]]
    for extra in extras:
        requirements += PROJECT["optional-dependencies"][extra]
    names = {re.split(r"[^\w-]", requirement)[0] for requirement in requirements}
    return {name.lower().replace("_", "-") for name in names} - {"vehanchor"}


def _workflow_commands() -> list[str]:
    """Return the commands of the workflow, one for each entry of a matrix of steps."""
    commands = []
    for job in WORKFLOW["jobs"].values():
        matrix = job["strategy"]["matrix"].get("steps", [""])
        runs = [step["run"] for step in job["steps"] if "run" in step]
        commands += [run.replace("${{ matrix.steps }}", steps) for run in runs for steps in matrix]
    return commands


def test_the_workflow_has_no_command_of_its_own() -> None:
    assert all(command.startswith("bash .ci/run ") for command in _workflow_commands())


def test_the_workflow_runs_every_step() -> None:
    steps = {step for command in _workflow_commands() for step in command.split()[2:]}
    assert steps == {*_steps(), "qgis", "smoke"}


def test_every_python_that_the_package_names_is_tested() -> None:
    versions = {
        classifier.rpartition(" ")[2]
        for classifier in PROJECT["classifiers"]
        if re.search(r":: 3\.\d+$", classifier)
    }
    assert set(WORKFLOW["jobs"]["linux"]["strategy"]["matrix"]["python"]) == versions


def test_every_marker_that_the_quick_tests_leave_out_has_a_step() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    options = project["tool"]["pytest"]["ini_options"]["addopts"]
    left_out = set(re.findall(r"not (\w+)", options))
    assert left_out == set(re.findall(r"pytest -m (\w+)", RUN.read_text(encoding="utf-8")))


def test_an_unknown_step_is_refused() -> None:
    done = subprocess.run(
        ["bash", str(RUN), "lint", "nonsense"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert "no step nonsense" in done.stderr


def test_every_extra_has_locked_versions_with_hashes() -> None:
    extras = [extra for extra in PROJECT["optional-dependencies"] if extra != "train"]
    locked = _locked("all.txt")
    assert _wanted(extras) <= {name for name, _ in locked}
    assert all(locked.values())


def test_the_container_installs_versions_that_ci_tests() -> None:
    locked = _locked("image.txt")
    assert _wanted(["geo"]) <= {name for name, _ in locked}
    assert all(locked.values())
    assert set(locked) <= set(_locked("all.txt"))


def test_the_locks_name_no_index() -> None:
    for path in sorted(Path(ROOT / "requirements").glob("*.txt")):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"https?:|file:|--(?:extra-)?index|--find-links", text)


@pytest.fixture(scope="module")
def supply() -> ModuleType:
    """Import `.ci/supply.py` as a module."""
    loader = SourceFileLoader("supply", str(ROOT / ".ci/supply.py"))
    spec = spec_from_loader("supply", loader)
    assert spec is not None
    module = module_from_spec(spec)
    loader.exec_module(module)
    return module


_CLEAN: dict[str, Any] = {"name": "b", "version": "1", "vulns": []}


def test_an_audit_without_findings_passes(supply: ModuleType) -> None:
    assert supply.verdict({"dependencies": [_CLEAN]}) == []


@pytest.mark.promise("audit")
def test_a_vulnerability_fails_the_audit(supply: ModuleType) -> None:
    flawed = {"name": "a", "version": "1", "vulns": [{"id": "PYSEC-1", "fix_versions": ["2"]}]}
    assert supply.verdict({"dependencies": [_CLEAN, flawed]}) == ["a 1: PYSEC-1, fixed in 2"]


@pytest.mark.promise("audit")
def test_a_package_that_was_not_looked_up_fails_the_audit(supply: ModuleType) -> None:
    skipped = {"name": "c", "skip_reason": "not found"}
    assert supply.verdict({"dependencies": [_CLEAN, skipped]}) == ["c: not looked up: not found"]


@pytest.mark.parametrize("answer", [{}, {"dependencies": []}])
def test_an_empty_audit_fails(supply: ModuleType, answer: dict[str, Any]) -> None:
    assert supply.verdict(answer)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks into Linux wheels")
def test_the_libraries_inside_opencvs_wheel_are_named(supply: ModuleType) -> None:
    site = Path(cv2.__file__).parents[1]
    libraries = supply.native(site, "opencv-python-headless")
    assert {"avcodec", "crypto", "png16"} <= {library["name"] for library in libraries}


@pytest.mark.parametrize(
    ("file", "name", "version"),
    [
        ("libcrypto-5409cd36.so.1.1.1k", "crypto", "1.1.1k"),
        ("libgdal-7562cabc.so.36.3.10.2", "gdal", "36.3.10.2"),
        ("libonnxruntime.so.1.31.1", "onnxruntime", "1.31.1"),
    ],
)
def test_the_name_of_a_file_gives_library_and_version(
    supply: ModuleType, tmp_path: Path, file: str, name: str, version: str
) -> None:
    (tmp_path / "some_wheel-1.dist-info").mkdir()
    (tmp_path / "some_wheel-1.dist-info/RECORD").write_text(f"some_wheel.libs/{file},sha256=0,1\n")
    (tmp_path / "some_wheel.libs").mkdir()
    (tmp_path / "some_wheel.libs" / file).write_bytes(b"")
    (library,) = supply.native(tmp_path, "some-wheel")
    assert (library["name"], library["version"]) == (name, version)
