"""Test the line that states a contradiction between the file's scale and the cars."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from rasterio.transform import Affine
from typer.testing import CliRunner

import vehanchor
from tests.models import pool_among_cars, write_detector
from tests.skill.imagery.files import geotiff
from vehanchor.batch.row import BatchRow
from vehanchor.cli import app as cli
from vehanchor.pictures.scale import safe_lines
from vehanchor.records import GsdEstimate, Notice, RulerScale
from vehanchor.records.advice import advice_for
from vehanchor.records.contradiction import contradiction_text
from vehanchor_server.tools.messages import answer_of

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

FILE_GSD = 0.25


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a detector that finds the cars."""
    path: Path = write_detector(tmp_path_factory.mktemp("contradiction") / "m.onnx")
    return path


@pytest.fixture(scope="module")
def wrong_map(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a GeoTIFF whose scale is nearly twice that of its cars."""
    path = tmp_path_factory.mktemp("wrong_map") / "ortho.tif"
    transform = Affine(FILE_GSD, 0, 500_000, 0, -FILE_GSD, 5_000_000)
    return geotiff(path, pool_among_cars(), transform=transform)


@pytest.fixture(scope="module")
def estimate(wrong_map: Path, detector: Path) -> GsdEstimate:
    """Estimate the scale of the GeoTIFF."""
    return vehanchor.estimate_gsd(wrong_map, detector=detector)


def _printed(*arguments: object) -> list[str]:
    result = CliRunner().invoke(cli.app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    return [line for line in result.stdout.splitlines() if line.strip()]


def test_the_text_has_both_numbers(estimate: GsdEstimate) -> None:
    assert estimate.gsd_m_per_px is not None
    text = contradiction_text(estimate)
    assert f"{FILE_GSD} m/px" in text
    assert f"{estimate.gsd_m_per_px:.4g} m/px" in text


def test_the_terminal_begins_with_it(wrong_map: Path, detector: Path) -> None:
    title, first, *_ = _printed("estimate", wrong_map, "--detector", detector)
    assert "ortho.tif" in title
    assert "The file's own scale is 0.25 m/px" in first


def test_the_table_of_several_images_begins_with_it(wrong_map: Path, detector: Path) -> None:
    first, *_ = _printed("estimate", wrong_map, wrong_map, "--detector", detector)
    assert "ortho.tif: The file's own scale is 0.25 m/px" in first


def test_a_searched_distance_begins_with_it(wrong_map: Path, detector: Path) -> None:
    line = ("--point", "100 100", "--point", "400 100")
    _, first, *_ = _printed("distance", wrong_map, *line, "--search", "--detector", detector)
    assert "The file's own scale is 0.25 m/px" in first


def test_the_answer_of_the_server_begins_with_it(estimate: GsdEstimate) -> None:
    answer = answer_of([estimate], [], "short")
    assert answer.text.startswith("The file's own scale is 0.25 m/px, the rulers give")


def test_the_batch_table_has_it(estimate: GsdEstimate) -> None:
    row = BatchRow(photograph="ortho.tif", estimate=estimate).flat()
    assert row["contradiction"] == contradiction_text(estimate)


def _ruler(kind: str, gsd: float) -> RulerScale:
    return RulerScale.model_validate(
        {
            "kind": kind,
            "label": kind,
            "sets_scale": True,
            "gsd_m_per_px": gsd,
            "density_median_m_per_px": gsd,
            "gsd_ci95_low_m_per_px": gsd * 0.8,
            "gsd_ci95_high_m_per_px": gsd * 1.25,
            "n": 1,
            "p_right": 0.5,
            "probably_right": True,
            "explanation": None,
        }
    )


def _with_rulers(estimate: GsdEstimate, rulers: Sequence[RulerScale], *codes: str) -> GsdEstimate:
    notices = tuple(Notice(code=code, message="Both differ.") for code in codes)
    changes: dict[str, Any] = {"rulers": tuple(rulers), "warnings": notices}
    return estimate.model_copy(update=changes)


def test_a_camera_that_the_cars_contradict_is_stated(estimate: GsdEstimate) -> None:
    rulers = [_ruler("camera", 0.1), _ruler("vehicles", 0.2)]
    record = _with_rulers(estimate, rulers, "rulers_disagree")
    expected = "The camera in the file gives 0.100 m/px, the vehicles 0.200 m/px"
    assert contradiction_text(record) == expected


@pytest.mark.parametrize(
    ("gsd", "codes"), [(0.11, ("rulers_disagree",)), (0.2, ())], ids=["they meet", "no warning"]
)
def test_a_camera_that_the_cars_may_confirm_is_not(
    estimate: GsdEstimate, gsd: float, codes: tuple[str, ...]
) -> None:
    rulers = [_ruler("camera", 0.1), _ruler("vehicles", gsd)]
    assert contradiction_text(_with_rulers(estimate, rulers, *codes)) == ""


@pytest.mark.parametrize("kind", ["known_length", "height", "stated_scale"])
def test_a_fact_that_the_cars_contradict_is_stated_first(estimate: GsdEstimate, kind: str) -> None:
    fact = _ruler(kind, 0.1).model_copy(update={"probably_right": False})
    record = _with_rulers(estimate, [fact, _ruler("vehicles", 0.2)], "rulers_disagree")
    text = answer_of([record.model_copy(update={"status": "ok"})], [], "short").text
    assert text.startswith(f"The {kind} gives 0.100 m/px, the vehicles 0.200 m/px.")
    assert f"safe to use if the {kind} is wrong: " in text
    assert "Warning" not in text


def test_the_caption_of_a_contradicted_scale_has_both_numbers(estimate: GsdEstimate) -> None:
    fact = _ruler("known_length", 0.1).model_copy(update={"probably_right": False})
    record = _with_rulers(estimate, [fact, _ruler("vehicles", 0.2)], "rulers_disagree")
    (verdict,), (scales,) = safe_lines(record)
    assert verdict[1].startswith("safe to use if the known_length is wrong")
    assert scales[1] == contradiction_text(record)


def test_an_estimate_without_a_scale_names_that_of_the_file(estimate: GsdEstimate) -> None:
    changes = {"status": "no_scale", "gsd_m_per_px": None, "reason": "too_few", "warnings": ()}
    text = answer_of([estimate.model_copy(update=changes)], [], "short").text
    assert "georeference gives 0.250 m/px: measure_area and measure_distance use it" in text


def test_rulers_of_a_flight_that_exclude_each_other_are_named(estimate: GsdEstimate) -> None:
    rulers = [_ruler("vehicles", 0.1), _ruler("positions", 0.2)]
    record = _with_rulers(estimate, rulers).model_copy(
        update={"status": "low_confidence", "reason": "disagree"}
    )
    advice = advice_for(record)
    assert advice is not None
    assert advice.why == "vehicles and positions contradict each other"
    assert "facts" not in advice.remedies
