"""Errors of a detector, in a file beside it, and what depends on them."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.models import write_detector
from vehanchor.detection.detector import Detector, load_detector, networks_sha256
from vehanchor.detection.detector_errors import (
    AppearanceErrors,
    DetectorErrors,
    StretchLimits,
    TilePriorOdds,
    read_detector_errors,
)
from vehanchor.detection.proportions import stretch
from vehanchor.detection.tile_prior import car_prior
from vehanchor.errors import ModelContractError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.zoo import errors_file, resolve_model


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A user's own detector."""
    return write_detector(tmp_path / "own.onnx")


def _write_errors(detector: Path, text: str) -> Path:
    path = detector.with_name(f"{detector.stem}.errors.toml")
    path.write_text(text, encoding="utf-8")
    return path


def _leaves(table: dict[str, Any]) -> set[tuple[str, str]]:
    return {(group, name) for group, numbers in table.items() for name in numbers}


@pytest.fixture(scope="module")
def bundled_file() -> Path:
    path = errors_file(resolve_model())
    assert path is not None
    return path


# --- Files


def test_the_bundled_detector_has_the_errors_of_its_file(bundled_file: Path) -> None:
    assert load_detector(resolve_model()).card.errors == read_detector_errors(bundled_file)


def test_the_bundled_file_states_every_number(bundled_file: Path) -> None:
    stated = tomllib.loads(bundled_file.read_text(encoding="utf-8"))
    assert _leaves(stated) == _leaves(read_detector_errors(bundled_file).model_dump())


def test_the_default_spread_of_a_box_is_the_largest_by_place(bundled_file: Path) -> None:
    assert read_detector_errors(bundled_file).boxes.log_sd == 0.12
    assert DetectorErrors().boxes.log_sd == 0.145


def test_all_other_defaults_are_the_bundled_numbers(bundled_file: Path) -> None:
    bundled = read_detector_errors(bundled_file).model_dump()
    defaults = DetectorErrors().model_dump()
    del bundled["boxes"]["log_sd"], defaults["boxes"]["log_sd"]
    del bundled["votes"], defaults["votes"]
    assert bundled == defaults


def test_no_votes_are_the_default() -> None:
    assert DetectorErrors().votes is None


def test_votes_of_the_file_take_the_place_of_those_in_the_metadata(own: Path) -> None:
    write_detector(own, metadata={"vehanchor.votes": '{"share_at_zero": -9, "share_slope": 14}'})
    assert load_detector(own).card.votes == (-9.0, 14.0)
    _write_errors(own, "[votes]\nat_zero = -5.0\nslope = 11.0\n")
    assert load_detector(own).card.votes == (-5.0, 11.0)


def test_a_detector_without_a_file_has_the_defaults(own: Path) -> None:
    assert load_detector(own).card.errors == DetectorErrors()


def test_a_file_beside_a_detector_is_read(own: Path) -> None:
    _write_errors(own, "[boxes]\nlog_sd = 0.2\n")
    assert Detector(own).card.errors.boxes.log_sd == 0.2


def test_a_file_may_state_some_numbers(own: Path) -> None:
    _write_errors(own, "[boxes]\nlog_sd = 0.2\n")
    expected = DetectorErrors().model_dump()
    expected["boxes"]["log_sd"] = 0.2
    assert load_detector(own).card.errors.model_dump() == expected


def test_a_file_may_be_anywhere(own: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "measured.toml"
    elsewhere.write_text("[boxes]\nlog_sd = 0.2\n")
    assert Detector(own, errors=elsewhere).card.errors.boxes.log_sd == 0.2


def test_a_changed_file_is_read_again(own: Path) -> None:
    _write_errors(own, "[boxes]\nlog_sd = 0.2\n")
    load_detector(own)
    path = _write_errors(own, "[boxes]\nlog_sd = 0.25\n")
    assert load_detector(own).card.errors.boxes.log_sd == 0.25
    path.unlink()
    assert load_detector(own).card.errors == DetectorErrors()


def test_a_link_to_the_bundled_detector_has_its_errors(tmp_path: Path, bundled_file: Path) -> None:
    link = tmp_path / "link.onnx"
    link.symlink_to(resolve_model())
    assert errors_file(link) == bundled_file


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[boxes\n", "not TOML"),
        ("a = " + "[" * 100_000, "not TOML"),
        ("#" * (1 << 21), "larger than"),
        ("[boxes]\nlog_sd = 'wide'\n", "boxes.log_sd: "),
        ("[boxes]\nlog_sd = nan\n", "boxes.log_sd: "),
        ("[boxes]\nlog_sd = inf\n", "boxes.log_sd: "),
        ("[boxes]\nlog_sd = 0.0\n", "boxes.log_sd: "),
        ("[boxes]\nlog_sd = 12\n", "boxes.log_sd: "),
        ("[boxes]\nspread = 0.12\n", "boxes.spread: "),
        ("[vehicles]\nchance_wrong = 1.5\n", "vehicles.chance_wrong: "),
        ("[look_alikes]\nmin_vehicles = 20.5\n", "look_alikes.min_vehicles: "),
        ("[votes]\nat_zero = -5.0\n", "votes.slope: "),
        ("boxes = 3\n", "boxes: "),
    ],
)
def test_an_invalid_file_is_refused_with_the_problem(own: Path, text: str, problem: str) -> None:
    path = _write_errors(own, text)
    with pytest.raises(ModelContractError) as refused:
        load_detector(own)
    message = str(refused.value)
    assert f"in {path} cannot be used: " in message
    assert problem in message
    assert "Correct the file, or remove it" in message


