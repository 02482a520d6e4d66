"""The running track of docs/how-to/add-a-ruler.md is a ruler with one file and one line."""

from __future__ import annotations

import os
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
from vehanchor.records import GsdEstimate, Notice
from vehanchor.records.flat import flat_row
from vehanchor.records.ruler_registry import RULERS
from vehanchor.rulers.active import ruler_class
from vehanchor.rulers.ruler import View
from vehanchor_flight.records import FlightEstimate
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
    """Register the class of the how-to."""
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
    fields = Objects(
        np.array([[*CENTRE, LENGTH_PX, width_px, ANGLE]]), np.array([score]), np.array([1])
    )
    no_vehicles = Detections(np.zeros((0, 5)), np.zeros(0), others=fields)
    card = made_card().model_copy(update={"class_names": {0: "small-vehicle", 1: name}})
    view = View(
        ImageFacts(1000, 800, camera=camera),
        no_vehicles,
        card=card,
        options=ScaleOptions.of(options),
        measure_detail_share=lambda *_: 1.0,
    )
    return analyse_view(with_tilt(view))


@pytest.mark.usefixtures("track")
def test_a_running_track_scales_an_image_without_cars() -> None:
    record = _analysed().estimate
    assert record.gsd_m_per_px == pytest.approx(GSD, rel=0.005)
    assert (record.leading_ruler, record.n_vehicles) == ("track", 0)


@pytest.mark.usefixtures("track")
def test_the_record_describes_the_running_track() -> None:
    ruler = _analysed().estimate.rulers[0]
    assert (ruler.label, ruler.sets_scale) == ("running track", True)
    assert ruler.explanation is not None
    assert ruler.explanation.startswith("A running track of 800 px gives 0.2211 m/px")


@pytest.mark.usefixtures("track")
@pytest.mark.parametrize(
    "other", [{"width_px": 300.0}, {"name": "soccer-ball-field"}, {"score": 0.3}]
)
def test_another_field_is_not_a_ruler(other: dict[str, Any]) -> None:
    record = _analysed(**other).estimate
    assert (record.status, record.gsd_m_per_px) == ("no_scale", None)


