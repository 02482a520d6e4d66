"""The wheel as a user gets it: built from the sdist, installed into an empty environment, away from the sources."""

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

# installing takes what the disk takes
pytestmark = [pytest.mark.packaging, pytest.mark.timeout(900)]

SOURCES = ("LICENSE", "README.md", "pyproject.toml", "schemas", "server", "skill")
PACKAGES = ("vehanchor", "vehanchor_evaluation", "vehanchor_flight", "vehanchor_server")
LARGEST_WHEEL = 40e6  # bytes
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
    """Runs a command of the environment that the wheel was installed into, in an empty directory."""
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


def test_it_is_small_and_holds_all_it_needs(wheel: Path) -> None:
    assert wheel.stat().st_size <= LARGEST_WHEEL
    names = zipfile.ZipFile(wheel).namelist()
    here = {
        path.name for path in (ROOT / "skill/vehanchor/models/bundled").iterdir() if path.is_file()
    }
    assert here == {
        Path(name).name for name in names if name.startswith("vehanchor/models/bundled/")
    }
    folder = ROOT / "server/vehanchor_server/app_page"
    pages = {path.name for path in folder.iterdir() if path.suffix in (".css", ".html", ".js")}
    assert pages <= {
        Path(name).name for name in names if name.startswith("vehanchor_server/app_page/")
    }
    assert {f"{package}/py.typed" for package in PACKAGES} <= set(names)
    inside = {
        name
        for name in names
        if name.startswith((*(f"{package}/" for package in PACKAGES), "vehanchor-"))
    }
    assert inside == set(names), f"more than the three packages: {sorted(set(names) - inside)}"
    assert not any("tests/" in name or "research/" in name for name in names)


def test_it_carries_the_schemas_that_its_command_writes(wheel: Path, run: Run) -> None:
    archive = zipfile.ZipFile(wheel)
    carried = {
        Path(name).name: archive.read(name).decode()
        for name in archive.namelist()
        if "/data/share/vehanchor/schemas/" in name
    }
    assert carried == schema_files()
    written = [
        Path(line) for line in run("vehanchor", "serve", "--schemas", "written").splitlines()
    ]
    assert {path.name for path in written} == set(carried)


def test_each_command_is_found_by_its_entry_point(run: Run) -> None:
    for name in _PROJECT["entry-points"]["vehanchor.commands"]:
        assert f"vehanchor {name}" in run("vehanchor", name, "--help")


def test_it_estimates(run: Run) -> None:
    record = json.loads(run("vehanchor", "estimate", "car_park.jpg", "--json"))
    assert record["status"] == "ok"
    assert record["gsd_m_per_px"] == pytest.approx(0.12, rel=0.1)
    where = run("python", "-c", "import vehanchor; print(vehanchor.__file__)").strip()
    assert "site-packages" in where


def test_its_server_lists_and_runs_the_tools(run: Run, wheel: Path) -> None:
    command, work = run("sh", "-c", "command -v vehanchor; pwd").split()
    tools, record = stdio_answers([command, "serve", "--root", work], f"{work}/car_park.jpg")
    assert tools == ["estimate_gsd", "measure_area", "measure_distance", "view_image"]
    assert record["status"] == "ok"


def test_it_is_typed_for_its_users(run: Run) -> None:
    code = "import vehanchor\nreveal_type(vehanchor.estimate_gsd('a.jpg').gsd_m_per_px)\n"
    python = run("sh", "-c", "command -v python").strip()
    work = run("pwd").strip()
    Path(work, "user.py").write_text(code)
    checked = subprocess.run(
        [
            sys.executable,
            "-m",
            "mypy",
            "--strict",
            "--config-file",
            "",
            "--python-executable",
            python,
            "user.py",
        ],
        cwd=work,
        capture_output=True,
        text=True,
        check=False,
    )
    assert "Success" in checked.stdout, checked.stdout
    assert (
        'Revealed type is "float | None"' in checked.stdout
        or "Union[builtins.float, None]" in checked.stdout
    )


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