def test_bytes_that_are_not_text_are_refused(own: Path) -> None:
    own.with_name("own.errors.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ModelContractError, match="not TOML"):
        load_detector(own)


# --- Checksums


def test_errors_do_not_change_the_checksum_of_the_detector(own: Path) -> None:
    """Calibrations and stored scales name the detector by it."""
    before = load_detector(own).card.sha256
    _write_errors(own, "[boxes]\nlog_sd = 0.2\n")
    assert load_detector(own).card.sha256 == before


def test_changed_errors_make_results_stale(own: Path) -> None:
    checksums = {networks_sha256(load_detector(own).card)}
    for log_sd in (0.2, 0.25):
        _write_errors(own, f"[boxes]\nlog_sd = {log_sd}\n")
        checksums.add(networks_sha256(load_detector(own).card))
    assert len(checksums) == 3


def test_a_changed_comment_does_not_make_results_stale(own: Path) -> None:
    _write_errors(own, "[boxes]\nlog_sd = 0.2\n")
    before = networks_sha256(load_detector(own).card)
    _write_errors(own, "# of 300 cars\n[boxes]\nlog_sd = 0.20\n")
    assert networks_sha256(load_detector(own).card) == before


# --- Errors of a fleet by its appearance


def test_the_error_by_appearance_falls_smoothly_with_the_number_of_cars() -> None:
    log_sds = [AppearanceErrors().fleet_log_sd(n / 4) for n in range(200)]
    steps = -np.diff(log_sds)
    assert (steps > 0).all()
    # No step of the curve is larger than the one before it.
    assert (np.diff(steps) < 0).all()


def test_many_cars_have_the_error_between_places() -> None:
    errors = AppearanceErrors()
    assert errors.fleet_log_sd(1000) == pytest.approx(errors.log_sd, rel=0.01)


# --- Use in a search


class _Preference:
    """A network that prefers the narrower image by as many logits, the more so for later chips."""

    def __init__(self, logits: float) -> None:
        self._logits = logits
        self._n_calls = 0

    def logits(self, chips: NDArray[np.uint8]) -> NDArray[np.float64]:
        self._n_calls += 1
        # The narrower image is asked about first.
        if self._n_calls % 2:
            return self._logits * np.linspace(0.9, 1.1, len(chips))
        return np.zeros(len(chips))


def _stretch(limits: StretchLimits) -> float:
    boxes = np.array([[50.0 * k, 100.0, 30.0, 14.0, 0.3] for k in range(1, 10)])
    verifier: Any = _Preference(2.0)
    with open_raster(np.full((200, 600, 3), 90, np.uint8)) as raster:
        share = stretch(raster, boxes, verifier, limits)
    assert share is not None
    return share


@pytest.mark.parametrize("number", ["vehicle_sd", "image_sd", "limit_sds"])
def test_the_limits_of_a_stretch_are_the_verifiers(number: str) -> None:
    limits = StretchLimits()
    larger = limits.model_copy(update={number: 2 * getattr(limits, number)})
    assert 0 < _stretch(larger) < _stretch(limits)


def test_the_odds_of_cars_by_edges_are_the_detectors() -> None:
    preview = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    rare = TilePriorOdds(log_odds_at_one=-20.0)
    assert car_prior(preview, rare) < car_prior(preview, TilePriorOdds())
    flat = TilePriorOdds(log_odds_slope=0.0)
    assert car_prior(preview, flat) < car_prior(preview, TilePriorOdds())
