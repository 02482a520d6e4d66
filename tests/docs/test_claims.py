"""What the README and the documentation claim is so: numbers, links, names of commands, fields and variables."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
from dataclasses import fields as fields_of
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import find_spec
from inspect import signature
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.docs.documents import DOCUMENTS
from tests.packaging.container import read_dockerfile
from vehanchor.engine import Engine
from vehanchor.options import Frame, KnownLength, Lengths, Reading, Reference, Search
from vehanchor.records import AreaMeasurement, GsdEstimate
from vehanchor_server.settings import Settings

_READING = (ROOT / "docs/reading.md").read_text(encoding="utf-8")
_IDS = [path.relative_to(ROOT).as_posix() for path in DOCUMENTS]


def test_the_record_table_names_fields_that_exist() -> None:
    named = re.findall(
        r"^\| (`.*?`) \|",
        _READING.partition("## The fields\n")[2].partition("\n## ")[0],
        flags=re.MULTILINE,
    )
    fields = {name for cell in named for name in re.findall(r"`(\w+)`", cell)}
    assert len(fields) >= 10
    assert fields <= set(GsdEstimate.model_fields)


@pytest.mark.parametrize("document", DOCUMENTS, ids=_IDS)
def test_its_prose_is_wrapped_at_100_columns(document: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", document.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)
    prose = [line for line in text.splitlines() if not line.startswith(("|", "!["))]
    assert not [line for line in prose if len(line) > 100]


@pytest.mark.parametrize("document", DOCUMENTS, ids=_IDS)
def test_the_files_it_links_to_exist(document: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", document.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (document.parent / target).exists(), target


@pytest.mark.parametrize("document", DOCUMENTS, ids=_IDS)
def test_the_commands_options_and_variables_it_names_exist(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    commands = {command.name for command in entry_points(group="vehanchor.commands")}
    assert set(re.findall(r"(?:`|\$ |&& |-- )vehanchor ([a-z]+)", text)) <= commands
    fields = {f"VEHANCHOR_{name.upper()}" for name in Settings.__dataclass_fields__}
    fields |= {"VEHANCHOR_DATA", "VEHANCHOR_CI_WITHOUT"}
    assert set(re.findall(r"VEHANCHOR_[A-Z_]*[A-Z]", text)) <= fields
    records = set(GsdEstimate.model_fields) | set(AreaMeasurement.model_fields)
    measured = re.findall(r"`(\w+_(?:m|m2|px|m_per_px|m2|ci95_\w+))`", text)
    choices = {
        field.name
        for group in (Search, Lengths, Reference, Frame, Reading)
        for field in fields_of(group)
    }
    choices |= {
        *signature(Engine.analyse_area).parameters,
        *(each.name for each in fields_of(KnownLength)),
    }
    choices |= set(
        json.loads((ROOT / "schemas/measure_area.input.json").read_text(encoding="utf-8"))[
            "properties"
        ]
    )
    assert not set(measured) - records - choices


@pytest.mark.parametrize("document", DOCUMENTS, ids=_IDS)
def test_the_files_it_names_are_there(document: Path) -> None:
    folders = "docs|examples|requirements|research|server|skill|tests"
    for path in re.findall(rf"\b((?:{folders})/[\w/.-]+\.\w+)", document.read_text("utf-8")):
        assert (ROOT / path).exists(), path


@pytest.mark.parametrize("document", DOCUMENTS, ids=_IDS)
def test_the_modules_it_names_are_there(document: Path) -> None:
    named = re.findall(r"`(vehanchor(?:_\w+)?(?:\.[a-z_]+)+)`", document.read_text("utf-8"))
    missing = [name for name in named if not _found(name)]
    assert not missing


def _found(name: str) -> bool:
    """Whether a dotted name is that of a module, or of something in one."""
    package, _, last = name.rpartition(".")
    return find_spec(name) is not None or hasattr(import_module(package), last)


def test_how_much_longer_cars_are_in_north_america_is_said_once_and_as_the_model_has_it() -> None:
    card = Engine().detector.card
    assert card.bodies is not None
    lengths = card.bodies.region_lengths_m
    america = lengths["north_america"]
    elsewhere = math.sqrt(lengths["europe"] * lengths["south_america"])
    page = " ".join((ROOT / "docs/concepts.md").read_text(encoding="utf-8").split())
    assert (
        f"North American cars come out {america / elsewhere - 1:.0%} longer".replace("%", " %")
        in page
    )
    others = [path for path in DOCUMENTS if path.name != "concepts.md"]
    pattern = r"(?:[Cc]ars|[Ff]leets)[^.|]* by about \d+ ?%|[Aa]merican? [^.|]*\d+ ?% longer"
    texts = {path: " ".join(path.read_text("utf-8").split()) for path in others}
    assert not [path for path, text in texts.items() if re.search(pattern, text)]


@pytest.mark.promise("telemetry")
def test_the_container_reports_nothing_to_others() -> None:
    code = "import os, vehanchor.models.session; print(os.environ['ORT_DISABLE_TELEMETRY'])"
    free = {name: value for name, value in os.environ.items() if name != "ORT_DISABLE_TELEMETRY"}
    told = subprocess.run(
        [sys.executable, "-c", code], env=free, capture_output=True, text=True, check=True
    )
    assert told.stdout.strip() == "1"
    assert read_dockerfile(ROOT / "Dockerfile")[-1].environment["ORT_DISABLE_TELEMETRY"] == "1"


_TEXT = (ROOT / "SECURITY.md").read_text(encoding="utf-8")


def test_each_promise_has_a_test_that_names_it_and_no_test_names_another() -> None:
    promised = re.findall(
        r"^- \*\*([a-z-]+)\*\*: ", _TEXT.partition("## Promises")[2], flags=re.MULTILINE
    )
    texts = [file.read_text(encoding="utf-8") for file in (ROOT / "tests").rglob("test_*.py")]
    kept = {name for text in texts for name in re.findall(r"mark\.promise\(\"([a-z-]+)\"\)", text)}
    assert sorted(promised) == sorted(kept)


def test_every_line_of_the_promises_is_one() -> None:
    section = _TEXT.partition("## Promises")[2].partition("## Limits")[0]
    lines = re.findall(r"^- .*", section, flags=re.MULTILINE)
    assert all(re.match(r"- \*\*[a-z-]+\*\*: ", line) for line in lines)
    assert len(lines) > 25
