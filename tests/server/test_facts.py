"""Facts of a caller count alike on all surfaces: Python, command line, batch and MCP."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from mcp.server import MCPServer
from typer.testing import CliRunner

import vehanchor
from tests.server.conversation import called, error_of, record_of
from vehanchor.batch import run_batch
from vehanchor.cli.app import app
from vehanchor.errors import InvalidParameterError

pytestmark = pytest.mark.anyio

# x1, y1, x2, y2 and metres: a line of 0.6 m/px, four times the scale of the cars.
Line = tuple[float, float, float, float, float]
LINE: Line = (100, 500, 400, 500, 180)
PARTS: list[Line] = [(100, 500, 200, 500, 60), (200, 500, 300, 500, 60), (300, 500, 400, 500, 60)]
_NAMES = ("x1", "y1", "x2", "y2", "metres")

Outcome = tuple[str, float, float]


@pytest.fixture
def image(images: Path) -> Path:
    return images / "cars.png"


def _by_python(image: Path, detector: Path, lines: Sequence[Line]) -> Outcome:
    known_lengths = [(*line, "measured") for line in lines]
    record = vehanchor.estimate_gsd(image, detector=detector, known_lengths=known_lengths)
    assert record.gsd_m_per_px is not None
    return record.status, record.gsd_m_per_px, record.confidence


def _by_command(image: Path, detector: Path, lines: Sequence[Line]) -> Outcome:
    arguments = ["estimate", str(image), "--json", "--detector", str(detector)]
    for line in lines:
        arguments += ["--known-length", *map(str, line), "measured"]
    result = CliRunner().invoke(app, arguments)
    record = json.loads(result.stdout)
    return record["status"], record["gsd_m_per_px"], record["confidence"]


def _by_batch(image: Path, detector: Path, lines: Sequence[Line], folder: Path) -> Outcome:
    table = folder / "lines.csv"
    with table.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["file", *_NAMES, "basis"])
        writer.writerows([image, *line, "measured"] for line in lines)
    output = folder / "scales.csv"
    run_batch([str(image)], output, detector=detector, known_lengths=table, workers=1)
    with output.open(newline="") as file:
        (row,) = csv.DictReader(file)
    return row["status"], float(row["gsd_m_per_px"]), float(row["confidence"])


async def _by_mcp(server: MCPServer[object], image: Path, lines: Sequence[Line]) -> Outcome:
    known_lengths: list[dict[str, Any]] = [
        {**dict(zip(_NAMES, line, strict=True)), "basis": "measured"} for line in lines
    ]
    result = await called(server, "estimate_gsd", image, known_lengths=known_lengths)
    record = record_of(result)
    return record["status"], record["gsd_m_per_px"], record["confidence"]


@pytest.mark.parametrize("surface", ["python", "command", "batch", "mcp"])
async def test_a_line_in_parts_counts_as_one_line(
    surface: str, image: Path, detector_path: Path, server: MCPServer[object], tmp_path: Path
) -> None:
    once = _by_python(image, detector_path, [LINE])
    if surface == "python":
        parts = _by_python(image, detector_path, PARTS)
    elif surface == "command":
        parts = _by_command(image, detector_path, PARTS)
    elif surface == "batch":
        parts = _by_batch(image, detector_path, PARTS, tmp_path)
    else:
        parts = await _by_mcp(server, image, PARTS)
    assert parts[0] == once[0]
    assert parts[1:] == pytest.approx(once[1:], rel=0.01)


def test_a_line_of_one_photograph_does_not_scale_a_list(images: Path, detector_path: Path) -> None:
    pictures = [images / "cars.png", images / "empty.png"]
    with pytest.raises(InvalidParameterError, match="a line of known length belongs to one image"):
        vehanchor.estimate_gsd(pictures, detector=detector_path, known_lengths=[LINE])


def test_a_line_of_one_photograph_is_refused_by_the_command(
    images: Path, detector_path: Path
) -> None:
    pictures = [str(images / "cars.png"), str(images / "empty.png")]
    options = ["--detector", str(detector_path), "--known-length", *map(str, LINE)]
    result = CliRunner().invoke(app, ["estimate", *pictures, *options])
    assert result.exit_code == 2
    assert "a line of known length belongs to one image" in result.stderr


async def test_a_line_of_one_photograph_is_refused_with_more_images(
    server: MCPServer[object], images: Path
) -> None:
    line = dict(zip(_NAMES, LINE, strict=True))
    more = [{"kind": "path", "path": str(images / "empty.png")}]
    result = await called(
        server, "estimate_gsd", images / "cars.png", known_lengths=[line], more_images=more
    )
    assert error_of(result) == "invalid_arguments"
