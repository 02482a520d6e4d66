"""Our reading of models, against COLMAP's own: ``pip install 'vehanchor[sfm]'``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from vehanchor_flight.reconstruction.files import read_model

if TYPE_CHECKING:
    from pathlib import Path

pycolmap = pytest.importorskip("pycolmap")


@pytest.mark.parametrize("text", [True, False])
def test_a_model_of_colmap_is_read_as_colmap_does(tmp_path: Path, text: bool) -> None:
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=6, num_points3D=60)
    made = pycolmap.synthesize_dataset(options)
    (made.write_text if text else made.write_binary)(tmp_path)
    model = read_model(tmp_path)
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
