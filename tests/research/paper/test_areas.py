"""The paper's benchmark of areas: written as iSAID and DOTA are, sampled, measured, stated."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner

from research.paper import isaid
from research.paper.__main__ import app
from research.paper.rs_gsd import CATEGORIES, build_benchmark, quotas
from research.paper.stated_area import read_area
from tests.evaluation.test_area import POOLS, SIZE, pool_mask
from tests.models import blank_image
from vehanchor.errors import ImageError, InvalidParameterError
from vehanchor_evaluation.areas import read_areas
from vehanchor_evaluation.dota import survey_dota

COLOURS = {  # of the development kit's helpers/labels.py
    "swimming-pool": (0, 0, 255),
    "tennis-court": (0, 63, 127),
    "soccer-ball-field": (0, 127, 191),
    "storage-tank": (0, 63, 63),
    "small-vehicle": (0, 0, 127),
}
Objects = Sequence[tuple[str, NDArray[np.bool_]]]


def write_dota_image(
    split: Path, name: str, image: NDArray[np.uint8], gsd: float | None, labels: str = ""
) -> Path:
    """``images/NAME.png`` and ``labelTxt-v1.5/NAME.txt`` with its header."""
    for folder in ("images", "labelTxt-v1.5"):
        (split / folder).mkdir(parents=True, exist_ok=True)
    (split / "labelTxt-v1.5" / f"{name}.txt").write_text(
        f"imagesource:GoogleEarth\ngsd:{gsd}\n{labels}"
    )
    return _write(split / "images" / f"{name}.png", image)


def write_isaid_pictures(
    id_folder: Path,
    colour_folder: Path,
    name: str,
    size: tuple[int, int],
    objects: Objects,
    first: int = 1,
) -> None:
    """Draw instance and category picture of an image of ``size``; numbers are 3001 apart."""
    ids = np.zeros((*size, 3), np.uint8)
    colours = np.zeros((*size, 3), np.uint8)
    for index, (category, mask) in enumerate(objects):
        number = first + 3001 * index
        ids[mask] = number & 255, number >> 8 & 255, number >> 16
        colours[mask] = COLOURS.get(category, (9, 9, 9))
    for folder, kind, picture in ((id_folder, "id", ids), (colour_folder, "color", colours)):
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder / f"{name}_instance_{kind}_RGB.png", picture)


def _write(path: Path, rgb: NDArray[np.uint8]) -> Path:
    assert cv2.imwrite(str(path), rgb[:, :, ::-1])
    return path


GSD = 0.158


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Of iSAID and DOTA: pools and, in P2, a court, a car and a pool too small to count."""
    folder = tmp_path_factory.mktemp("data")
    masks = folder / "isaid" / "train" / "images"
    for name, n_pools in POOLS.items():
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
        write_dota_image(folder / "dota", name, image=blank_image(SIZE[1], SIZE[0]), gsd=GSD)
        write_isaid_pictures(masks, masks, name=name, size=SIZE, objects=objects)
    return folder / "isaid", folder / "dota"


