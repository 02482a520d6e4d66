"""The running track of docs/how-to/add-a-ruler.md: one file and one line in the registry make a ruler."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from mcp import Client, StdioServerParameters
from PIL import Image

import vehanchor
from tests.analyses import made_card, with_tilt
from tests.conftest import ROOT
from tests.docs.documents import blocks
from tests.models import blank_image, paint_vehicles, write_detector
from tests.server.conversation import by_path, text_of
from vehanchor.analysis.pipeline import analyse_view
from vehanchor.analysis.scale_analysis import ScaleAnalysis
from vehanchor.detection.detections import Detections, Objects
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.options import ScaleOptions
from vehanchor.records import GsdEstimate
from vehanchor.records.flat import flat_row
from vehanchor.records.ruler_registry import RULERS
from vehanchor.rulers.active import ruler_class
from vehanchor.rulers.ruler import View
from vehanchor_flight.verbs import estimate_flight

LENGTH_PX = 800.0
GSD = 176.91 / 800.0
WIDTH_PX = LENGTH_PX * 92.52 / 176.91
CENTRE = np.array([500.0, 400.0])
ANGLE = 0.3
TILTED = CameraMetadata(
    focal_px=900.0, taken_width_px=1000, taken_height_px=800, off_nadir_deg=40.0
)


@pytest.fixture
def track(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The class of the how-to, registered."""
    module = ModuleType("track_of_the_docs")
    exec(compile(track_code(), "track.py", "exec"), module.__dict__)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setitem(RULERS, "track", f"{module.__name__}:Track")
    return ruler_class("track")


def _analysed(
    width_px: float = WIDTH_PX,
    name: str = "ground-track-field",
    score: float = 0.9,
    camera: CameraMetadata | None = None,
    **options: Any,
) -> ScaleAnalysis:
    seen = Objects(
        np.array([[*CENTRE, LENGTH_PX, width_px, ANGLE]]), np.array([score]), np.array([1])
    )
    found = Detections(np.zeros((0, 5)), np.zeros(0), others=seen)
    card = made_card().model_copy(update={"class_names": {0: "small-vehicle", 1: name}})
    facts = ImageFacts(1000, 800, camera=camera)
    return analyse_view(
        with_tilt(
            View(
                facts,
                found,
                card=card,
                options=ScaleOptions.of(options),
                measure_detail_share=lambda *_: 1.0,
            )
        )
    )


@pytest.mark.usefixtures("track")
def test_a_running_track_makes_the_scale_of_an_image_without_cars() -> None:
    record = _analysed().estimate
    assert record.gsd_m_per_px == pytest.approx(GSD, rel=0.005)
    assert (record.leading_ruler, record.n_vehicles) == ("track", 0)
    assert (record.rulers[0].label, record.rulers[0].sets_scale) == ("running track", True)
    assert record.rulers[0].explanation is not None
    assert record.rulers[0].explanation.startswith("A running track of 800 px gives 0.2211 m/px")


@pytest.mark.usefixtures("track")
@pytest.mark.parametrize(
    "other", [{"width_px": 300.0}, {"name": "soccer-ball-field"}, {"score": 0.3}]
)
def test_another_field_is_no_ruler(other: dict[str, Any]) -> None:
    record = _analysed(**{"width_px": WIDTH_PX, **other}).estimate
    assert (record.status, record.gsd_m_per_px) == ("no_scale", None)


