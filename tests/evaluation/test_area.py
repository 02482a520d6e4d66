from __future__ import annotations

import csv
import json
import shutil
from collections import Counter
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

import vehanchor
from tests.known_scale_data import n_results
from tests.models import blank_image, paint_vehicles, write_detector
from tests.sam_models import write_sam
from vehanchor.cli import app as cli
from vehanchor.errors import ImageError, InvalidParameterError
from vehanchor.measure.id_image import read_masks
from vehanchor_evaluation.area_errors import AreaErrors, area_errors
from vehanchor_evaluation.areas import AreaEntry, read_areas

LENGTH_PX = 29.0
# All cars have one length, so the estimate is exactly this.
ESTIMATED_GSD = 5.045 / LENGTH_PX
TRUE_GSD = ESTIMATED_GSD / 1.1
# Pools by image. P3 has no cars.
POOLS = {"P1": 2, "P2": 1, "P3": 1}
SIZE = 480, 640
CARS = [[60 + 70 * k, 60 + 70 * row, LENGTH_PX, 12, 0.3] for k in range(8) for row in (0, 1)]


def pool_mask(index: int) -> np.ndarray:
    """Draw an L, so that the object is not its box."""
    mask = np.zeros(SIZE, bool)
    top = 200
    left = 120 + 240 * index
    mask[top : top + 96, left : left + 64] = True
    mask[top + 32 : top + 96, left : left + 96] = True
    return mask


def box_mask(window: tuple[slice, slice]) -> np.ndarray:
    mask = np.zeros(SIZE, bool)
    mask[window] = True
    return mask


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write ``segments`` and models: pools and, in P2, a court and a pool too small to count."""
    folder = tmp_path_factory.mktemp("area")
    masks = folder / "segments"
    masks.mkdir()
    rows = ["image,mask,category,gsd_m_per_px"]
    for name, n_pools in POOLS.items():
        image = blank_image(SIZE[1], SIZE[0])
        objects = [("swimming-pool", pool_mask(index)) for index in range(n_pools)]
        if name == "P2":
            objects.append(("tennis-court", box_mask(np.s_[320:416, 400:480])))
            objects.append(("swimming-pool", box_mask(np.s_[380:390, 300:340])))
        for _, mask in objects:
            image[mask] = (40, 140, 210)
            # A lens softens edges; those of an inset are abrupt.
            edge = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((9, 9)))
            soft = cv2.GaussianBlur(image, (0, 0), 2)
            image[edge > 0] = soft[edge > 0]
        if name != "P3":
            paint_vehicles(image, CARS)
        cv2.imwrite(str(masks / f"{name}.png"), image[:, :, ::-1])
        for category in dict.fromkeys(category for category, _ in objects):
            numbers = np.zeros(SIZE, np.uint16)
            for number, (category_of_mask, mask) in enumerate(objects, start=1):
                if category_of_mask == category:
                    numbers[mask] = number
            cv2.imwrite(str(masks / f"{name}-{category}.png"), numbers)
            rows.append(f"{name}.png,{name}-{category}.png,{category},{TRUE_GSD}")
    (masks / "index.csv").write_text("\n".join(rows))
    write_detector(folder / "detector.onnx")
    write_sam(folder)
    return folder


@pytest.fixture
def run(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run ``vehanchor evaluate area`` on the data, into ``out`` of an empty working folder."""
    monkeypatch.chdir(tmp_path)
    return partial(evaluate_area, data, Path("out"), "--segments", data / "segments")


def evaluate_area(data: Path, out: Path, *arguments: object) -> Result:
    models = ["--detector", data / "detector.onnx"]
    models += ["--segmenter", data / "encoder.onnx", data / "decoder.onnx"]
    words = ["evaluate", "area", *models, "--out", out, *arguments]
    return CliRunner().invoke(cli.app, [str(word) for word in words], env={"COLUMNS": "160"})


def rows_of(path: Path) -> dict[str, dict[str, str]]:
    with path.open(newline="") as handle:
        return {row["entry"]: row for row in csv.DictReader(handle)}


# --- The table


@pytest.fixture
def errors() -> AreaErrors:
    """Summarise answers to areas of 100 square metres."""
    answers = [("a", 109.0), ("a", 80.0), ("a", 60.0), ("b", 10.0), ("b", 250.0), ("b", None)]
    return area_errors("x", ((category, area, 100.0) for category, area in answers))


def test_a_missing_answer_counts_as_an_error_of_100_percent(errors: AreaErrors) -> None:
    assert (errors.entries, errors.answered) == (6, 5)
    assert errors.median == pytest.approx((0.4 + 0.9) / 2)
    assert errors.mean == pytest.approx((0.09 + 0.2 + 0.4 + 0.9 + 1.5 + 1.0) / 6)


