"""Our reading and writing of models, against COLMAP's own: ``pip install 'vehanchor[sfm]'``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from vehanchor_flight.reconstruction.files import read_model, write_rescaled

if TYPE_CHECKING:
    from pathlib import Path

pycolmap = pytest.importorskip("pycolmap")


@pytest.mark.parametrize("text", [True, False])
def test_a_model_of_colmap_is_read_and_rescaled_as_colmap_does(tmp_path: Path, text: bool) -> None:
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=6, num_points3D=60
    )
    made = pycolmap.synthesize_dataset(options)
    for folder in ("old", "new"):
        (tmp_path / folder).mkdir()
    (made.write_text if text else made.write_binary)(tmp_path / "old")
    model = read_model(tmp_path / "old")
    theirs = {image.name: image for image in made.images.values()}
    assert {shot.name for shot in model.shots} == set(theirs)
    corners = np.array([[0.0, 0.0], [300.0, 200.0]])
    for shot in model.shots:
        image = theirs[shot.name]
        assert shot.centre == pytest.approx(image.projection_center())
        assert shot.rotation == pytest.approx(image.cam_from_world().rotation.matrix(), abs=1e-9)
        rays = made.cameras[image.camera_id].cam_from_img(corners)
        assert shot.lens.directions(corners)[:, :2] == pytest.approx(rays, abs=1e-4)
    points = np.sort([point.xyz for point in made.points3D.values()], axis=0)
    assert np.sort(model.points, axis=0) == pytest.approx(points)
    write_rescaled(model, tmp_path / "new", 3.5)
    again = pycolmap.Reconstruction(tmp_path / "new")
    assert again.compute_mean_reprojection_error() == pytest.approx(
        made.compute_mean_reprojection_error(), abs=1e-6
    )
    for image in again.images.values():
        assert image.projection_center() == pytest.approx(
            3.5 * theirs[image.name].projection_center()
        )
