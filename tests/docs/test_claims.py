"""The claims of README and documentation are true: links, names and numbers."""

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
from vehanchor.detection.detector_errors import DetectorErrors
from vehanchor.engine import Engine
from vehanchor.options import Frame, KnownLength, Lengths, Reading, Reference, Search
from vehanchor.records import AreaMeasurement, GsdEstimate, RulerScale
from vehanchor_server.settings import Settings

_READING = (ROOT / "docs/reading.md").read_text(encoding="utf-8")
_IDS = [path.relative_to(ROOT).as_posix() for path in DOCUMENTS]


def test_the_record_table_names_fields_that_exist() -> None:
    section = _READING.partition("## The fields\n")[2].partition("\n## ")[0]
    cells = re.findall(r"^\| (`.*?`) \|", section, flags=re.MULTILINE)
    fields = {name for cell in cells for name in re.findall(r"`(\w+)`", cell)}
    assert len(fields) >= 10
    assert fields <= set(GsdEstimate.model_fields)


def _documented_errors() -> dict[tuple[str, str], float]:
    """Read the defaults of a detector's errors from the table in ``detectors.md``."""
    text = (ROOT / "docs/how-to/detectors.md").read_text(encoding="utf-8")
    section = text.partition("## State the errors of your detector\n")[2]
    defaults = {}
    group = ""
    for first, names, values in re.findall(
        r"^\| (`[\w.]+`)? ?\| (`.*?`) \| ([-\d., ]+) \|", section, flags=re.MULTILINE
    ):
        group = first.strip("`") or group
        numbers = map(float, values.split(", "))
        for name, number in zip(re.findall(r"`(\w+)`", names), numbers, strict=True):
            defaults[group, name] = number
    return defaults


def test_the_table_of_a_detectors_errors_has_all_defaults() -> None:
    expected: dict[tuple[str, str], float] = {}
    # Votes have no default.
    for group, numbers in DetectorErrors().model_dump(exclude_none=True).items():
        for name, number in numbers.items():
            if isinstance(number, dict):
                # A table in a table, such as look_alikes.lengths.
                expected |= {(f"{group}.{name}", key): value for key, value in number.items()}
            else:
                expected[group, name] = number
    assert _documented_errors() == expected


@pytest.mark.parametrize("document", DOCUMENTS, ids=_IDS)
def test_the_prose_is_wrapped_at_100_columns(document: Path) -> None:
    text = re.sub(r"^```.*?^```$", "", document.read_text("utf-8"), flags=re.DOTALL | re.MULTILINE)
    prose = [line for line in text.splitlines() if not line.startswith(("|", "!["))]
    assert not [line for line in prose if len(line) > 100]


@pytest.mark.parametrize("document", DOCUMENTS, ids=_IDS)
def test_the_linked_files_exist(document: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)\)", document.read_text(encoding="utf-8")):
        if not target.startswith("http"):
            assert (document.parent / target).exists(), target


