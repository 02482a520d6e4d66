from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.analyses import measured_fleet
from tests.flight.reconstruction.flights import Pose, write_opensfm
from tests.models import write_detector
from vehanchor.detection.detector import Detector
from vehanchor.errors import ReconstructionError
from vehanchor.options import ScaleOptions
from vehanchor_flight.reconstruction.estimate import verdict
from vehanchor_flight.reconstruction.files import read_model
from vehanchor_flight.verbs import rescale

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor_flight.records import ModelScale

LENGTHS = 4.8 * (1 + 0.06 * np.linspace(-1, 1, 12) ** 3)
OPTIONS = ScaleOptions.of(
    {"calibration": measured_fleet(4.8), "rulers": ("vehicles", "known_length")}
)
GRID = [Pose(80, 80, 70), Pose(110, 85, 70, 8, 100), Pose(95, 105, 70, 30, 250)]
NO_CARS = np.zeros((0, 4))


def _cars() -> NDArray[np.float64]:
    rng = np.random.default_rng(1)
    places = [(80 + 9 * (k % 4), 80 + 9 * (k // 4)) for k in range(12)]
    return np.column_stack([places, LENGTHS, rng.uniform(0, np.pi, 12)])


def _write_project(
    folder: Path,
    cars: NDArray[np.float64],
    poses: Sequence[Pose] = GRID,
    metres_per_unit: float = 1.0,
) -> Path:
    """Photograph cars, and write the model; return its file."""
    photographs = [pose.painted(cars) for pose in poses]
    return write_opensfm(
        folder / "project", photographs, poses=poses, metres_per_unit=metres_per_unit
    )


def _rescaled(folder: Path, **options: Any) -> ModelScale:
    """Rescale the model of a folder."""
    model = read_model(folder / "project")
    detector = Detector(write_detector(folder / "detector.onnx"))
    return rescale(model, OPTIONS, detector=detector, **options)


METRES_PER_UNIT = 13.0


@pytest.fixture(scope="module")
def scaled(tmp_path_factory: pytest.TempPathFactory) -> ModelScale:
    """Rescale a model of three views of the same cars, one of them oblique."""
    folder = tmp_path_factory.mktemp("scaled")
    _write_project(folder, _cars(), metres_per_unit=METRES_PER_UNIT)
    return _rescaled(folder)


def test_the_factor_is_that_of_the_model_whatever_the_views(scaled: ModelScale) -> None:
    assert scaled.factor == pytest.approx(METRES_PER_UNIT, rel=0.015)
    assert scaled.factor_ci95_low is not None
    assert scaled.factor_ci95_high is not None
    assert scaled.factor_ci95_low < METRES_PER_UNIT < scaled.factor_ci95_high


def test_a_car_in_three_photographs_counts_once(scaled: ModelScale) -> None:
    assert scaled.n_vehicles == 12


def test_photographs_have_the_poses_of_the_model(scaled: ModelScale) -> None:
    tilts = [round(photograph.tilt_deg or 0) for photograph in scaled.photographs]
    heights = [photograph.camera_height for photograph in scaled.photographs]
    assert tilts == [0, 8, 30]
    assert heights == pytest.approx([70 / METRES_PER_UNIT] * 3, rel=0.01)


def test_a_photograph_of_longer_things_is_an_outlier(tmp_path: Path) -> None:
    places = [(500 + 20 * (k % 3), 500 + 15 * (k // 3)) for k in range(9)]
    lorries = np.column_stack([places, [14.0] * 9, [0.3] * 9])
    poses = [*GRID, Pose(520, 515, 70)]
    _write_project(tmp_path, np.concatenate([_cars(), lorries]), poses=poses)
    record = _rescaled(tmp_path)
    assert record.photographs[-1].status == "outlier"
    assert record.factor == pytest.approx(1.0, rel=0.02)


def test_lines_are_measured_where_the_photograph_shows_them(tmp_path: Path) -> None:
    # The second photograph looks at y = 85.
    poses = [GRID[1], Pose(98, 125, 70, 30)]
    _write_project(tmp_path, NO_CARS, poses=poses, metres_per_unit=1 / 0.92)
    line_on_ground = np.array([[97.0, 78.0], [110.0, 85.0]])
    length_m = np.hypot(13, 7)
    rows = ["file,x1,y1,x2,y2,metres,basis"]
    for number, pose in enumerate(poses):
        ends = ",".join(f"{value:.2f}" for value in pose.pixels(line_on_ground).ravel())
        rows.append(f"images/{number}.png,{ends},{length_m:.3f},measured")
    table = tmp_path / "project" / "lines.csv"
    table.write_text("\n".join(rows))
    record = _rescaled(tmp_path, known_lengths_table=table)
    assert record.factor == pytest.approx(1 / 0.92, rel=0.01)
    assert [ruler.kind for ruler in record.rulers] == ["known_length"]


def test_nothing_of_known_size_gives_no_factor(tmp_path: Path) -> None:
    _write_project(tmp_path, NO_CARS)
    record = _rescaled(tmp_path)
    assert record.status == "no_scale"
    assert record.factor is None
    assert "nothing of known size" in record.verdict


def test_the_other_photographs_count_if_one_is_missing(tmp_path: Path) -> None:
    file = _write_project(tmp_path, _cars())
    (file.parent / "images" / "1.png").unlink()
    record = _rescaled(tmp_path)
    codes = [photograph.error_code for photograph in record.photographs]
    assert codes == [None, "image_not_found", None]
    assert record.factor == pytest.approx(1.0, rel=0.02)


def test_a_folder_without_photographs_is_refused(tmp_path: Path) -> None:
    _write_project(tmp_path, _cars())
    with pytest.raises(ReconstructionError, match="--images"):
        _rescaled(tmp_path, images=tmp_path)


def test_names_cannot_leave_the_folder(tmp_path: Path) -> None:
    file = _write_project(tmp_path, _cars(), poses=GRID[:1])
    parts = json.loads(file.read_text())
    shots = parts[0]["shots"]
    shots["../secret.png"] = shots.pop("0.png")
    file.write_text(json.dumps(parts))
    detector = write_detector(tmp_path / "detector.onnx")
    with pytest.raises(ReconstructionError, match="relative to one folder"):
        rescale(file, OPTIONS, images=tmp_path, detector=detector)


@pytest.mark.parametrize(
    ("factor", "words"),
    [
        (
            (1.087, 1.06, 1.11),
            "The model is 8.0 % too small, +- 2.3 %: multiply its lengths by 1.087.",
        ),
        (
            (0.9, 0.88, 0.92),
            "The model is 11.1 % too large, +- 2.2 %: multiply its lengths by 0.9.",
        ),
        ((1.01, 0.98, 1.04), "The model has its size: 1.0 % too small, +- 3 %."),
        ((12.5, 12, 13), "One unit of the model is 12.5 m, +- 4 %."),
    ],
)
def test_the_verdict_is_one_sentence(factor: tuple[float, float, float], words: str) -> None:
    assert verdict(*factor, usable=True) == words
    assert verdict(*factor, usable=False).startswith("Uncertain, do not use: ")