def test_eight_categories_share_a_hundred_entries_irregular_ones_twice() -> None:
    assert quotas(dict.fromkeys(CATEGORIES, 10**6), 100) == {
        category: 20 if category in ("swimming-pool", "roundabout") else 10
        for category in CATEGORIES
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
def test_what_a_category_lacks_goes_to_the_others(
    available: dict[str, int], n: int, expected: list[int]
) -> None:
    assert list(quotas(available, n).values()) == expected


def test_entries_have_the_masks_boxes_and_true_areas(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    built = build_benchmark([folders], tmp_path)
    assert built.issues == []
    assert built.too_small == 1
    assert built.available == {
        **dict.fromkeys(CATEGORIES, 0),
        "swimming-pool": 4,
        "tennis-court": 1,
    }
    assert built.entries == {"swimming-pool": 4, "tennis-court": 1}
    entries = read_areas(tmp_path).entries
    assert Counter(entry.category for entry in entries) == {"swimming-pool": 4, "tennis-court": 1}
    entry = next(entry for entry in entries if entry.image.stem == "P1" and entry.left_px == 360)
    assert entry.corners == (360, 200, 456, 296)
    assert entry.area_m2 == pytest.approx((96 * 96 - 32 * 32) * GSD**2)
    assert np.array_equal(entry.mask, pool_mask(1)[200:296, 360:456])


def test_the_first_entries_have_all_categories(folders: tuple[Path, Path], tmp_path: Path) -> None:
    build_benchmark([folders], tmp_path)
    entries = read_areas(tmp_path).entries
    assert {entry.category for entry in entries[:2]} == {"swimming-pool", "tennis-court"}
    pools = [entry for entry in entries if entry.category == "swimming-pool"]
    assert {entry.image.stem for entry in pools[:3]} == {"P1", "P2", "P3"}


def test_a_seed_decides_and_nothing_else(folders: tuple[Path, Path], tmp_path: Path) -> None:
    def index(seed: int, folder: str) -> str:
        build_benchmark([folders], tmp_path / folder, seed=seed)
        return (tmp_path / folder / "index.csv").read_text()

    assert index(0, "a") == index(0, "b")
    assert len({index(seed, f"c{seed}") for seed in range(3)}) > 1


def test_no_object_of_a_category_is_an_error_that_lists_what_there_is(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    with pytest.raises(InvalidParameterError, match="small-vehicle, swimming-pool, tennis-court"):
        build_benchmark([folders], tmp_path, categories=("harbor",))


def test_the_command_reports_the_choice_and_keeps_a_benchmark(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    isaid, dota = map(str, folders)
    words = ["rs-gsd", "--isaid", isaid, "--dota", dota, "--out", str(tmp_path), "--entries", "2"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert "2 entries" in result.stdout
    assert "swimming-pool: 1 of 4" in result.stdout
    again = CliRunner().invoke(app, words)
    assert again.exit_code == 2
    assert "choose another folder" in again.stderr


def test_an_incomplete_image_is_reported(tmp_path: Path) -> None:
    blank = np.full((40, 60, 3), 90, np.uint8)
    mask = np.zeros((40, 60), bool)
    mask[10:30, 10:30] = True
    dota = tmp_path / "dota"
    masks = tmp_path / "isaid" / "images"
    for name, gsd in (("P1", 0.2), ("P2", None), ("P3", 0.3), ("P4", 0.3)):
        write_dota_image(dota, name, image=blank, gsd=gsd)
    for name in ("P1", "P2", "P4", "P5"):
        write_isaid_pictures(
            masks, masks, name=name, size=(40, 60), objects=[("swimming-pool", mask)]
        )
    write_isaid_pictures(
        masks / "again",
        masks / "again",
        name="P1",
        size=(40, 60),
        objects=[("swimming-pool", mask)],
    )
    (masks / "P4_instance_color_RGB.png").write_bytes(b"no picture")
    images, issues = isaid.find_annotated_images(tmp_path / "isaid", survey_dota(dota))
    assert [image.name for image in images] == ["P1", "P4"]
    assert sorted((issue.reason, issue.file.stem) for issue in issues) == [
        ("duplicate_name", "P1_instance_id_RGB"),
        ("no_gsd", "P2"),
        ("no_masks", "P3"),
    ]
    assert len(images[0].read_masks()) == 1
    with pytest.raises(ImageError, match=r"P4_instance_color_RGB\.png"):
        images[1].read_masks()


def test_a_folder_without_annotations_is_refused(tmp_path: Path) -> None:
    write_dota_image(tmp_path / "dota", "P1", image=np.zeros((20, 20, 3), np.uint8), gsd=0.2)
    (tmp_path / "isaid").mkdir()
    with pytest.raises(InvalidParameterError, match="no iSAID annotations"):
        isaid.find_annotated_images(tmp_path / "isaid", survey_dota(tmp_path / "dota"))


@pytest.mark.parametrize(
    ("text", "area"),
    [
        ("AREA=120", 120),
        ("so 10 x 12\nAREA = 1,234.5 m²", 1234.5),
        ("**AREA=1,234**", 1234),
        ("`AREA=450`", 450),
        ("AREA=1,234,567.89", 1234567.89),
        ("AREA=1.2e3", 1200),
        ("AREA=\\boxed{450}", 450),
        ("AREA=approximately 450 square meters.", 450),
        ("AREA=450 (from 3 cars)", 450),
        ("AREA=100 ± 20", 100),
        ("AREA=<number>\n...\nAREA=77", 77),
    ],
)
def test_an_area_is_read_with_its_unit_and_separators(text: str, area: float) -> None:
    stated = read_area(text)
    assert stated.problem is None
    assert stated.area_m2 == pytest.approx(area)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("It is about 450 m².", "no_area_line"),
        ("", "no_area_line"),
        ("AREA=N/A", "no_number"),
        ("AREA=-5", "no_number"),
        ("AREA=1,2,3", "no_number"),
        ("AREA=1.234,5", "no_number"),
        ("AREA=100-200", "unknown_unit"),
        ("AREA=100 to 200", "unknown_unit"),
        ("AREA=10 x 12 = 120", "unknown_unit"),
        ("AREA=450 pixels", "unknown_unit"),
        ("AREA=450 m", "unknown_unit"),
        ("AREA=2 km2", "unknown_unit"),
    ],
)
def test_what_is_no_area_is_refused_with_its_reason(text: str, problem: str) -> None:
    assert read_area(text) == (None, problem)
