from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.flight.reconstruction.flights import Pose, write_opensfm
from tests.models import write_detector
from vehanchor.analysis.pipeline import search_raster
from vehanchor.detection.detector import Detector
from vehanchor.engine import Engine
from vehanchor.errors import InvalidParameterError, ReconstructionError
from vehanchor.options import ScaleOptions
from vehanchor_flight.reconstruction import photograph
from vehanchor_flight.reconstruction.files import read_model
from vehanchor_flight.verbs import rescale

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from vehanchor_flight.records import ModelScale

LENGTHS = 4.8 * (1 + 0.06 * np.linspace(-1, 1, 12) ** 3)
OPTIONS = ScaleOptions.of({"reference_length_m": 4.8})
GRID = [Pose(x, y, 70, tilt, yaw) for x, y, tilt, yaw in ((80, 80, 0, 0), (110, 85, 8, 100), (95, 105, 30, 250))]


def _cars() -> np.ndarray:
    rng = np.random.default_rng(1)
    places = [(80 + 9 * (k % 4), 80 + 9 * (k // 4)) for k in range(12)]
    return np.column_stack([places, LENGTHS, rng.uniform(0, np.pi, 12)])


def _rescaled(folder: Path, poses: Sequence[Pose], metres_per_unit: float, cars: np.ndarray) -> ModelScale:
    write_opensfm(folder / "project", [pose.painted(cars) for pose in poses], poses, metres_per_unit)
    model = read_model(folder / "project")
    return rescale(model, OPTIONS, detector=Detector(write_detector(folder / "detector.onnx")))


@pytest.mark.parametrize("metres_per_unit", [1 / 0.92, 1.0, 13.0])
def test_the_factor_is_that_of_the_model_whatever_the_views(tmp_path: Path, metres_per_unit: float) -> None:
    record = _rescaled(tmp_path, GRID, metres_per_unit, _cars())
    assert record.factor == pytest.approx(metres_per_unit, rel=0.015)
    assert record.n_vehicles == 12  # each car counts once, although three photographs show it
    assert record.factor_ci95_low is not None
    assert record.factor_ci95_high is not None
    assert record.factor_ci95_low < metres_per_unit < record.factor_ci95_high
    assert [round(each.tilt_deg or 0) for each in record.photographs] == [0, 8, 30]
    assert [each.camera_height for each in record.photographs] == pytest.approx([70 / metres_per_unit] * 3, rel=0.01)


def test_a_photograph_of_longer_things_is_an_outlier(tmp_path: Path) -> None:
    lorries = np.column_stack([[(500 + 20 * (k % 3), 500 + 15 * (k // 3)) for k in range(9)], [14.0] * 9, [0.3] * 9])
    poses = [*GRID, Pose(520, 515, 70)]
    record = _rescaled(tmp_path, poses, 1.0, np.concatenate([_cars(), lorries]))
    assert [each.status for each in record.photographs][-1] == "outlier"
    assert record.factor == pytest.approx(1.0, rel=0.02)


def test_lines_are_measured_where_the_photograph_shows_them(tmp_path: Path) -> None:
    poses = [GRID[1], Pose(98, 125, 70, 30)]  # the second looks at y = 85
    write_opensfm(tmp_path / "project", [pose.painted(np.zeros((0, 4))) for pose in poses], poses, 1 / 0.92)
    rows = ["file,x1,y1,x2,y2,metres,basis"]
    for number, pose in enumerate(poses):
        ends = pose.pixels(np.array([[97.0, 78.0], [110.0, 85.0]])).ravel()
        rows.append(f"images/{number}.png,{','.join(f'{each:.2f}' for each in ends)},{np.hypot(13, 7):.3f},measured")
    (tmp_path / "project" / "lines.csv").write_text("\n".join(rows))
    model = read_model(tmp_path / "project")
    detector = Detector(write_detector(tmp_path / "detector.onnx"))
    record = rescale(model, OPTIONS, detector=detector, known_lengths_table=tmp_path / "project" / "lines.csv")
    assert record.factor == pytest.approx(1 / 0.92, rel=0.01)
    assert [ruler.kind for ruler in record.rulers] == ["known_length"]


def test_nothing_of_known_size_gives_no_factor(tmp_path: Path) -> None:
    record = _rescaled(tmp_path, GRID, 1.0, np.zeros((0, 4)))
    assert (record.status, record.factor) == ("no_scale", None)
    assert "nothing of known size" in record.verdict


def test_a_missing_photograph_is_told_and_the_others_count(tmp_path: Path) -> None:
    file = write_opensfm(tmp_path / "project", [pose.painted(_cars()) for pose in GRID], GRID, 1.0)
    (file.parent / "images" / "1.png").unlink()
    model = read_model(file)
    detector = Detector(write_detector(tmp_path / "detector.onnx"))
    record = rescale(model, OPTIONS, detector=detector)
    assert [each.error_code for each in record.photographs] == [None, "image_not_found", None]
    assert record.factor == pytest.approx(1.0, rel=0.02)
    with pytest.raises(ReconstructionError, match="--images"):
        rescale(model, OPTIONS, images=tmp_path, detector=detector)


def test_an_interrupted_run_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_opensfm(tmp_path / "project", [pose.painted(_cars()) for pose in GRID], GRID, 1 / 0.92)
    engine, journal = Engine(write_detector(tmp_path / "detector.onnx")), tmp_path / "scale.journal"
    whole = rescale(tmp_path / "project", OPTIONS, engine=engine)

    def stop(done: int, _total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rescale(tmp_path / "project", OPTIONS, journal=journal, progress=stop, engine=engine)
    searched: list[object] = []

    def counted(*arguments: Any) -> Any:
        searched.append(arguments)
        return search_raster(*arguments)

    monkeypatch.setattr(photograph, "search_raster", counted)
    assert rescale(tmp_path / "project", OPTIONS, journal=journal, engine=engine) == whole
    assert len(searched) == 1
    assert not journal.exists()
    with pytest.raises(KeyboardInterrupt):
        rescale(tmp_path / "project", OPTIONS, journal=journal, progress=stop, engine=engine)
    write_opensfm(tmp_path / "other", [pose.painted(_cars()) for pose in GRID], GRID, 2.0)
    with pytest.raises(InvalidParameterError, match="unfinished run"):
        rescale(tmp_path / "other", OPTIONS, journal=journal, engine=engine)


def test_names_cannot_leave_the_folder(tmp_path: Path) -> None:
    file = write_opensfm(tmp_path / "project", [GRID[0].painted(_cars())], GRID[:1], 1.0)
    parts = json.loads(file.read_text())
    parts[0]["shots"]["../secret.png"] = parts[0]["shots"].pop("0.png")
    file.write_text(json.dumps(parts))
    with pytest.raises(ReconstructionError, match="relative to one folder"):
        rescale(file, OPTIONS, images=tmp_path, detector=write_detector(tmp_path / "detector.onnx"))