def test_the_columns_are_those_of_the_paper(errors: AreaErrors) -> None:
    shares = [errors.below_10, errors.below_25, errors.below_50, errors.below_100]
    assert [*shares, errors.catastrophic] == pytest.approx([1 / 6, 2 / 6, 3 / 6, 4 / 6, 2 / 6])


def test_polarisation_is_the_ratio_of_the_categories_medians(errors: AreaErrors) -> None:
    medians = {name: category.median for name, category in errors.categories.items()}
    assert medians == pytest.approx({"a": 0.2, "b": 1.0})
    assert errors.polarisation == pytest.approx(5.0)


# --- The run


@pytest.fixture(scope="module")
def vehicles_run(
    data: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Result, Path, dict[str, Any]]:
    """Run once with vehicles as the only ruler: the result, its folder, and rows by name."""
    out = tmp_path_factory.mktemp("run") / "out"
    options = ["--segments", data / "segments", "--rulers", "vehicles"]
    result = evaluate_area(data, out, *options)
    assert result.exit_code == 0, result.output
    report = json.loads((out / "area.json").read_text())
    return result, out, {row["name"]: row for row in report["rows"]}


VehiclesRun = tuple[Result, Path, dict[str, Any]]


def test_objects_without_a_scale_have_no_area(vehicles_run: VehiclesRun) -> None:
    _, _, rows = vehicles_run
    assert [row["entries"] for row in rows.values()] == [5, 4, 4, 5, 5]
    # P3 has no cars: no area, and an error of 100 % wherever the scale is estimated.
    assert [row["answered"] for row in rows.values()] == [4, 4, 4, 5, 4]


def test_the_true_mask_leaves_the_error_of_the_scale(vehicles_run: VehiclesRun) -> None:
    _, _, rows = vehicles_run
    assert rows["true mask (GT-mask)"]["median"] == pytest.approx(1.1**2 - 1, abs=2e-3)
    assert rows["true mask (GT-mask)"]["catastrophic"] == pytest.approx(0.2)


def test_the_true_scale_leaves_the_error_of_the_mask(vehicles_run: VehiclesRun) -> None:
    _, _, rows = vehicles_run
    assert rows["true scale (GT-GSD)"]["median"] < 0.06


def test_confident_areas_have_no_catastrophic_error(vehicles_run: VehiclesRun) -> None:
    _, _, rows = vehicles_run
    assert rows["end to end, confidence >= 0.9"]["catastrophic"] == 0


def test_the_table_is_printed_as_it_is_written(vehicles_run: VehiclesRun) -> None:
    result, out, _ = vehicles_run
    assert "| true mask (GT-mask) | 5 | 4 | 2" in result.stdout
    assert (out / "area.md").read_text() == result.stdout


def test_areas_are_those_of_measure_area(vehicles_run: VehiclesRun, data: Path) -> None:
    _, out, _ = vehicles_run
    entries = {entry.name: entry for entry in read_areas(data / "segments").entries}
    for name, row in rows_of(out / "area.csv").items():
        measured = vehanchor.measure_area(
            entries[name].image,
            box=entries[name].corners,
            detector=str(data / "detector.onnx"),
            segmenter=(data / "encoder.onnx", data / "decoder.onnx"),
            rulers=("vehicles",),
        )
        assert row["end_to_end_m2"] == ("" if measured.area_m2 is None else str(measured.area_m2))
        assert int(row["mask_area_px"]) == measured.mask_area_px


def test_masks_overlap_the_true_ones(vehicles_run: VehiclesRun) -> None:
    _, out, _ = vehicles_run
    assert all(float(row["mask_iou"]) > 0.9 for row in rows_of(out / "area.csv").values())


def test_one_search_serves_all_objects_of_an_image(run: Any) -> None:
    assert run("--workers", 2).exit_code == 0
    assert n_results(Path("out/detections.sqlite")) == 3


def test_damaged_files_are_reported_without_stopping_the_run(
    run: Any, data: Path, tmp_path: Path
) -> None:
    bad = tmp_path / "segments"
    shutil.copytree(data / "segments", bad)
    (bad / "P2-tennis-court.png").unlink()
    (bad / "P3.png").write_bytes(b"no image")
    result = run("--segments", bad)
    assert result.exit_code == 0, result.output
    assert len(rows_of(Path("out/area.csv"))) == 3
    with Path("out/area_left_out.csv").open(newline="") as handle:
        reasons = Counter(row["reason"] for row in csv.DictReader(handle))
    assert reasons == {"unreadable_masks": 1, "image_undecodable": 2}
    assert "warning[image_undecodable]" in result.stderr


