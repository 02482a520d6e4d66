from __future__ import annotations

import csv
import json
import os
from collections import Counter
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import vehanchor
from tests.isaid_data import write_dota_image, write_isaid_pictures
from tests.journals import forget, n_results
from tests.models import blank_image, paint_vehicles, write_detector
from tests.sam_models import write_sam
from vehanchor.cli import app as cli
from vehanchor.errors import InvalidParameterError
from vehanchor.models.zoo import bundled_segmenter
from vehanchor.segmentation.segmenter import Segmenter
from vehanchor_evaluation.area_errors import area_errors
from vehanchor_evaluation.rs_gsd import CATEGORIES, Recipe, build_benchmark, load_benchmark, open_benchmark, quotas
from vehanchor_scenes import render_scene

if TYPE_CHECKING:
    from typer.testing import Result

DATA = Path(os.environ.get("VEHANCHOR_DATA", "../shared/data"))
LENGTH_PX = 29.0
FOUND_GSD = 5.045 / LENGTH_PX  # what the pipeline says: all cars have one length
TRUE_GSD = FOUND_GSD / 1.1
POOLS = {"P1": 2, "P2": 1, "P3": 1}  # P3 has no cars
SIZE = 480, 640


def pool_mask(index: int) -> np.ndarray:
    """An L, so that the object is not its box."""
    mask = np.zeros(SIZE, bool)
    top, left = 200, 120 + 240 * index
    mask[top : top + 96, left : left + 64] = True
    mask[top + 32 : top + 96, left : left + 96] = True
    return mask


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``dota``, ``isaid`` and models: pools and, in P2, a court, a car and a pool too small to count."""
    folder = tmp_path_factory.mktemp("area")
    masks = folder / "isaid" / "train" / "images"
    for name, n_pools in POOLS.items():
        image = blank_image(SIZE[1], SIZE[0])
        objects = [("swimming-pool", pool_mask(index)) for index in range(n_pools)]
        if name == "P2":
            for category, place in (
                ("tennis-court", np.s_[320:416, 400:480]),
                ("small-vehicle", np.s_[320:340, 300:340]),
                ("swimming-pool", np.s_[380:390, 300:340]),
            ):
                mask = np.zeros(SIZE, bool)
                mask[place] = True
                objects.append((category, mask))
        for _, mask in objects:
            image[mask] = (40, 140, 210)
        if name != "P3":
            paint_vehicles(
                image, [[60 + 70 * k, 60 + 70 * row, LENGTH_PX, 12, 0.3] for k in range(8) for row in (0, 1)]
            )
        write_dota_image(folder / "dota", name, image, TRUE_GSD)
        write_isaid_pictures(masks, masks, name, SIZE, objects)
    write_detector(folder / "detector.onnx")
    write_sam(folder)
    return folder


@pytest.fixture
def recipe(data: Path) -> Recipe:
    return Recipe(isaid=(str(data / "isaid"),), dota=(str(data / "dota"),), categories=CATEGORIES)


@pytest.fixture
def run(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs ``vehanchor evaluate area`` with the models of the data, into ``out`` of an empty working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    models = ["--detector", data / "detector.onnx", "--segmenter", data / "encoder.onnx", data / "decoder.onnx"]

    def invoke(*arguments: object, models: list[Any] = models) -> Result:
        words = ["evaluate", "area", *models, "--out", "out", *arguments]
        return CliRunner().invoke(cli.app, [str(word) for word in words])

    return partial(invoke, "--isaid", data / "isaid", "--dota", data / "dota")


def rows_of(path: Path) -> dict[str, dict[str, str]]:
    with path.open(newline="") as handle:
        return {row["entry"]: row for row in csv.DictReader(handle)}


# --- The table -------------------------------------------------------------------------------------------------------


def test_the_columns_are_the_papers() -> None:
    said = [("a", 109.0), ("a", 80.0), ("a", 60.0), ("b", 10.0), ("b", 250.0), ("b", None)]
    row = area_errors("x", ((category, area, 100.0) for category, area in said))
    assert (row.entries, row.answered) == (6, 5)
    assert row.median == pytest.approx((0.4 + 0.9) / 2)
    assert row.mean == pytest.approx((0.09 + 0.2 + 0.4 + 0.9 + 1.5 + 1.0) / 6)
    shares = [row.below_10, row.below_25, row.below_50, row.below_100, row.catastrophic]
    assert shares == pytest.approx([1 / 6, 2 / 6, 3 / 6, 4 / 6, 2 / 6])
    assert {name: found.median for name, found in row.categories.items()} == pytest.approx({"a": 0.2, "b": 1.0})
    assert row.polarisation == pytest.approx(5.0)


@pytest.mark.parametrize("said", [[], [("a", 5.0)], [("a", 100.0), ("b", 50.0)]])
def test_a_ratio_that_has_no_meaning_is_null(said: list[tuple[str, float]]) -> None:
    row = area_errors("x", ((category, area, 100.0) for category, area in said))
    assert row.polarisation is None
    assert (row.median is None) == (not said)


# --- The benchmark ---------------------------------------------------------------------------------------------------


def test_eight_categories_share_a_hundred_entries_irregular_ones_twice() -> None:
    assert quotas(dict.fromkeys(CATEGORIES, 10**6), 100) == {
        category: 20 if category in ("swimming-pool", "roundabout") else 10 for category in CATEGORIES
    }


@pytest.mark.parametrize(
    ("available", "n", "expected"),
    [
        ({"swimming-pool": 3, "roundabout": 1, "ship": 50}, 20, [3, 1, 16]),
        ({"swimming-pool": 3, "ship": 2}, 20, [3, 2]),
        ({"swimming-pool": 30, "ship": 20}, None, [30, 20]),
        ({"a": 9, "b": 9, "c": 9}, 7, [3, 2, 2]),
        ({"a": 0, "b": 5}, 3, [0, 3]),
        ({}, 3, []),
    ],
)
def test_what_a_category_lacks_goes_to_the_others(available: dict[str, int], n: int, expected: list[int]) -> None:
    assert list(quotas(available, n).values()) == expected


def test_entries_have_the_masks_boxes_and_true_areas(recipe: Recipe, tmp_path: Path) -> None:
    benchmark, issues = build_benchmark(recipe, tmp_path)
    assert issues == []
    assert benchmark.too_small == 1
    assert benchmark.available == {**dict.fromkeys(CATEGORIES, 0), "swimming-pool": 4, "tennis-court": 1}
    assert Counter(entry.category for entry in benchmark.entries) == {"swimming-pool": 4, "tennis-court": 1}
    entry = next(entry for entry in benchmark.entries if entry.name == "P1-3002")
    assert entry.corners == (360, 200, 456, 296)
    assert entry.mask_area_px == 96 * 96 - 32 * 32
    assert entry.area_m2 == pytest.approx((96 * 96 - 32 * 32) * TRUE_GSD**2)
    assert np.array_equal(benchmark.mask(tmp_path, entry), pool_mask(1)[200:296, 360:456])
    assert load_benchmark(tmp_path)[0] == benchmark


def test_the_first_entries_are_of_all_categories_and_of_many_images(recipe: Recipe, tmp_path: Path) -> None:
    entries = build_benchmark(recipe, tmp_path)[0].entries
    assert {entry.category for entry in entries[:2]} == {"swimming-pool", "tennis-court"}
    pools = [entry for entry in entries if entry.category == "swimming-pool"]
    assert {Path(entry.image).stem for entry in pools[:3]} == {"P1", "P2", "P3"}


def test_a_seed_decides_and_nothing_else(recipe: Recipe, tmp_path: Path) -> None:
    def names(seed: int, folder: str, workers: int = 1) -> list[str]:
        chosen = recipe.model_copy(update={"seed": seed})
        return [entry.name for entry in build_benchmark(chosen, tmp_path / folder, workers=workers)[0].entries]

    assert names(0, "a") == names(0, "b", workers=3)
    assert len({tuple(names(seed, "c")) for seed in range(6)}) > 1


def test_masks_that_cannot_be_read_are_reported_and_the_rest_is_taken(data: Path, tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    for name in ("a", "b", "sub/a"):
        ids = np.zeros((40, 40), np.uint8)
        ids[5:30, 5:30] = 1
        cv2.imwrite(str(tmp_path / f"{name}.png"), ids)
    (tmp_path / "c.png").write_bytes(b"broken")
    rows = ["image,mask,category,gsd_m_per_px", "a.png,a.png,x,0.1", "gone.png,b.png,x,0.1", "a.png,c.png,y,0.1"]
    rows.append("sub/a.png,sub/a.png,x,0.1")
    (tmp_path / "index.csv").write_text("\n".join(rows))
    benchmark, issues = build_benchmark(Recipe(segments=str(tmp_path)), tmp_path / "out")
    assert len(benchmark.entries) == 1
    assert [issue.reason for issue in issues] == ["duplicate_name", "no_image", "unreadable_masks"]
    assert "c.png" in issues[2].message


def test_no_object_of_a_category_is_an_error_that_lists_what_there_is(recipe: Recipe, tmp_path: Path) -> None:
    with pytest.raises(InvalidParameterError, match="small-vehicle, swimming-pool, tennis-court"):
        build_benchmark(recipe.model_copy(update={"categories": ("harbor",)}), tmp_path)


def test_a_folder_is_not_used_for_two_recipes(recipe: Recipe, tmp_path: Path) -> None:
    assert open_benchmark(recipe, tmp_path) == []
    assert open_benchmark(recipe, tmp_path) == []
    with pytest.raises(InvalidParameterError, match="different: entries, seed"):
        open_benchmark(recipe.model_copy(update={"seed": 3, "entries": 2}), tmp_path)


@pytest.mark.parametrize("text", [None, "{}", "no json"])
def test_what_is_no_benchmark_is_refused(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "benchmark.json").write_text(text)
    with pytest.raises(InvalidParameterError, match=r"benchmark\.json"):
        load_benchmark(tmp_path)


# --- The run ---------------------------------------------------------------------------------------------------------


def test_the_table_tells_the_errors_of_mask_and_scale_apart(run: Any, data: Path) -> None:
    result = run("--rulers", "vehicles")
    assert result.exit_code == 0, result.output
    report = json.loads(Path("out/area.json").read_text())
    rows = {row["name"]: row for row in report["rows"]}
    assert [row["entries"] for row in rows.values()] == [5, 4, 4, 5, 5]
    # P3 has no cars: no area, and an error of 100 % wherever the scale is estimated
    assert [row["answered"] for row in rows.values()] == [4, 4, 4, 5, 4]
    assert rows["true mask (GT-mask)"]["median"] == pytest.approx(1.1**2 - 1, abs=2e-3)
    assert rows["true mask (GT-mask)"]["catastrophic"] == pytest.approx(0.2)
    assert rows["true scale (GT-GSD)"]["median"] < 0.06
    assert rows["end to end, confidence >= 0.9"]["catastrophic"] == 0
    assert "| true mask (GT-mask) | 5 | 4 | 2" in result.stdout
    assert Path("out/area.md").read_text() == result.stdout
    for name, row in rows_of(Path("out/area.csv")).items():
        entry = next(e for e in load_benchmark(Path("out/benchmark"))[0].entries if e.name == name)
        measured = vehanchor.measure_area(
            entry.image,
            box=entry.corners,
            detector=str(data / "detector.onnx"),
            segmenter=(data / "encoder.onnx", data / "decoder.onnx"),
            rulers=("vehicles",),
        )
        assert row["end_to_end_m2"] == ("" if measured.area_m2 is None else str(measured.area_m2))
        assert int(row["mask_area_px"]) == measured.mask_area_px
        assert float(row["mask_iou"]) > 0.9


def test_one_search_serves_all_objects_of_an_image(run: Any) -> None:
    assert run("--workers", 2).exit_code == 0
    assert n_results(Path("out/detections.sqlite")) == 3


def test_a_run_goes_on_where_it_stopped(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run().exit_code == 0
    whole = Path("out/area.csv").read_text()
    forget(Path("out/masks.sqlite"), 2)
    segmented = []
    segment = Segmenter.segment

    def counted(self: Segmenter, *args: Any, **kwargs: Any) -> Any:
        segmented.append(args[1])
        return segment(self, *args, **kwargs)

    monkeypatch.setattr(Segmenter, "segment", counted)
    assert run().exit_code == 0
    assert len(segmented) == 2
    assert Path("out/area.csv").read_text() == whole
    assert run("--limit", 2).exit_code == 0
    assert len(segmented) == 2
    assert len(rows_of(Path("out/area.csv"))) == 2


def test_masks_of_another_segmenter_are_not_taken(run: Any, data: Path, tmp_path: Path) -> None:
    assert run().exit_code == 0
    write_sam(tmp_path, masks=("empty",))
    models = ["--detector", data / "detector.onnx", "--segmenter", tmp_path / "encoder.onnx", tmp_path / "decoder.onnx"]
    assert run(models=models).exit_code == 0
    rows = rows_of(Path("out/area.csv"))
    assert {row["mask_area_px"] for row in rows.values()} == {"0"}
    assert {row["end_to_end_m2"] for row in rows.values()} == {""}  # no mask is no answer, never an area of 0
    assert {row["true_scale_m2"] for row in rows.values()} == {""}


def test_files_that_went_bad_are_reported_and_never_stop_a_run(run: Any, data: Path) -> None:
    assert run("--build-only").exit_code == 0
    benchmark = load_benchmark(Path("out/benchmark"))[0]
    text = json.loads(Path("out/benchmark/benchmark.json").read_text())
    for entry in text["entries"]:
        if entry["category"] == "tennis-court":
            Path("out/benchmark", entry["mask"]).unlink()
        elif Path(entry["image"]).stem == "P3":
            entry["image"] = str(data / "detector.onnx")
        elif entry["name"] == "P1-1":
            other = next(e for e in benchmark.entries if e.category == "tennis-court")
            entry["mask_area_px"] = other.mask_area_px
    Path("out/benchmark/benchmark.json").write_text(json.dumps(text))
    result = run()
    assert result.exit_code == 0, result.output
    assert len(rows_of(Path("out/area.csv"))) == 2
    with Path("out/area_left_out.csv").open(newline="") as handle:
        reasons = Counter(row["reason"] for row in csv.DictReader(handle))
    assert reasons == {"image_not_found": 1, "mask_differs": 1, "image_undecodable": 2}
    assert "warning[mask_differs]" in result.stderr


def test_build_only_says_what_was_chosen(run: Any) -> None:
    result = run("--build-only", "--entries", 2)
    assert result.exit_code == 0
    assert "2 entries in " in result.stdout
    assert "swimming-pool: 1 of 4" in result.stdout
    assert not Path("out/area.csv").exists()


def test_another_choice_needs_another_folder_but_a_benchmark_may_be_named(run: Any, data: Path) -> None:
    assert run("--build-only").exit_code == 0
    refused = run("--seed", 4)
    assert refused.exit_code == 2
    assert "different: seed" in refused.stderr
    models = ["--detector", data / "detector.onnx", "--segmenter", data / "encoder.onnx", data / "decoder.onnx"]
    words = ["evaluate", "area", *models, "--benchmark", "out/benchmark", "--out", "second", "--limit", 1]
    assert CliRunner().invoke(cli.app, [str(word) for word in words]).exit_code == 0
    assert len(rows_of(Path("second/area.csv"))) == 1


@pytest.mark.parametrize("words", [[], ["--isaid", "a"], ["--isaid", "a", "--dota", "b", "--segments", "c"]])
def test_data_are_named_one_way(words: list[str]) -> None:
    result = CliRunner().invoke(cli.app, ["evaluate", "area", "--out", "out", *words])
    assert result.exit_code == 2
    assert "give one source of data" in result.stderr


@pytest.mark.slow
def test_rendered_scenes_in_the_layouts_of_isaid_and_dota_are_measured_by_what_ships(tmp_path: Path) -> None:
    if bundled_segmenter() is None:
        pytest.skip("no segmenter is bundled")
    names = {"swimming-pool": "swimming-pool", "sports-court": "tennis-court", "field": "soccer-ball-field"}
    for seed in (3, 4):
        scene = render_scene(gsd_m_per_px=0.15, width_px=1024, height_px=1024, seed=seed)
        objects = [
            (names[item.category], scene.masks[item.category] == item.instance)
            for item in scene.objects
            if item.category in names
        ]
        masks = tmp_path / "isaid" / "val" / "images"
        write_dota_image(tmp_path / "dota", f"P{seed}", scene.image, 0.15, scene.dota_text().partition("\n")[2])
        write_isaid_pictures(masks, masks, f"P{seed}", (1024, 1024), objects)
    words = ["--isaid", tmp_path / "isaid", "--dota", tmp_path / "dota", "--out", tmp_path / "out", "--min-side", 30]
    result = CliRunner().invoke(cli.app, ["evaluate", "area", *(str(word) for word in words)])
    assert result.exit_code == 0, result.output
    rows = {row["name"]: row for row in json.loads((tmp_path / "out" / "area.json").read_text())["rows"]}
    assert rows["end to end"]["answered"] == rows["end to end"]["entries"] > 0
    assert rows["true mask (GT-mask)"]["median"] < 0.25
    assert rows["true scale (GT-GSD)"]["median"] < 0.25


@pytest.mark.data
@pytest.mark.slow
def test_real_masks_are_measured(tmp_path: Path) -> None:
    if not (DATA / "segments").is_dir():
        pytest.skip(f"no data in {DATA}")
    words = ["evaluate", "area", "--segments", DATA / "segments", "--split", "val", "--out", tmp_path, "--limit", 8]
    assert CliRunner().invoke(cli.app, [str(word) for word in words]).exit_code == 0
    report = json.loads((tmp_path / "area.json").read_text())
    assert {row["name"]: row["median"] < 0.3 for row in report["rows"]}["true scale (GT-GSD)"]