@pytest.mark.parametrize("document", DOCUMENTS, ids=_IDS)
def test_the_named_commands_exist(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    commands = {command.name for command in entry_points(group="vehanchor.commands")}
    assert set(re.findall(r"(?:`|\$ |&& |-- )vehanchor ([a-z]+)", text)) <= commands


@pytest.mark.parametrize("document", DOCUMENTS, ids=_IDS)
def test_the_named_variables_exist(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    variables = {f"VEHANCHOR_{name.upper()}" for name in Settings.__dataclass_fields__}
    variables |= {"VEHANCHOR_DATA", "VEHANCHOR_CI_WITHOUT"}
    assert set(re.findall(r"VEHANCHOR_[A-Z_]*[A-Z]", text)) <= variables


def _known_quantities() -> set[str]:
    """Return the names of all record fields, options and tool arguments."""
    records = {
        *GsdEstimate.model_fields,
        *RulerScale.model_fields,
        *AreaMeasurement.model_fields,
    }
    groups = (Search, Lengths, Reference, Frame, Reading, KnownLength)
    options = {field.name for group in groups for field in fields_of(group)}
    keywords = set(signature(Engine.analyse_area).parameters)
    arguments = set()
    for tool in ("estimate_gsd", "measure_area"):
        schema = (ROOT / f"schemas/{tool}.input.json").read_text(encoding="utf-8")
        arguments |= set(json.loads(schema)["properties"])
    return records | options | keywords | arguments


@pytest.mark.parametrize("document", DOCUMENTS, ids=_IDS)
def test_the_named_quantities_exist(document: Path) -> None:
    text = document.read_text(encoding="utf-8")
    named = re.findall(r"`(\w+_(?:m|m2|px|m_per_px|m2|ci95_\w+))`", text)
    assert not set(named) - _known_quantities()


@pytest.mark.parametrize("document", DOCUMENTS, ids=_IDS)
def test_the_named_files_exist(document: Path) -> None:
    folders = "docs|examples|requirements|research|server|skill|tests"
    for path in re.findall(rf"\b((?:{folders})/[\w/.-]+\.\w+)", document.read_text("utf-8")):
        assert (ROOT / path).exists(), path


@pytest.mark.parametrize("document", DOCUMENTS, ids=_IDS)
def test_the_named_modules_exist(document: Path) -> None:
    named = re.findall(r"`(vehanchor(?:_\w+)?(?:\.[a-z_]+)+)`", document.read_text("utf-8"))
    missing = [name for name in named if not _exists(name)]
    assert not missing


def _exists(name: str) -> bool:
    """Test whether a dotted name is that of a module, or of something in one."""
    package, _, last = name.rpartition(".")
    return find_spec(name) is not None or hasattr(import_module(package), last)


def test_the_length_of_north_american_cars_is_that_of_the_model() -> None:
    card = Engine().detector.card
    assert card.bodies is not None
    lengths = card.bodies.region_lengths_m
    elsewhere = math.sqrt(lengths["europe"] * lengths["south_america"])
    longer = f"{100 * (lengths['north_america'] / elsewhere - 1):.0f} %"
    page = " ".join((ROOT / "docs/concepts.md").read_text(encoding="utf-8").split())
    assert f"North American cars come out {longer} longer" in page


def test_the_length_of_north_american_cars_is_on_one_page() -> None:
    others = [path for path in DOCUMENTS if path.name != "concepts.md"]
    pattern = r"(?:[Cc]ars|[Ff]leets)[^.|]* by about \d+ ?%|[Aa]merican? [^.|]*\d+ ?% longer"
    texts = {path: " ".join(path.read_text("utf-8").split()) for path in others}
    assert not [path for path, text in texts.items() if re.search(pattern, text)]


@pytest.mark.promise("telemetry")
def test_the_library_turns_telemetry_off() -> None:
    code = "import os, vehanchor.models.session; print(os.environ['ORT_DISABLE_TELEMETRY'])"
    variables = dict(os.environ)
    variables.pop("ORT_DISABLE_TELEMETRY", None)
    done = subprocess.run(
        [sys.executable, "-c", code], env=variables, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "1"


@pytest.mark.promise("telemetry")
def test_the_container_turns_telemetry_off() -> None:
    server = read_dockerfile(ROOT / "Dockerfile")[-1]
    assert server.environment["ORT_DISABLE_TELEMETRY"] == "1"


_TEXT = (ROOT / "SECURITY.md").read_text(encoding="utf-8")


def test_the_promises_are_those_that_tests_name() -> None:
    promises = _TEXT.partition("## Promises")[2]
    promised = re.findall(r"^- \*\*([a-z-]+)\*\*: ", promises, flags=re.MULTILINE)
    texts = [file.read_text(encoding="utf-8") for file in (ROOT / "tests").rglob("test_*.py")]
    tested = {
        name for text in texts for name in re.findall(r"mark\.promise\(\"([a-z-]+)\"\)", text)
    }
    assert sorted(promised) == sorted(tested)


def test_every_item_of_the_section_is_a_promise() -> None:
    section = _TEXT.partition("## Promises")[2].partition("## Limits")[0]
    lines = re.findall(r"^- .*", section, flags=re.MULTILINE)
    assert all(re.match(r"- \*\*[a-z-]+\*\*: ", line) for line in lines)
    assert len(lines) > 25


CONFIGURATIONS = [
    ".pre-commit-config.yaml",
    "mkdocs.yml",
    "pyproject.toml",
    ".github/workflows/ci.yml",
]


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_the_files_that_a_configuration_names_exist(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    named = re.findall(r"\b((?:docs|requirements|tests)/[\w/.-]+\.(?:txt|py|md|in))", text)
    assert not [path for path in named if not (ROOT / path).exists()]
    assert "constraints.txt" not in text


def test_no_section_of_the_site_is_configured_twice() -> None:
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    sections = re.findall(r"^(\w+):", text, flags=re.MULTILINE)
    assert len(sections) == len(set(sections))
