"""Mixed fleets: kei cars, pickups with open beds, loads and roof racks."""

from __future__ import annotations

import numpy as np
import pytest

from research.scenes import render_scene
from research.scenes.fleet import Fleet
from research.scenes.loads import LOADS
from research.scenes.sprites import Sun, vehicle_sprite
from vehanchor.errors import InvalidParameterError

_LIGHT = Sun(1.0, 0.8).light()


def _models(count: int = 2_000, mean: float = 4.6) -> list[tuple[str, float]]:
    fleet = Fleet(mean, np.random.default_rng(0), "mixed")
    return [(model.body, model.length_m) for model in (fleet.small() for _ in range(count))]


def test_a_mixed_fleet_holds_kei_cars_pickups_and_every_load() -> None:
    bodies = [body for body, _ in _models()]
    assert {"kei", "kei truck", "crew cab", "single cab", "flatbed", "van"} <= {b.partition(":")[0] for b in bodies}
    assert {b.partition(":")[2].partition(" ")[0] for b in bodies} == {"", *LOADS}


@pytest.mark.parametrize("mean", [4.0, 5.0])
def test_a_mixed_fleet_has_the_mean_length_asked_for(mean: float) -> None:
    assert np.mean([length for _, length in _models(mean=mean)]) == pytest.approx(mean, rel=0.01)


@pytest.mark.parametrize("load", LOADS)
def test_a_load_changes_what_is_seen_inside_the_outline_and_never_the_outline(load: str) -> None:
    body = "minivan" if load == "rack" else "crew cab"
    bare, loaded = (vehicle_sprite(name, 5.4, 1.95, 40, _LIGHT) for name in (body, f"{body}:{load} 3"))
    np.testing.assert_array_equal(loaded[:, :, 0], bare[:, :, 0])
    changed = np.flatnonzero((np.abs(loaded - bare) > 1).any(axis=(0, 2)))
    assert len(changed) > 10
    cab_and_bonnet = slice(round(0.45 * bare.shape[1]), None) if load != "rack" else slice(0, 3)
    assert not (np.abs(loaded - bare)[:, cab_and_bonnet] > 1).any()


def test_the_same_seed_draws_the_same_mixed_scene_and_names_bodies() -> None:
    first, again = (
        render_scene(0.15, width_px=320, height_px=320, seed=3, layout="parking", fleet_kind="mixed") for _ in range(2)
    )
    np.testing.assert_array_equal(first.image, again.image)
    assert {vehicle.body.partition(":")[0] for vehicle in first.vehicles} & {"kei", "crew cab", "single cab"}
    assert first.parameters["fleet_kind"] == "mixed"


def test_an_unknown_fleet_is_refused() -> None:
    with pytest.raises(InvalidParameterError, match="fleet_kind must be one of passenger, mixed, not 'tanks'"):
        render_scene(0.15, fleet_kind="tanks")  # type: ignore[arg-type]