def write_index(folder: Path, *rows: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "index.csv").write_text(
        "\n".join(["image,mask,category,split,gsd_m_per_px", *rows]) + "\n"
    )


def write_mask(path: Path, *numbers: int) -> None:
    """Write squares of 20 px, 30 px apart."""
    ids = np.zeros((40, 30 * len(numbers) + 10), np.uint16)
    for k, number in enumerate(numbers):
        ids[5:25, 30 * k + 4 : 30 * k + 24] = number
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), ids)


@pytest.fixture
def faulty_index(tmp_path: Path) -> Path:
    """An index with good rows of two splits, and with rows that cannot be used."""
    for name in ("a", "b", "c", "e", "sub/a"):
        write_mask(tmp_path / f"{name}.png", 1)
    (tmp_path / "broken.png").write_bytes(b"broken")
    write_index(
        tmp_path,
        "a.png,a.png,swimming-pool,val,0.2",
        "a.png,b.png,building,val,0.2",
        "c.png,c.png,building,train,0.2",
        "a.png,d.png,building,val,wide",
        "a.png,,building,val,0.2",
        "c.png,a.png,building,val,0.2",
        "gone.png,e.png,building,val,0.2",
        "a.png,broken.png,building,val,0.2",
        "sub/a.png,sub/a.png,building,val,0.2",
    )
    return tmp_path


def test_an_index_gives_the_entries_of_a_split(faulty_index: Path) -> None:
    entries = read_areas(faulty_index, "val").entries
    assert [(entry.name, entry.image) for entry in entries] == [
        ("a-1", faulty_index / "a.png"),
        ("b-1", faulty_index / "a.png"),
        ("sub/a-1", faulty_index / "sub/a.png"),
    ]


def test_an_index_gives_the_entries_of_all_splits(faulty_index: Path) -> None:
    assert len(read_areas(faulty_index).entries) == 4


def test_unusable_rows_of_an_index_are_reported(faulty_index: Path) -> None:
    issues = read_areas(faulty_index, "val").issues
    assert [(issue.reason, issue.message.split(":")[0]) for issue in issues[:3]] == [
        ("malformed_row", "line 5"),
        ("malformed_row", "line 6"),
        ("duplicate_name", "line 7"),
    ]


def test_unusable_files_of_an_index_are_reported(faulty_index: Path) -> None:
    issues = read_areas(faulty_index, "val").issues
    assert [issue.reason for issue in issues[3:]] == ["no_image", "unreadable_masks"]
    assert "broken.png" in issues[4].message


@pytest.fixture
def entries(tmp_path: Path) -> tuple[AreaEntry, ...]:
    """Entries of three pools, a court, and an object that is too narrow."""
    write_mask(tmp_path / "pools.png", 1000, 1001, 1003)
    write_mask(tmp_path / "courts.png", 7)
    narrow = np.zeros((40, 40), np.uint8)
    narrow[2:16, 2:30] = 1
    cv2.imwrite(str(tmp_path / "small.png"), narrow)
    categories = ("pools", "courts", "small")
    write_index(tmp_path, *(f"pools.png,{name}.png,{name},val,0.5" for name in categories))
    return read_areas(tmp_path, workers=2).entries


def test_categories_alternate(entries: tuple[AreaEntry, ...]) -> None:
    names = [entry.name for entry in entries]
    assert names == ["pools-1000", "courts-7", "pools-1001", "pools-1003"]


def test_entries_have_their_true_box_and_area(entries: tuple[AreaEntry, ...]) -> None:
    assert entries[2].corners == (34, 5, 54, 25)
    assert entries[2].mask_area_px == 400
    assert entries[2].area_m2 == pytest.approx(100)


def test_masks_in_colour_are_refused(tmp_path: Path) -> None:
    colour = np.zeros((20, 30, 3), np.uint8)
    colour[5, 5] = (0, 0, 1)
    cv2.imwrite(str(tmp_path / "c.png"), colour)
    with pytest.raises(ImageError, match="one band"):
        read_masks(tmp_path / "c.png")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "give a folder with an index"),
        ("image,mask\n", "no column category, gsd_m_per_px"),
        (
            "image,mask,category,split,gsd_m_per_px\na,b,c,train,1\n",
            "no rows of split 'val': it has train",
        ),
        (
            "image,mask,category,split,gsd_m_per_px\na,b,c,val,1\n",
            "has no object of 15 px and more; the first problem",
        ),
    ],
)
def test_an_unusable_index_is_refused_with_what_it_lacks(
    tmp_path: Path, text: str | None, message: str
) -> None:
    if text is not None:
        (tmp_path / "index.csv").write_text(text)
    with pytest.raises(InvalidParameterError, match=message):
        read_areas(tmp_path, "val")
