from __future__ import annotations

import tomllib
from importlib.resources import files

import pytest

from vehanchor.imagery.metadata.sensors import sensor_of

TABLE = tomllib.loads(files("vehanchor.imagery.metadata").joinpath("sensors.toml").read_text(encoding="utf-8"))[
    "camera"
]


@pytest.mark.parametrize("camera", TABLE, ids=lambda camera: camera["name"])
def test_every_camera_is_found_and_has_a_plausible_sensor_with_a_source(camera: dict[str, object]) -> None:
    models = camera["models"]
    assert isinstance(models, list)
    assert models
    for model in models:
        sensor = sensor_of(f"{camera['make']} Robotics".upper(), f" {model} ")
        assert sensor is not None
        assert sensor.name == camera["name"]
        assert sensor.source
        assert 4 < sensor.width_mm < 37
        assert 1.3 < sensor.width_mm / sensor.height_mm < 1.52
        assert 0 < sensor.focal_from_mm <= sensor.focal_to_mm


def test_no_camera_is_listed_twice() -> None:
    names = [(camera["make"], model) for camera in TABLE for model in camera["models"]]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(("make", "model"), [("", ""), ("DJI", ""), ("Canon", "FC220"), ("DJI", "FC9999")])
def test_other_cameras_are_unknown(make: str, model: str) -> None:
    assert sensor_of(make, model) is None


def test_the_focal_length_of_the_file_chooses_the_lens() -> None:
    fixed, zoom = sensor_of("DJI", "FC3170"), sensor_of("DJI", "FC2204")
    assert fixed is not None
    assert zoom is not None
    assert (fixed.focal_mm(4.5), fixed.focal_mm(9.1)) == (4.5, None)
    assert fixed.focal_mm(None) == pytest.approx(4.5)
    assert (zoom.focal_mm(8.6), zoom.focal_mm(None)) == (8.6, None)
