"""The parts list names what wheels hide, and an audit without data is no audit."""

from __future__ import annotations

import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import pytest

from tests.conftest import ROOT

if TYPE_CHECKING:
    from types import ModuleType


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
def test_a_vulnerability_and_a_package_that_nobody_looked_up_both_fail_the_audit(supply: ModuleType) -> None:
    known = {"name": "a", "version": "1", "vulns": [{"id": "PYSEC-1", "fix_versions": ["2"]}]}
    clean: dict[str, Any] = {"name": "b", "version": "1", "vulns": []}
    skipped = {"name": "c", "skip_reason": "not found"}
    assert supply.verdict({"dependencies": [clean]}) == []
    assert supply.verdict({"dependencies": [clean, known]}) == ["a 1: PYSEC-1, mended in 2"]
    assert supply.verdict({"dependencies": [clean, skipped]}) == ["c: not looked up: not found"]


@pytest.mark.parametrize("answer", [{}, {"dependencies": []}])
def test_an_audit_that_looked_at_nothing_fails(supply: ModuleType, answer: dict[str, Any]) -> None:
    assert supply.verdict(answer)


@pytest.mark.skipif(sys.platform != "linux", reason="looks into Linux wheels")
def test_the_libraries_inside_opencvs_wheel_are_named(supply: ModuleType) -> None:
    names = {each["name"] for each in supply.native(Path(cv2.__file__).parents[1], "opencv-python-headless")}
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
    assert [(e["name"], e["version"]) for e in supply.native(tmp_path, "some-wheel")] == [(name, version)]
