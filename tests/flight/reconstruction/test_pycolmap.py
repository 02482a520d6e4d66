"""Our reading and writing of models against COLMAP's: ``pip install '.[sfm]'``."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from vehanchor_flight.reconstruction.files import read_model, write_rescaled

pycolmap = pytest.importorskip("pycolmap")


SCALE = 3.5


class Models(NamedTuple):
    """Model of COLMAP, in memory and in a folder."""

    theirs: Any
    folder: Path


@pytest.fixture(scope="module", params=["text", "binary"])
def models(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Models:
    """Make a model of six photographs, and write it as text or as binary files."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=6, num_points3D=60
    )
    theirs = pycolmap.synthesize_dataset(options)
    folder = tmp_path_factory.mktemp(request.param)
    write = theirs.write_text if request.param == "text" else theirs.write_binary
    write(folder)
    return Models(theirs, folder)


def _images(theirs: Any) -> dict[str, Any]:
    return {image.name: image for image in theirs.images.values()}


def test_poses_are_those_of_colmap(models: Models) -> None:
    model = read_model(models.folder)
    images = _images(models.theirs)
    assert {shot.name for shot in model.shots} == set(images)
    for shot in model.shots:
        image = images[shot.name]
        assert shot.centre == pytest.approx(image.projection_center())
        assert shot.rotation == pytest.approx(image.cam_from_world().rotation.matrix(), abs=1e-9)


def test_rays_are_those_of_colmap(models: Models) -> None:
    images = _images(models.theirs)
    pixels = np.array([[0.0, 0.0], [300.0, 200.0]])
    for shot in read_model(models.folder).shots:
        camera = models.theirs.cameras[images[shot.name].camera_id]
        slopes = shot.lens.directions(pixels)[:, :2]
        assert slopes == pytest.approx(camera.cam_from_img(pixels), abs=1e-4)


def test_points_are_those_of_colmap(models: Models) -> None:
    theirs = np.sort([point.xyz for point in models.theirs.points3D.values()], axis=0)
    ours = np.sort(read_model(models.folder).points, axis=0)
    assert ours == pytest.approx(theirs)


def test_colmap_reads_a_rescaled_model(models: Models, tmp_path: Path) -> None:
    write_rescaled(read_model(models.folder), tmp_path, SCALE)
    rescaled = pycolmap.Reconstruction(tmp_path)
    error = models.theirs.compute_mean_reprojection_error()
    assert rescaled.compute_mean_reprojection_error() == pytest.approx(error, abs=1e-6)
    images = _images(models.theirs)
    for image in rescaled.images.values():
        centre = images[image.name].projection_center()
        assert image.projection_center() == pytest.approx(SCALE * centre)
