"""Metadata of a model's photographs: the orientation of the stored pixels, and positions."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.analyses import measured_fleet
from tests.flight.reconstruction.flights import HEIGHT_PX, WIDTH_PX, Pose, write_opensfm
from tests.models import write_detector
from tests.skill.imagery.files import after_head, encoded, exif, png_chunk
from vehanchor.detection.detector import Detector
from vehanchor.options import ScaleOptions
from vehanchor_flight.reconstruction.files import read_model
from vehanchor_flight.records import ModelScale
from vehanchor_flight.verbs import rescale

METRES_PER_UNIT = 12.5
LENGTHS = 4.8 * (1 + 0.06 * np.linspace(-1, 1, 12) ** 3)
BY_CARS = ScaleOptions.of(
    {"calibration": measured_fleet(4.8), "rulers": ("vehicles", "known_length")}
)
OBLIQUE = [Pose(98, 125, 70, 30)]
FLIGHT = [Pose(60, 60, 70), Pose(100, 62, 72, 8, 100), Pose(95, 105, 70, 20, 250)]
METRES_A_DEGREE = 111_195.0


def _cars() -> NDArray[np.float64]:
    rng = np.random.default_rng(1)
    places = [(80 + 9 * (k % 4), 80 + 9 * (k // 4)) for k in range(12)]
    return np.column_stack([places, LENGTHS, rng.uniform(0, np.pi, 12)])


def _project(
    folder: Path, poses: Sequence[Pose], tags: Sequence[dict[str, Any]], *, on_earth: bool = True
) -> Path:
    """Write a model of painted photographs with these EXIF tags."""
    photographs = [pose.painted(_cars()) for pose in poses]
    file = write_opensfm(
        folder / "project", photographs, poses=poses, metres_per_unit=METRES_PER_UNIT
    )
    for number, own_tags in enumerate(tags):
        image = file.parent / "images" / f"{number}.png"
        image.write_bytes(after_head(image.read_bytes(), png_chunk(b"eXIf", exif(own_tags))))
    if not on_earth:
        parts = json.loads(file.read_text())
        del parts[0]["reference_lla"]
        file.write_text(json.dumps(parts))
    return file


def _rescaled(folder: Path, options: ScaleOptions = BY_CARS, **more: Any) -> ModelScale:
    model = read_model(folder / "project")
    detector = Detector(write_detector(folder / "detector.onnx"))
    return rescale(model, options, detector=detector, **more)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_model_counts_stored_pixels(tmp_path: Path, orientation: int) -> None:
    _project(tmp_path, OBLIQUE, [{"Orientation": orientation}])
    record = _rescaled(tmp_path)
    assert record.factor == pytest.approx(METRES_PER_UNIT, rel=0.015)
    assert [photograph.tilt_deg for photograph in record.photographs] == pytest.approx([30], abs=1)


def test_a_model_of_turned_copies_counts_upright_pixels(tmp_path: Path) -> None:
    """The camera of the model has the size of the upright photograph, and not of the stored one."""
    file = _project(tmp_path, OBLIQUE, [{"Orientation": 6}])
    image = file.parent / "images" / "0.png"
    stored = np.rot90(OBLIQUE[0].painted(_cars()), 1)
    data = encoded(".png", np.ascontiguousarray(stored))
    image.write_bytes(after_head(data, png_chunk(b"eXIf", exif({"Orientation": 6}))))
    assert _rescaled(tmp_path).factor == pytest.approx(METRES_PER_UNIT, rel=0.015)


@pytest.mark.parametrize("orientation", [3, 6, 5])
def test_lines_are_drawn_in_the_upright_picture(tmp_path: Path, orientation: int) -> None:
    file = _project(tmp_path, OBLIQUE, [{"Orientation": orientation}])
    ends = OBLIQUE[0].pixels(np.array([[97.0, 78.0], [110.0, 85.0]]))
    upright = {
        3: np.array([WIDTH_PX, HEIGHT_PX]) - ends,
        6: np.column_stack([HEIGHT_PX - ends[:, 1], ends[:, 0]]),
        5: ends[:, ::-1],
    }[orientation]
    coordinates = ",".join(f"{value:.2f}" for value in upright.ravel())
    table = file.parent / "lines.csv"
    table.write_text(
        "file,x1,y1,x2,y2,metres,basis\n"
        f"images/0.png,{coordinates},{np.hypot(13, 7):.3f},measured\n"
    )
    only_lines = ScaleOptions.of({"rulers": ("known_length",)})
    record = _rescaled(tmp_path, only_lines, known_lengths_table=table)
    assert record.factor == pytest.approx(METRES_PER_UNIT, rel=0.01)


def _degrees(value: float) -> tuple[int, ...]:
    return (round(value * 10_000_000), 10_000_000, 0, 1, 0, 1)


def _position(pose: Pose, factor: float = 1.0) -> dict[str, Any]:
    latitude = 46.0 - factor * pose.y_m / METRES_A_DEGREE
    longitude = 7.0 + factor * pose.x_m / (METRES_A_DEGREE * np.cos(np.radians(46.0)))
    return {
        "GPSLatitudeRef": "N",
        "GPSLatitude": _degrees(latitude),
        "GPSLongitudeRef": "E",
        "GPSLongitude": _degrees(float(longitude)),
    }


POSITIONS = [_position(pose) for pose in FLIGHT]
BY_POSITIONS = ScaleOptions.of({"rulers": ("positions",)})


@pytest.mark.parametrize("on_earth", [False, True])
def test_positions_that_are_asked_for_give_a_model_its_size(tmp_path: Path, on_earth: bool) -> None:
    _project(tmp_path, FLIGHT, POSITIONS, on_earth=on_earth)
    record = _rescaled(tmp_path, BY_POSITIONS)
    assert [ruler.kind for ruler in record.rulers] == ["positions"]
    assert record.factor == pytest.approx(METRES_PER_UNIT, rel=0.01)
    assert record.status == "ok"


@pytest.mark.parametrize(
    ("on_earth", "kinds"), [(False, {"vehicles", "positions"}), (True, {"vehicles"})]
)
def test_positions_that_made_the_size_do_not_confirm_it(
    tmp_path: Path, on_earth: bool, kinds: set[str]
) -> None:
    _project(tmp_path, FLIGHT, POSITIONS, on_earth=on_earth)
    record = _rescaled(tmp_path, ScaleOptions.of({"calibration": measured_fleet(4.8)}))
    assert {ruler.kind for ruler in record.rulers} == kinds
    assert record.factor == pytest.approx(METRES_PER_UNIT, rel=0.02)


def test_positions_of_another_flight_are_no_ruler(tmp_path: Path) -> None:
    other = [_position(Pose(60, 60, 70)), _position(Pose(60, 30, 70)), _position(Pose(10, 62, 70))]
    _project(tmp_path, FLIGHT, other, on_earth=False)
    record = _rescaled(tmp_path, BY_POSITIONS)
    assert record.status == "no_scale"
