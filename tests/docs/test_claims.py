"""What the README and the documentation claim is so: numbers, links, names of commands, fields and variables."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from typer.main import get_command

from tests.conftest import ROOT
from tests.docs.documents import DOCUMENTS
from tests.packaging.dockerfile import read_dockerfile
from vehanchor.cli.app import app
from vehanchor.records import AreaMeasurement, GsdEstimate
from vehanchor_server.settings import Settings

_README = (ROOT / "README.md").read_text(encoding="utf-8")
_IDS = [path.relative_to(ROOT).as_posix() for path in DOCUMENTS]


def _section(title: str) -> str:
    return _README.partition(f"## {title}\n")[2].partition("\n## ")[0]


def test_every_number_of_the_accuracy_table_is_measured() -> None:
    measured = (ROOT / "benchmarks/RESULTS.md").read_text(encoding="utf-8")
    claimed = re.findall(r"\d+\.\d+ ?%", _section("How accurate it is"))
    assert len(claimed) >= 8
    missing = [number for number in claimed if number not in measured and number.replace("%", " %") not in measured]
    assert not missing, f"not in benchmarks/RESULTS.md: {missing}"


def test_the_record_table_names_fields_that_exist() -> None:
    named = re.findall(r"^\| (`.*?`) \|", _section("Reading the record"), flags=re.MULTILINE)
    fields = {name for cell in named for name in re.findall(r"`(\w+)`", cell)}
    assert len(fields) >= 10
    assert fields <= set(GsdEstimate.model_fields)


@pytest.mark.parametrize("document", DOCUMENTS, ids=_IDS)
def test_the_files_it_links_to_exist(document: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", document.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (document.parent / target).exists(), target


@pytest.mark.parametrize("document", DOCUMENTS, ids=_IDS)
def test_the_commands_options_and_variables_it_names_exist(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    commands = get_command(app).commands  # type: ignore[attr-defined]
    for line in re.findall(r"(?:`|\$ |&& |-- )vehanchor ([a-z]+)", text):
        assert line in commands, f"vehanchor {line}"
    fields = {f"VEHANCHOR_{name.upper()}" for name in Settings.__dataclass_fields__} | {"VEHANCHOR_DATA"}
    assert set(re.findall(r"VEHANCHOR_[A-Z_]*[A-Z]", text)) <= fields
    records = set(GsdEstimate.model_fields) | set(AreaMeasurement.model_fields)
    measured = re.findall(r"`(\w+_(?:m|m2|px|m_per_px|m2|ci95_\w+))`", text)
    assert set(measured) <= records, set(measured) - records


@pytest.mark.parametrize("document", DOCUMENTS, ids=_IDS)
def test_the_scripts_it_names_are_there(document: Path) -> None:
    for path in re.findall(r"\b((?:examples|docs|benchmarks|training)/[\w/.-]+\.\w+)", document.read_text("utf-8")):
        assert (ROOT / path).exists(), path


def test_the_container_reports_nothing_to_others_as_the_security_notes_say() -> None:
    assert "VehAnchor turns that off before it loads ONNX Runtime" in (ROOT / "SECURITY.md").read_text(encoding="utf-8")
    code = "import os, vehanchor.models.session; print(os.environ['ORT_DISABLE_TELEMETRY'])"
    free = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    told = subprocess.run([sys.executable, "-c", code], env=free, capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "1"
    assert read_dockerfile(ROOT / "Dockerfile")[-1].environment["ORT_DISABLE_TELEMETRY"] == "1"
