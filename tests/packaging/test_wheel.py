"""The wheel works for a user: built from the sdist, in an empty environment, without sources."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.packaging.container import stdio_answers
from vehanchor_server.schemas import schema_files

# The speed of the disk limits the installation.
pytestmark = [pytest.mark.packaging, pytest.mark.timeout(900)]

SOURCES = ("LICENSE", "README.md", "pyproject.toml", "schemas", "server", "skill")
PACKAGES = ("vehanchor", "vehanchor_evaluation", "vehanchor_flight", "vehanchor_server")
MAX_WHEEL_BYTES = 40e6
_PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

Run = Callable[..., str]


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("build")
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, folder / name)
    shutil.rmtree(folder / "build", ignore_errors=True)
    subprocess.run(
        [sys.executable, "-m", "build", "--installer", "uv", str(folder)],
        check=True,
        capture_output=True,
    )
    (built,) = (folder / "dist").glob("*.whl")
    return built


@pytest.fixture(scope="session")
def run(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """Return a function that runs a command of the wheel's environment, in a folder of its own."""
    place = tmp_path_factory.mktemp("installed")
    uv = [sys.executable, "-m", "uv", "--quiet"]
    subprocess.run([*uv, "venv", "--python", sys.executable, str(place / "env")], check=True)
    subprocess.run(
        [*uv, "pip", "install", "--python", str(place / "env/bin/python"), str(wheel)], check=True
    )
    (place / "work").mkdir()
    shutil.copy(ROOT / "examples/car_park.jpg", place / "work")
    clean = {"PATH": f"{place / 'env/bin'}{os.pathsep}/usr/bin:/bin", "HOME": str(place)}

    def run_there(*command: str) -> str:
        done = subprocess.run(
            command, cwd=place / "work", env=clean, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    return run_there


@pytest.fixture(scope="session")
def names(wheel: Path) -> list[str]:
    """Names of the files in the wheel."""
    return zipfile.ZipFile(wheel).namelist()


def _files_below(names: list[str], folder: str) -> set[str]:
    return {Path(name).name for name in names if name.startswith(f"{folder}/")}


def test_the_wheel_is_small(wheel: Path) -> None:
    assert wheel.stat().st_size <= MAX_WHEEL_BYTES


def test_the_wheel_contains_the_models(names: list[str]) -> None:
    bundled = (ROOT / "skill/vehanchor/models/bundled").iterdir()
    files = {path.name for path in bundled if path.is_file()}
    assert files == _files_below(names, "vehanchor/models/bundled")


def test_the_wheel_contains_the_page(names: list[str]) -> None:
    folder = ROOT / "server/vehanchor_server/app_page"
    files = {path.name for path in folder.iterdir() if path.suffix in (".css", ".html", ".js")}
    assert files <= _files_below(names, "vehanchor_server/app_page")


def test_every_package_is_marked_as_typed(names: list[str]) -> None:
    assert {f"{package}/py.typed" for package in PACKAGES} <= set(names)


def test_the_wheel_contains_the_packages_only(names: list[str]) -> None:
    folders = (*(f"{package}/" for package in PACKAGES), "vehanchor-")
    assert [name for name in names if not name.startswith(folders)] == []
    assert not any("tests/" in name or "research/" in name for name in names)


def _carried_schemas(wheel: Path) -> dict[str, str]:
    archive = zipfile.ZipFile(wheel)
    return {
        Path(name).name: archive.read(name).decode()
        for name in archive.namelist()
        if "/data/share/vehanchor/schemas/" in name
    }


def test_the_wheel_carries_the_schemas(wheel: Path) -> None:
    assert _carried_schemas(wheel) == schema_files()


def test_the_command_writes_the_schemas(wheel: Path, run: Run) -> None:
    printed = run("vehanchor", "serve", "--schemas", "written")
    written = {Path(line).name for line in printed.splitlines()}
    assert written == set(_carried_schemas(wheel))


def test_each_command_is_found_by_its_entry_point(run: Run) -> None:
    for name in _PROJECT["entry-points"]["vehanchor.commands"]:
        assert f"vehanchor {name}" in run("vehanchor", name, "--help")


def test_the_command_estimates_a_scale(run: Run) -> None:
    record = json.loads(run("vehanchor", "estimate", "car_park.jpg", "--json"))
    assert record["status"] == "ok"
    assert record["gsd_m_per_px"] == pytest.approx(0.12, rel=0.1)


def test_the_package_is_not_that_of_the_sources(run: Run) -> None:
    path = run("python", "-c", "import vehanchor; print(vehanchor.__file__)").strip()
    assert "site-packages" in path


def test_the_server_answers(run: Run) -> None:
    command, work = run("sh", "-c", "command -v vehanchor; pwd").split()
    tools, record = stdio_answers([command, "serve", "--root", work], f"{work}/car_park.jpg")
    assert tools == ["estimate_gsd", "measure_area", "measure_distance", "view_image"]
    assert record["status"] == "ok"


def test_the_types_are_those_of_the_sources(run: Run) -> None:
    code = "import vehanchor\nreveal_type(vehanchor.estimate_gsd('a.jpg').gsd_m_per_px)\n"
    python = run("sh", "-c", "command -v python").strip()
    work = run("pwd").strip()
    Path(work, "user.py").write_text(code)
    mypy = [sys.executable, "-m", "mypy", "--strict", "--config-file", ""]
    checked = subprocess.run(
        [*mypy, "--python-executable", python, "user.py"],
        cwd=work,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "Success" in checked.stdout, checked.stdout
    # Versions of mypy write the type in two ways.
    types = ('Revealed type is "float | None"', "Union[builtins.float, None]")
    assert any(text in checked.stdout for text in types)


def test_every_extra_resolves_beside_all_others(wheel: Path) -> None:
    extras = ",".join(_PROJECT["optional-dependencies"])
    resolved = subprocess.run(
        [sys.executable, "-m", "uv", "--quiet", "pip", "compile", "--python", sys.executable, "-"],
        input=f"vehanchor[{extras}] @ {wheel.as_uri()}",
        capture_output=True,
        text=True,
        check=False,
    )
    assert resolved.returncode == 0, resolved.stderr
    assert "vehanchor" in resolved.stdout
