"""Mixed fleets: kei cars, minivans and work vehicles."""

from __future__ import annotations

import numpy as np
import pytest

from research.scenes import render_scene
from research.scenes.fleet import Fleet
from vehanchor.errors import InvalidParameterError


def _models(count: int = 2_000, mean: float = 4.6) -> list[tuple[str, float]]:
    fleet = Fleet(mean, np.random.default_rng(0), "mixed")
    return [(model.body, model.length_m) for model in (fleet.small() for _ in range(count))]


def test_a_mixed_fleet_holds_kei_cars_and_pickups() -> None:
    assert {"kei", "kei truck", "crew cab", "single cab", "flatbed", "van"} <= {body for body, _ in _models()}


@pytest.mark.parametrize("mean", [4.0, 5.0])
def test_a_mixed_fleet_has_the_mean_length_asked_for(mean: float) -> None:
    assert np.mean([length for _, length in _models(mean=mean)]) == pytest.approx(mean, rel=0.01)


def test_the_same_seed_draws_the_same_mixed_scene_and_names_bodies() -> None:
    first, again = (
        render_scene(0.15, width_px=320, height_px=320, seed=3, layout="parking", fleet_kind="mixed") for _ in range(2)
    )
    np.testing.assert_array_equal(first.image, again.image)
    assert {vehicle.body for vehicle in first.vehicles} & {"kei", "crew cab", "single cab"}
    assert first.parameters["fleet_kind"] == "mixed"


def test_an_unknown_fleet_is_refused() -> None:
    with pytest.raises(InvalidParameterError, match="fleet_kind must be one of passenger, mixed, not 'tanks'"):
        render_scene(0.15, fleet_kind="tanks")  # type: ignore[arg-type]