def test_a_ruler_that_cannot_use_the_plane_gives_no_evidence_on_a_tilted_photograph(
    track: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(track, "uses_plane", False)
    record = _analysed(camera=TILTED).estimate
    assert (record.status, record.gsd_m_per_px, record.rulers) == ("no_scale", None, ())
    (warning,) = (each for each in record.warnings if "running track" in each.message)
    assert warning.code == "camera_tilted"
    assert warning.message.startswith(
        "The camera was tilted by 40 degrees: the ruler running track is left out"
    )
    assert not any(
        "running track" in each.message
        for each in _analysed(300.0, camera=TILTED).estimate.warnings
    )


@pytest.fixture
def detector(tmp_path: Path) -> Path:
    """A detector that knows running tracks."""
    return write_track_detector(tmp_path / "tracks.onnx")


@pytest.fixture
def photograph(tmp_path: Path) -> Path:
    """A photograph of a running track, 200 px long, and of no car."""
    return write_track(tmp_path / "photographs" / "track.png")


@pytest.mark.usefixtures("track")
def test_the_verb_searches_for_it_and_the_record_its_table_and_its_schema_name_it(
    detector: Path, photograph: Path
) -> None:
    record = vehanchor.estimate_gsd(photograph, detector=str(detector), rulers=("track",))
    assert (record.leading_ruler, record.n_vehicles, record.details.tiles_searched) == (
        "track",
        None,
        1,
    )
    assert record.gsd_m_per_px == pytest.approx(176.91 / 200, rel=0.02)
    assert flat_row(record)["ruler_track_gsd_m_per_px"] == record.rulers[0].gsd_m_per_px
    assert (
        "track"
        in GsdEstimate.model_json_schema()["$defs"]["RulerScale"]["properties"]["kind"]["enum"]
    )
    assert GsdEstimate.model_validate_json(record.model_dump_json()) == record


@pytest.mark.usefixtures("track")
def test_a_flight_pools_it_and_its_error_as_the_class_says(
    detector: Path, photograph: Path
) -> None:
    again = photograph.with_name("again.png")
    shutil.copy(photograph, again)
    flight = estimate_flight(
        [photograph, again], same_scale=True, detector=str(detector), rulers=("track",)
    )
    assert flight.gsd_m_per_px == pytest.approx(176.91 / 200, rel=0.02)
    assert flight.photographs[0].supported_by[0].ruler == "track"
    one = vehanchor.estimate_gsd(photograph, detector=str(detector), rulers=("track",))
    both = flight.components[0].pooled
    widths = [
        np.log(each.gsd_ci95_high_m_per_px / each.gsd_ci95_low_m_per_px)
        for each in (one, both)
        if each.gsd_ci95_high_m_per_px and each.gsd_ci95_low_m_per_px
    ]
    # two photographs count as 2 ** 0.5
    assert widths[0] / widths[1] == pytest.approx(2**0.25, rel=0.05)


@pytest.mark.slow
@pytest.mark.anyio
async def test_a_server_and_its_workers_measure_with_the_ruler_of_an_installed_package(
    detector: Path, photograph: Path, tmp_path: Path
) -> None:
    serve = [
        "-m",
        "vehanchor",
        "serve",
        "--root",
        str(photograph.parent),
        "--detector",
        str(detector),
    ]
    environment = install_track(tmp_path / "installed")
    server = StdioServerParameters(command=sys.executable, args=serve, env=environment)
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", by_path(photograph))
    record = GsdEstimate.model_validate(result.structured_content)
    assert (record.leading_ruler, record.n_vehicles) == ("track", 0)
    assert "running track" in [ruler.label for ruler in record.rulers]
    assert record.gsd_m_per_px == pytest.approx(176.91 / 200, rel=0.02)
    assert "running track" in text_of(result)


SHAPE = 92.52 / 176.91
TRACK_PX = 200.0


def track_code() -> str:
    """The module of the how-to."""
    (text,) = (
        block.text
        for block in blocks(ROOT / "docs/how-to/add-a-ruler.md")
        if "class Track" in block.text
    )
    return text


def install_track(folder: Path) -> dict[str, str]:
    """Install the package in a folder; the environment of a process that finds it there."""
    (entry,) = (
        block.text
        for block in blocks(ROOT / "docs/how-to/add-a-ruler.md")
        if '"vehanchor.rulers"' in block.text
    )
    assert entry.splitlines() == [
        '[project.entry-points."vehanchor.rulers"]',
        'track = "tracks:Track"',
    ]
    facts = folder / "tracks-1.0.dist-info"
    facts.mkdir(parents=True)
    (folder / "tracks.py").write_text(track_code(), encoding="utf-8")
    (facts / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: tracks\nVersion: 1.0\n", encoding="utf-8"
    )
    (facts / "entry_points.txt").write_text(
        "[vehanchor.rulers]\ntrack = tracks:Track\n", encoding="utf-8"
    )
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *filter(None, sys.path)])}


def write_track_detector(path: Path) -> Path:
    """A detector that knows running tracks."""
    return write_detector(path, names={0: "small-vehicle", 1: "ground-track-field"})


def write_track(path: Path) -> Path:
    """A photograph of a running track, 200 px long, and of no car."""
    image = blank_image(400, 400)
    paint_vehicles(image, np.array([[200, 200, TRACK_PX, TRACK_PX * SHAPE, 0.0]]), classes=[1])
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)
    return path
