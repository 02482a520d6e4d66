from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from tests.flight.reconstruction.flights import FOCAL_PX, HEIGHT_PX, WIDTH_PX, Pose, write_opensfm
from tests.models import write_detector
from vehanchor.detection.detector import Detector
from vehanchor.errors import ReconstructionError
from vehanchor.options import ScaleOptions
from vehanchor_flight.reconstruction.estimate import verdict
from vehanchor_flight.reconstruction.files import read_model
from vehanchor_flight.reconstruction.ground import local_heights, model_plane, plane_below
from vehanchor_flight.reconstruction.model import Lens, Reconstruction, Shot
from vehanchor_flight.verbs import rescale

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from vehanchor_flight.records import ModelScale

LENGTHS = 4.8 * (1 + 0.06 * np.linspace(-1, 1, 12) ** 3)
OPTIONS = ScaleOptions.of({"reference_length_m": 4.8, "rulers": ("vehicles", "known_length")})
GRID = [
    Pose(x, y, 70, tilt, yaw)
    for x, y, tilt, yaw in ((80, 80, 0, 0), (110, 85, 8, 100), (95, 105, 30, 250))
]


def _cars() -> np.ndarray:
    rng = np.random.default_rng(1)
    places = [(80 + 9 * (k % 4), 80 + 9 * (k // 4)) for k in range(12)]
    return np.column_stack([places, LENGTHS, rng.uniform(0, np.pi, 12)])


def _rescaled(
    folder: Path, poses: Sequence[Pose], metres_per_unit: float, cars: np.ndarray
) -> ModelScale:
    write_opensfm(
        folder / "project",
        [pose.painted(cars) for pose in poses],
        poses=poses,
        metres_per_unit=metres_per_unit,
    )
    model = read_model(folder / "project")
    return rescale(model, OPTIONS, detector=Detector(write_detector(folder / "detector.onnx")))


def test_the_factor_is_that_of_the_model_whatever_the_views(tmp_path: Path) -> None:
    metres_per_unit = 13.0
    record = _rescaled(tmp_path, GRID, metres_per_unit=metres_per_unit, cars=_cars())
    assert record.factor == pytest.approx(metres_per_unit, rel=0.015)
    assert record.n_vehicles == 12  # each car counts once, although three photographs show it
    assert record.factor_ci95_low is not None
    assert record.factor_ci95_high is not None
    assert record.factor_ci95_low < metres_per_unit < record.factor_ci95_high
    assert [round(each.tilt_deg or 0) for each in record.photographs] == [0, 8, 30]
    assert [each.camera_height for each in record.photographs] == pytest.approx(
        [70 / metres_per_unit] * 3, rel=0.01
    )


def test_a_photograph_of_longer_things_is_an_outlier(tmp_path: Path) -> None:
    lorries = np.column_stack(
        [[(500 + 20 * (k % 3), 500 + 15 * (k // 3)) for k in range(9)], [14.0] * 9, [0.3] * 9]
    )
    poses = [*GRID, Pose(520, 515, 70)]
    record = _rescaled(
        tmp_path, poses, metres_per_unit=1.0, cars=np.concatenate([_cars(), lorries])
    )
    assert [each.status for each in record.photographs][-1] == "outlier"
    assert record.factor == pytest.approx(1.0, rel=0.02)


def test_lines_are_measured_where_the_photograph_shows_them(tmp_path: Path) -> None:
    poses = [GRID[1], Pose(98, 125, 70, 30)]  # the second looks at y = 85
    write_opensfm(
        tmp_path / "project",
        [pose.painted(np.zeros((0, 4))) for pose in poses],
        poses=poses,
        metres_per_unit=1 / 0.92,
    )
    rows = ["file,x1,y1,x2,y2,metres,basis"]
    for number, pose in enumerate(poses):
        ends = pose.pixels(np.array([[97.0, 78.0], [110.0, 85.0]])).ravel()
        rows.append(
            f"images/{number}.png,{','.join(f'{each:.2f}' for each in ends)},{np.hypot(13, 7):.3f},measured"
        )
    (tmp_path / "project" / "lines.csv").write_text("\n".join(rows))
    model = read_model(tmp_path / "project")
    detector = Detector(write_detector(tmp_path / "detector.onnx"))
    record = rescale(
        model, OPTIONS, detector=detector, known_lengths_table=tmp_path / "project" / "lines.csv"
    )
    assert record.factor == pytest.approx(1 / 0.92, rel=0.01)
    assert [ruler.kind for ruler in record.rulers] == ["known_length"]


def test_nothing_of_known_size_gives_no_factor(tmp_path: Path) -> None:
    record = _rescaled(tmp_path, GRID, metres_per_unit=1.0, cars=np.zeros((0, 4)))
    assert (record.status, record.factor) == ("no_scale", None)
    assert "nothing of known size" in record.verdict


def test_a_missing_photograph_is_told_and_the_others_count(tmp_path: Path) -> None:
    file = write_opensfm(
        tmp_path / "project",
        [pose.painted(_cars()) for pose in GRID],
        poses=GRID,
        metres_per_unit=1.0,
    )
    (file.parent / "images" / "1.png").unlink()
    model = read_model(file)
    detector = Detector(write_detector(tmp_path / "detector.onnx"))
    record = rescale(model, OPTIONS, detector=detector)
    assert [each.error_code for each in record.photographs] == [None, "image_not_found", None]
    assert record.factor == pytest.approx(1.0, rel=0.02)
    with pytest.raises(ReconstructionError, match="--images"):
        rescale(model, OPTIONS, images=tmp_path, detector=detector)


def test_names_cannot_leave_the_folder(tmp_path: Path) -> None:
    file = write_opensfm(
        tmp_path / "project", [GRID[0].painted(_cars())], poses=GRID[:1], metres_per_unit=1.0
    )
    parts = json.loads(file.read_text())
    parts[0]["shots"]["../secret.png"] = parts[0]["shots"].pop("0.png")
    file.write_text(json.dumps(parts))
    with pytest.raises(ReconstructionError, match="relative to one folder"):
        rescale(file, OPTIONS, images=tmp_path, detector=write_detector(tmp_path / "detector.onnx"))


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


LENS = Lens(WIDTH_PX, HEIGHT_PX, FOCAL_PX, FOCAL_PX, WIDTH_PX / 2, HEIGHT_PX / 2)
RNG = np.random.default_rng(2)
GROUND = np.column_stack(
    [RNG.uniform(0, 100, 600), -RNG.uniform(0, 100, 600), RNG.normal(0, 0.1, 600)]
)
ROOF = np.column_stack(
    [RNG.uniform(20, 60, 900), -RNG.uniform(20, 60, 900), RNG.normal(20, 0.1, 900)]
)
FACE = np.column_stack([RNG.uniform(20, 60, 700), np.full(700, -60.0), RNG.uniform(0, 20, 700)])


def _shot(pose: Pose) -> Shot:
    return Shot("a", LENS, rotation=pose.rotation, translation=pose.translation)


def _model(*parts: np.ndarray) -> Reconstruction:
    shots = tuple(_shot(Pose(x, y, 60)) for x, y in ((30, 30), (60, 30), (40, 60)))
    return Reconstruction("opensfm", Path("a"), shots=shots, points=np.concatenate(parts))


def test_the_ground_lies_below_roofs_with_more_points_and_beside_faces() -> None:
    plane = model_plane(_model(GROUND, ROOF, FACE))
    assert plane.normal == pytest.approx([0, 0, 1], abs=0.01)
    assert plane.heights(np.array([[50.0, -50, 60]])) == pytest.approx([60], abs=0.5)
    shot = _shot(Pose(45, 75, 60, 20))
    points = np.concatenate([GROUND, ROOF, FACE])
    below = plane_below(shot, points[shot.sees(points)], plane)
    assert below.heights(shot.centre[None]) == pytest.approx([60], abs=1)


def test_a_slope_has_a_plane_of_its_own_below_each_shot() -> None:
    slope = GROUND + np.outer(0.15 * GROUND[:, 0], [0, 0, 1])
    shot = _shot(Pose(50, 50, 60))
    level = model_plane(_model(GROUND))
    plane = plane_below(shot, slope, level)
    assert plane.heights(shot.centre[None]) == pytest.approx(
        [(60 - 7.5) * np.cos(np.arctan(0.15))], abs=0.3
    )


@pytest.mark.timeout(60)
def test_two_slopes_of_a_hill_do_not_take_turns() -> None:
    hill = GROUND + np.outer(20 - 0.2 * np.abs(GROUND[:, 0] - 55), [0, 0, 1])
    shot = _shot(Pose(50, 50, 80))
    plane = plane_below(shot, hill, model_plane(_model(GROUND)))
    # one of the slopes
    assert abs(plane.normal[0]) == pytest.approx(math.sin(math.atan(0.2)), abs=0.02)


def test_faces_of_houses_are_no_ground() -> None:
    face = np.column_stack(
        [RNG.uniform(0, 100, 700), RNG.normal(-50, 0.02, 700), RNG.uniform(0, 40, 700)]
    )
    plane = plane_below(
        _shot(Pose(50, 50, 60)),
        np.concatenate([face, face - [0, 30, 0]]),
        model_plane(_model(GROUND)),
    )
    assert plane.normal[2] >= math.cos(math.radians(15))


def test_points_around_a_car_raise_its_ground() -> None:
    plane = model_plane(_model(GROUND))
    bump = np.column_stack([RNG.uniform(70, 80, 60), -RNG.uniform(70, 80, 60), np.full(60, 4.0)])
    places = np.array([[75.0, -75, 0], [20, -20, 0], [900, 900, 0]])
    heights = local_heights(places, np.concatenate([GROUND, bump]), plane=plane, camera_height=60.0)
    assert heights == pytest.approx([4, 0, 0], abs=0.3)


def test_a_model_without_ground_is_refused() -> None:
    with pytest.raises(ReconstructionError, match="too few"):
        model_plane(_model(GROUND[:10]))
    with pytest.raises(ReconstructionError, match="below the ground"):
        plane_below(_shot(Pose(50, 50, -5)), GROUND, model_plane(_model(GROUND)))


CORNERS = np.array([[0.0, 0.0], [800.0, 0.0], [800.0, 600.0], [400.0, 300.0], [130.0, 520.0]])


def _seen(lens: Lens, points: np.ndarray) -> np.ndarray:
    matrix = np.array(
        [
            [lens.focal_x_px, 0, lens.centre_x_px],
            [0, lens.focal_y_px, lens.centre_y_px],
            [0, 0, 1.0],
        ]
    )
    still = np.zeros(3)
    if lens.fisheye:
        return cv2.fisheye.projectPoints(
            points[:, None], still, still, matrix, np.array(lens.distortion)
        )[0][:, 0]
    return cv2.projectPoints(points, still, still, matrix, np.array(lens.distortion))[0][:, 0]


@pytest.mark.parametrize(
    ("distortion", "fisheye"),
    [
        ((), False),
        ((-0.08, 0.02, 0.0, 0.0), False),
        ((-0.05, 0.01, 0.001, -0.002, 0.003), False),
        ((0.02, -0.004, 0.0, 0.0), True),
        ((0.0, 0.0, 0.0, 0.0), True),
    ],
)
def test_a_ray_comes_back_to_its_pixel(distortion: tuple[float, ...], fisheye: bool) -> None:
    lens = Lens(800, 600, 700, 690, 410, 295, distortion, fisheye)
    rays = lens.directions(CORNERS)
    assert rays[:, 2] == pytest.approx(1.0)
    if distortion:
        assert _seen(lens, rays) == pytest.approx(CORNERS, abs=0.05)
    else:
        assert rays[:, 0] * 700 + 410 == pytest.approx(CORNERS[:, 0])


def test_a_reduced_copy_has_the_same_rays() -> None:
    lens = Lens(800, 600, 700, 690, 410, 295, (-0.08, 0.02, 0.0, 0.0))
    half = lens.of_size(400, 300)
    assert half.directions(CORNERS / 2) == pytest.approx(lens.directions(CORNERS))
    with pytest.raises(ReconstructionError, match="neither cropped nor turned"):
        lens.of_size(600, 800)