@pytest.fixture
def without_plane(track: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(track, "uses_plane", False)


def _warnings(record: GsdEstimate) -> list[Notice]:
    return [warning for warning in record.warnings if "running track" in warning.message]


@pytest.mark.usefixtures("without_plane")
def test_a_ruler_without_the_plane_gives_no_evidence_of_a_tilted_image() -> None:
    record = _analysed(camera=TILTED).estimate
    assert (record.status, record.gsd_m_per_px, record.rulers) == ("no_scale", None, ())


@pytest.mark.usefixtures("without_plane")
def test_a_warning_names_the_ruler_without_the_plane() -> None:
    (warning,) = _warnings(_analysed(camera=TILTED).estimate)
    assert warning.code == "camera_tilted"
    assert warning.message.startswith(
        "The camera was tilted by 40 degrees: the ruler running track is left out"
    )


@pytest.mark.usefixtures("without_plane")
def test_a_ruler_that_is_not_in_the_image_has_no_warning() -> None:
    assert not _warnings(_analysed(300.0, camera=TILTED).estimate)


@pytest.fixture
def detector(tmp_path: Path) -> Path:
    """Detector that knows running tracks."""
    return write_track_detector(tmp_path / "tracks.onnx")


@pytest.fixture
def photograph(tmp_path: Path) -> Path:
    """Photograph of a running track, 200 px long, without cars."""
    return write_track(tmp_path / "photographs" / "track.png")


TRACK_GSD = 176.91 / 200


def _estimate(photograph: Path, detector: Path) -> GsdEstimate:
    return vehanchor.estimate_gsd(photograph, detector=str(detector), rulers=("track",))


@pytest.mark.usefixtures("track")
def test_the_verb_searches_for_the_ruler(detector: Path, photograph: Path) -> None:
    record = _estimate(photograph, detector)
    assert (record.leading_ruler, record.n_vehicles) == ("track", None)
    assert record.details.tiles_searched == 1
    assert record.gsd_m_per_px == pytest.approx(TRACK_GSD, rel=0.02)


@pytest.mark.usefixtures("track")
def test_the_row_of_a_record_has_a_column_of_the_ruler(detector: Path, photograph: Path) -> None:
    record = _estimate(photograph, detector)
    assert flat_row(record)["ruler_track_gsd_m_per_px"] == record.rulers[0].gsd_m_per_px


@pytest.mark.usefixtures("track")
def test_the_schema_of_the_record_names_the_ruler() -> None:
    schema = GsdEstimate.model_json_schema()
    assert "track" in schema["$defs"]["RulerScale"]["properties"]["kind"]["enum"]


@pytest.mark.usefixtures("track")
def test_a_record_with_the_ruler_can_be_read_again(detector: Path, photograph: Path) -> None:
    record = _estimate(photograph, detector)
    assert GsdEstimate.model_validate_json(record.model_dump_json()) == record


@pytest.mark.usefixtures("track")
def test_a_flight_pools_the_ruler(detector: Path, photograph: Path) -> None:
    flight = _flight_of_two(photograph, detector)
    assert flight.gsd_m_per_px == pytest.approx(TRACK_GSD, rel=0.02)
    assert flight.photographs[0].supported_by[0].ruler == "track"


@pytest.mark.usefixtures("track")
def test_a_flight_pools_the_error_as_the_class_states(detector: Path, photograph: Path) -> None:
    pooled = _flight_of_two(photograph, detector).components[0].pooled
    assert pooled is not None
    single = _estimate(photograph, detector)
    # Two photographs count as 2 ** 0.5.
    ratio = _interval_width(single) / _interval_width(pooled)
    assert ratio == pytest.approx(2**0.25, rel=0.05)


def _flight_of_two(photograph: Path, detector: Path) -> FlightEstimate:
    # A copy would show the same ground, which counts once.
    other = photograph.with_name("other.png")
    with Image.open(photograph) as picture:
        picture.transpose(Image.Transpose.FLIP_TOP_BOTTOM).save(other)
    return estimate_flight(
        [photograph, other], same_scale=True, detector=str(detector), rulers=("track",)
    )


def _interval_width(record: Any) -> float:
    low = record.gsd_ci95_low_m_per_px
    high = record.gsd_ci95_high_m_per_px
    return float(np.log(high / low))


@pytest.mark.slow
@pytest.mark.anyio
async def test_a_server_measures_with_the_ruler_of_an_installed_package(
    detector: Path, photograph: Path, tmp_path: Path
) -> None:
    root = ("--root", str(photograph.parent))
    serve = ["-m", "vehanchor", "serve", *root, "--detector", str(detector)]
    environment = install_track(tmp_path / "installed")
    server = StdioServerParameters(command=sys.executable, args=serve, env=environment)
    async with Client(server) as client:
        result = await client.call_tool("estimate_gsd", by_path(photograph))
    record = GsdEstimate.model_validate(result.structured_content)
    assert (record.leading_ruler, record.n_vehicles) == ("track", 0)
    assert "running track" in [ruler.label for ruler in record.rulers]
    assert record.gsd_m_per_px == pytest.approx(TRACK_GSD, rel=0.02)
    assert "running track" in text_of(result)


SHAPE = 92.52 / 176.91
TRACK_PX = 200.0


def _block_with(text: str) -> str:
    """Return the only block of the how-to that contains a text."""
    document = blocks(ROOT / "docs/how-to/add-a-ruler.md")
    (block,) = [block for block in document if text in block.text]
    return block.text


def track_code() -> str:
    """Return the module of the how-to."""
    return _block_with("class Track")


def install_track(folder: Path) -> dict[str, str]:
    """Install the package in a folder; return the variables of a process that finds it there."""
    entry = _block_with('"vehanchor.rulers"')
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
    paths = [str(folder), *(path for path in sys.path if path)]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}


def write_track_detector(path: Path) -> Path:
    """Write a detector that knows running tracks."""
    return write_detector(path, names={0: "small-vehicle", 1: "ground-track-field"})


def write_track(path: Path) -> Path:
    """Write a photograph of a running track, 200 px long, without cars."""
    image = blank_image(400, 400)
    track = np.array([[200, 200, TRACK_PX, TRACK_PX * SHAPE, 0.0]])
    paint_vehicles(image, track, classes=[1])
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)
    return path
