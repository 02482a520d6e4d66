"""The benchmark of areas: what is chosen from iSAID, and that the library measures it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from research.paper.__main__ import app
from research.paper.rs_gsd import CATEGORIES, build_benchmark, quotas
from tests.models import blank_image
from tests.research.paper.isaid_data import write_dota_image, write_isaid_pictures
from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.areas import read_areas

GSD = 0.158
POOLS = {"P1": 2, "P2": 1, "P3": 1}
SIZE = 480, 640


def pool_mask(index: int) -> np.ndarray:
    """An L, so that the object is not its box."""
    mask = np.zeros(SIZE, bool)
    top, left = 200, 120 + 240 * index
    mask[top : top + 96, left : left + 64] = True
    mask[top + 32 : top + 96, left : left + 96] = True
    return mask


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
        write_dota_image(folder / "dota", name, blank_image(SIZE[1], SIZE[0]), GSD)
        write_isaid_pictures(masks, masks, name, SIZE, objects)
    return folder / "isaid", folder / "dota"


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


def test_entries_have_the_masks_boxes_and_true_areas(folders: tuple[Path, Path], tmp_path: Path) -> None:
    built = build_benchmark([folders], tmp_path)
    assert built.issues == []
    assert built.too_small == 1
    assert built.available == {**dict.fromkeys(CATEGORIES, 0), "swimming-pool": 4, "tennis-court": 1}
    assert built.entries == {"swimming-pool": 4, "tennis-court": 1}
    entries = read_areas(tmp_path).entries
    assert Counter(entry.category for entry in entries) == {"swimming-pool": 4, "tennis-court": 1}
    entry = next(entry for entry in entries if entry.image.stem == "P1" and entry.left_px == 360)
    assert entry.corners == (360, 200, 456, 296)
    assert entry.area_m2 == pytest.approx((96 * 96 - 32 * 32) * GSD**2)
    assert np.array_equal(entry.mask, pool_mask(1)[200:296, 360:456])


def test_the_first_entries_are_of_all_categories_and_of_many_images(folders: tuple[Path, Path], tmp_path: Path) -> None:
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
    assert len({index(seed, f"c{seed}") for seed in range(6)}) > 1


def test_no_object_of_a_category_is_an_error_that_lists_what_there_is(
    folders: tuple[Path, Path], tmp_path: Path
) -> None:
    with pytest.raises(InvalidParameterError, match="small-vehicle, swimming-pool, tennis-court"):
        build_benchmark([folders], tmp_path, categories=("harbor",))


def test_the_command_says_what_was_chosen_and_keeps_an_earlier_benchmark(
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
