"""Facts of a caller count alike on all surfaces: Python, command line, batch, MCP and page."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import pytest
from mcp.server import MCPServer
from typer.testing import CliRunner

import vehanchor
from tests.server.app_page.viewing import viewing
from tests.server.conversation import by_path, called, error_of, record_of
from tests.server.transport.test_viewer import ask
from tests.skill.imagery.files import EXIF_PREFIX, XMP_PREFIX, after_start, exif, segment, xmp
from vehanchor.batch import run_batch
from vehanchor.cli.app import app
from vehanchor.errors import InvalidParameterError
from vehanchor.options import ScaleOptions
from vehanchor_server.settings import Settings
from vehanchor_server.transport.viewer import Address

pytestmark = pytest.mark.anyio

# x1, y1, x2, y2 and metres: a line of 0.6 m/px, four times the scale of the cars.
Line = tuple[float, float, float, float, float]
LINE: Line = (100, 500, 400, 500, 180)
PARTS: list[Line] = [(100, 500, 200, 500, 60), (200, 500, 300, 500, 60), (300, 500, 400, 500, 60)]
_NAMES = ("x1", "y1", "x2", "y2", "metres")
CARS_GSD = 0.157

SURFACES = ("command", "batch", "mcp", "page")
_ONE_IMAGE = ("command", "mcp", "page")  # a correction by hand belongs to one image
_UNNAMED = ("mcp", "page")  # the commands take a calibration instead of a length


class Case(NamedTuple):
    """Facts about a photograph, and what follows from them.

    Attributes:
        image: name of the photograph.
        facts: lines with their basis, and other options.
        status: status of the record.
        gsd_m_per_px: the scale, within 3 %.
        code: a warning of the record; empty for none.
        surfaces: those that take the facts.
    """

    image: str
    facts: dict[str, Any]
    status: str
    gsd_m_per_px: float
    code: str = ""
    surfaces: tuple[str, ...] = SURFACES


def _lines(lines: Sequence[Line], basis: str = "measured") -> dict[str, Any]:
    return {"known_lengths": [(*line, basis) for line in lines]}


_GUESSES: list[Line] = [(100, y, 400, y, 45) for y in (100, 300, 500)]
_WRONG_HEIGHT = {"height_m": 360.0, "height_basis": "measured", "focal_35mm": 26.0}
CASES = {
    "a wrong line": Case("cars.png", _lines([LINE]), "low_confidence", 0.165, "rulers_disagree"),
    "a right line": Case("cars.png", _lines([(100, 500, 400, 500, 45)]), "ok", 0.15),
    "a contradiction": Case(
        "cars.png", _lines([(100, 500, 400, 500, 56)]), "low_confidence", 0.185, "rulers_disagree"
    ),
    "a guessed length of cars": Case(
        "cars.png",
        {"reference_length_m": 7.0},
        status="ok",
        gsd_m_per_px=0.168,
        code="reference_length_unlikely",
        surfaces=_UNNAMED,
    ),
    "guesses with one mistake": Case(
        "cars.png",
        {"reference_length_m": 7.0, **_lines([(100, 500, 400, 500, 70)], "assumed")},
        status="low_confidence",
        gsd_m_per_px=0.217,
        surfaces=_UNNAMED,
    ),
    "a line and a height with one mistake": Case(
        "cars.png", _lines([LINE]) | _WRONG_HEIGHT, "low_confidence", 0.162, "rulers_disagree"
    ),
    "guesses alone": Case("empty.png", _lines(_GUESSES, "assumed"), "low_confidence", 0.154),
    "the file's scale as a guessed line": Case(
        "drone.jpg", _lines([(100, 500, 400, 500, 60.9)], "assumed"), "low_confidence", 0.22
    ),
    "the file's height as a guess": Case("drone.jpg", {"height_m": 98.0}, "low_confidence", 0.22),
    "the focal plane of an unknown camera": Case(
        "resized.jpg",
        {"height_m": 110.0, "height_basis": "measured"},
        status="low_confidence",
        gsd_m_per_px=0.041,
    ),
    "a lorry beside cars": Case(
        "cars.png",
        {"add": [(450, 420, 540, 420)]},
        status="ok",
        gsd_m_per_px=CARS_GSD,
        code="added_vehicle_unlike",
        surfaces=_ONE_IMAGE,
    ),
}


# 100 m above take-off, 26 mm: 0.203 m/px by the tags of a drone; the prior draws it to 0.22.
_DRONE = ({"FocalLengthIn35mmFilm": 26}, 'drone-dji:RelativeAltitude="100"')
# The focal plane of an original that was 6 times as wide, and of a camera that is in no table.
_RESIZED = (
    {
        "Make": "SONY",
        "Model": "ILCE-6000",
        "FocalLength": 20.0,
        "FocalPlaneXResolution": 1361.7,
        "FocalPlaneResolutionUnit": 3,
        "PixelXDimension": 640,
        "PixelYDimension": 512,
    },
    "",
)
_TAGGED: dict[str, tuple[dict[str, Any], str]] = {"drone.jpg": _DRONE, "resized.jpg": _RESIZED}


class Outcome(NamedTuple):
    """Result on one surface."""

    status: str
    gsd_m_per_px: float
    confidence: float
    codes: tuple[str, ...]


def _outcome(record: dict[str, Any]) -> Outcome:
    codes = [warning["code"] for warning in record["warnings"]]
    gsd_m_per_px = record["gsd_m_per_px"]
    return Outcome(record["status"], gsd_m_per_px, record["confidence"], tuple(codes))


def _by_python(image: Path, detector: Path, facts: dict[str, Any]) -> Outcome:
    record = vehanchor.estimate_gsd(image, detector=detector, **facts)
    return _outcome(record.model_dump())


def _by_command(image: Path, detector: Path, facts: dict[str, Any]) -> Outcome:
    arguments = ["estimate", str(image), "--json", "--detector", str(detector)]
    for name, value in facts.items():
        if name == "known_lengths":
            for line in value:
                arguments += ["--known-length", *map(str, line)]
        elif name == "add":
            for vehicle in value:
                arguments += ["--add", *map(str, vehicle)]
        else:
            flag = name.removesuffix("_m").replace("_", "-")
            arguments += [f"--{flag}", str(value)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code in (0, 3), result.stderr
    return _outcome(json.loads(result.stdout))


def _by_batch(image: Path, detector: Path, facts: dict[str, Any], folder: Path) -> Outcome:
    others = dict(facts)
    lines = others.pop("known_lengths", [])
    table = folder / "lines.csv"
    with table.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["file", *_NAMES, "basis"])
        writer.writerows([image, *line] for line in lines)
    output = folder / "scales.jsonl"
    run_batch(
        [str(image)],
        output,
        detector=detector,
        options=ScaleOptions.of(others),
        known_lengths=table if lines else None,
        workers=1,
    )
    row = json.loads(output.read_text(encoding="utf-8"))
    codes = tuple(row["warning_codes"].split())
    return Outcome(row["status"], row["gsd_m_per_px"], row["confidence"], codes)


def _arguments(facts: dict[str, Any]) -> dict[str, Any]:
    """Write facts as arguments of the tool, which the page sends, too."""
    arguments = dict(facts)
    if "known_lengths" in facts:
        names = (*_NAMES, "basis")
        arguments["known_lengths"] = [
            dict(zip(names, line, strict=True)) for line in facts["known_lengths"]
        ]
    if "add" in facts:
        arguments["add"] = [dict(zip(_NAMES[:4], axis, strict=True)) for axis in facts["add"]]
    return arguments


async def _by_mcp(server: MCPServer[object], image: Path, facts: dict[str, Any]) -> Outcome:
    result = await called(server, "estimate_gsd", image, detail="full", **_arguments(facts))
    return _outcome(record_of(result))


def _by_page(address: Address, image: Path, facts: dict[str, Any]) -> Outcome:
    arguments = {**by_path(image), "detail": "full", **_arguments(facts)}
    *_, answer = ask(address, "estimate_gsd", arguments)
    return _outcome(answer["result"]["structuredContent"])


@pytest.fixture(scope="module", autouse=True)
def _tagged(_images: Path) -> Iterator[None]:
    """Write photographs without cars whose files state a camera, for this module only."""
    rgb = cv2.imread(str(_images / "empty.png"))
    assert rgb is not None
    _, encoded = cv2.imencode(".jpg", rgb)
    for name, (tags, properties) in _TAGGED.items():
        blocks = segment(EXIF_PREFIX + exif(tags))
        if properties:
            packet = xmp({"drone-dji": "http://www.dji.com/drone-dji/1.0/"}, properties)
            blocks += segment(XMP_PREFIX + packet)
        (_images / name).write_bytes(after_start(encoded.tobytes(), blocks))
    yield
    # Tests of other modules list the folder.
    for name in _TAGGED:
        (_images / name).unlink()


@pytest.fixture(scope="module")
def address(
    _images: Path, detector_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Address]:
    settings = Settings(
        roots=(_images,), detector=str(detector_path), threads=1, isolation="in-process"
    )
    with viewing(settings, tmp_path_factory.mktemp("view").resolve() / "dropped") as address:
        yield address


@pytest.fixture(scope="module")
def in_python(_images: Path, detector_path: Path) -> Callable[[str], Outcome]:
    """What Python answers to a case, computed once."""

    @cache
    def outcome(name: str) -> Outcome:
        case = CASES[name]
        return _by_python(_images / case.image, detector_path, case.facts)

    return outcome


@pytest.mark.parametrize("name", CASES)
def test_facts_give_the_right_scale(name: str, in_python: Callable[[str], Outcome]) -> None:
    case = CASES[name]
    outcome = in_python(name)
    assert outcome.status == case.status
    assert outcome.gsd_m_per_px == pytest.approx(case.gsd_m_per_px, rel=0.03)
    assert not case.code or case.code in outcome.codes


@pytest.mark.parametrize(
    ("name", "surface"),
    [(name, surface) for name, case in CASES.items() for surface in case.surfaces],
)
async def test_facts_count_alike_on_all_surfaces(
    name: str,
    surface: str,
    in_python: Callable[[str], Outcome],
    images: Path,
    detector_path: Path,
    server: MCPServer[object],
    address: Address,
    tmp_path: Path,
) -> None:
    case = CASES[name]
    image = images / case.image
    expected = in_python(name)
    match surface:
        case "command":
            outcome = _by_command(image, detector_path, case.facts)
        case "batch":
            outcome = _by_batch(image, detector_path, case.facts, tmp_path)
        case "mcp":
            outcome = await _by_mcp(server, image, case.facts)
        case _:
            outcome = _by_page(address, image, case.facts)
    assert outcome.status == expected.status
    assert outcome.gsd_m_per_px == pytest.approx(expected.gsd_m_per_px, rel=1e-3)
    assert outcome.confidence == pytest.approx(expected.confidence, abs=0.01)
    assert outcome.codes == expected.codes


@pytest.mark.parametrize(
    "name", ["the file's scale as a guessed line", "the file's height as a guess"]
)
def test_a_guess_that_repeats_the_file_adds_next_to_nothing(
    name: str, images: Path, detector_path: Path
) -> None:
    case = CASES[name]
    image = images / case.image
    alone = _by_python(image, detector_path, {})
    beside = _by_python(image, detector_path, case.facts)
    assert beside.confidence - alone.confidence <= 0.03
    assert beside.gsd_m_per_px == pytest.approx(alone.gsd_m_per_px, rel=0.03)


def test_a_line_in_parts_counts_as_one_line(images: Path, detector_path: Path) -> None:
    image = images / "cars.png"
    once = _by_python(image, detector_path, _lines([LINE]))
    parts = _by_python(image, detector_path, _lines(PARTS))
    assert parts.status == once.status
    assert parts.gsd_m_per_px == pytest.approx(once.gsd_m_per_px, rel=0.01)
    assert parts.confidence == pytest.approx(once.confidence, abs=0.01)


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
