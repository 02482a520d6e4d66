from __future__ import annotations

import csv
import json
import shutil
from collections import Counter
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import vehanchor
from tests.known_scale_data import n_results
from tests.models import blank_image, paint_vehicles, write_detector
from tests.sam_models import write_sam
from vehanchor.cli import app as cli
from vehanchor.errors import ImageError, InvalidParameterError
from vehanchor_evaluation.area_errors import area_errors
from vehanchor_evaluation.areas import read_areas, read_masks

if TYPE_CHECKING:
    from typer.testing import Result

LENGTH_PX = 29.0
FOUND_GSD = 5.045 / LENGTH_PX  # what the pipeline says: all cars have one length
TRUE_GSD = FOUND_GSD / 1.1
POOLS = {"P1": 2, "P2": 1, "P3": 1}  # P3 has no cars
SIZE = 480, 640


def pool_mask(index: int) -> np.ndarray:
    """An L, so that the object is not its box."""
    mask = np.zeros(SIZE, bool)
    top = 200
    left = 120 + 240 * index
    mask[top : top + 96, left : left + 64] = True
    mask[top + 32 : top + 96, left : left + 96] = True
    return mask


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``segments`` and models: pools and, in P2, a court and a pool too small to count."""
    folder = tmp_path_factory.mktemp("area")
    masks = folder / "segments"
    masks.mkdir()
    rows = ["image,mask,category,gsd_m_per_px"]
    for name, n_pools in POOLS.items():
        image = blank_image(SIZE[1], SIZE[0])
        objects = [("swimming-pool", pool_mask(index)) for index in range(n_pools)]
        if name == "P2":
            for category, place in (
                ("tennis-court", np.s_[320:416, 400:480]),
                ("swimming-pool", np.s_[380:390, 300:340]),
            ):
                mask = np.zeros(SIZE, bool)
                mask[place] = True
                objects.append((category, mask))
        for _, mask in objects:
            image[mask] = (40, 140, 210)
        if name != "P3":
            paint_vehicles(
                image,
                [
                    [60 + 70 * k, 60 + 70 * row, LENGTH_PX, 12, 0.3]
                    for k in range(8)
                    for row in (0, 1)
                ],
            )
        cv2.imwrite(str(masks / f"{name}.png"), image[:, :, ::-1])
        for category in dict.fromkeys(category for category, _ in objects):
            numbers = np.zeros(SIZE, np.uint16)
            for number, (of, mask) in enumerate(objects, start=1):
                numbers[mask] += number * (of == category)
            cv2.imwrite(str(masks / f"{name}-{category}.png"), numbers)
            rows.append(f"{name}.png,{name}-{category}.png,{category},{TRUE_GSD}")
    (masks / "index.csv").write_text("\n".join(rows))
    write_detector(folder / "detector.onnx")
    write_sam(folder)
    return folder


@pytest.fixture
def run(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs ``vehanchor evaluate area`` with the models of the data, into ``out`` of an empty working folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    models = [
        "--detector",
        data / "detector.onnx",
        "--segmenter",
        data / "encoder.onnx",
        data / "decoder.onnx",
    ]

    def invoke(*arguments: object, models: list[Any] = models) -> Result:
        words = ["evaluate", "area", *models, "--out", "out", *arguments]
        return CliRunner().invoke(cli.app, [str(word) for word in words])

    return partial(invoke, "--segments", data / "segments")


def rows_of(path: Path) -> dict[str, dict[str, str]]:
    with path.open(newline="") as handle:
        return {row["entry"]: row for row in csv.DictReader(handle)}


# --- The table
#
# -------------------------------------------------------------------------------------------------------


def test_the_columns_are_the_papers() -> None:
    said = [("a", 109.0), ("a", 80.0), ("a", 60.0), ("b", 10.0), ("b", 250.0), ("b", None)]
    row = area_errors("x", ((category, area, 100.0) for category, area in said))
    assert (row.entries, row.answered) == (6, 5)
    assert row.median == pytest.approx((0.4 + 0.9) / 2)
    assert row.mean == pytest.approx((0.09 + 0.2 + 0.4 + 0.9 + 1.5 + 1.0) / 6)
    shares = [row.below_10, row.below_25, row.below_50, row.below_100, row.catastrophic]
    assert shares == pytest.approx([1 / 6, 2 / 6, 3 / 6, 4 / 6, 2 / 6])
    assert {name: found.median for name, found in row.categories.items()} == pytest.approx(
        {"a": 0.2, "b": 1.0}
    )
    assert row.polarisation == pytest.approx(5.0)


# --- The run
#
# ---------------------------------------------------------------------------------------------------------


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
        entry = next(e for e in read_areas(data / "segments").entries if e.name == name)
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


def test_files_that_went_bad_are_reported_and_never_stop_a_run(
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
    """Squares of 20 px, 30 px apart."""
    ids = np.zeros((40, 30 * len(numbers) + 10), np.uint16)
    for k, number in enumerate(numbers):
        ids[5:25, 30 * k + 4 : 30 * k + 24] = number
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), ids)


def test_an_index_gives_its_split_and_reports_what_it_cannot_use(tmp_path: Path) -> None:
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
    found = read_areas(tmp_path, "val")
    assert [(each.name, each.image) for each in found.entries] == [
        ("a-1", tmp_path / "a.png"),
        ("b-1", tmp_path / "a.png"),
        ("sub/a-1", tmp_path / "sub/a.png"),
    ]
    assert [(issue.reason, issue.message.split(":")[0]) for issue in found.issues[:3]] == [
        ("malformed_row", "line 5"),
        ("malformed_row", "line 6"),
        ("duplicate_name", "line 7"),
    ]
    assert [issue.reason for issue in found.issues[3:]] == ["no_image", "unreadable_masks"]
    assert "broken.png" in found.issues[4].message
    assert len(read_areas(tmp_path).entries) == 4


def test_objects_have_their_masks_boxes_and_true_areas_and_categories_alternate(
    tmp_path: Path,
) -> None:
    write_mask(tmp_path / "pools.png", 1000, 1001, 1003)
    write_mask(tmp_path / "courts.png", 7)
    ids = np.zeros((40, 40), np.uint8)
    ids[2:16, 2:30] = 1  # too narrow
    cv2.imwrite(str(tmp_path / "small.png"), ids)
    write_index(
        tmp_path, *(f"pools.png,{name}.png,{name},val,0.5" for name in ("pools", "courts", "small"))
    )
    entries = read_areas(tmp_path, workers=2).entries
    assert [each.name for each in entries] == ["pools-1000", "courts-7", "pools-1001", "pools-1003"]
    assert entries[2].corners == (34, 5, 54, 25)
    assert entries[2].mask_area_px == 400
    assert entries[2].area_m2 == pytest.approx(100)


def test_masks_in_colour_are_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "c.png"), np.zeros((20, 30, 3), np.uint8))
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
def test_an_index_that_cannot_be_used_says_what_it_lacks(
    tmp_path: Path, text: str | None, message: str
) -> None:
    if text is not None:
        (tmp_path / "index.csv").write_text(text)
    with pytest.raises(InvalidParameterError, match=message):
        read_areas(tmp_path, "val")
