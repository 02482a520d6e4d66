"""Folders of label images: what an index gives, and what it lacks."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from vehanchor.errors import ImageError, InvalidParameterError
from vehanchor_evaluation.areas import read_areas, read_masks


def write_index(folder: Path, *rows: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "index.csv").write_text("\n".join(["image,mask,category,split,gsd_m_per_px", *rows]) + "\n")


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


def test_objects_have_their_masks_boxes_and_true_areas_and_categories_alternate(tmp_path: Path) -> None:
    write_mask(tmp_path / "pools.png", 1000, 1001, 1003)
    write_mask(tmp_path / "courts.png", 7)
    ids = np.zeros((40, 40), np.uint8)
    ids[2:16, 2:30] = 1  # too narrow
    cv2.imwrite(str(tmp_path / "small.png"), ids)
    write_index(tmp_path, *(f"pools.png,{name}.png,{name},val,0.5" for name in ("pools", "courts", "small")))
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
        ("image,mask,category,split,gsd_m_per_px\na,b,c,train,1\n", "no rows of split 'val': it has train"),
        ("image,mask,category,split,gsd_m_per_px\na,b,c,val,1\n", "has no object of 15 px and more; the first problem"),
    ],
)
def test_an_index_that_cannot_be_used_says_what_it_lacks(tmp_path: Path, text: str | None, message: str) -> None:
    if text is not None:
        (tmp_path / "index.csv").write_text(text)
    with pytest.raises(InvalidParameterError, match=message):
        read_areas(tmp_path, "val")
