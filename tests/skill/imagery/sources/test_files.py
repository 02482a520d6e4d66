"""Listing of images: which files of a folder are photographs, under either Unicode form of their names."""

from __future__ import annotations

import unicodedata
from pathlib import Path
from typing import Literal

import pytest

import vehanchor
from tests.skill.imagery.files import encoded
from vehanchor.errors import ImageNotFoundError
from vehanchor.imagery.sources.files import existing, where_it_is
from vehanchor.imagery.sources.opening import open_raster

PHOTOGRAPHS = ["DJI_0001.JPG", "deep/DJI_0002.jpg"]
OTHERS = [
    "._DJI_0001.JPG",
    ".hidden.jpg",
    ".thumbnails/DJI_0001.JPG",
    "__MACOSX/DJI_0001.JPG",
    "deep/@eaDir/DJI_0002.jpg/SYNOPHOTO_THUMB_XL.jpg",
    "#recycle/old.jpg",
    "$RECYCLE.BIN/old.jpg",
    "Thumbnails/DJI_0001.JPG",
]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in (*PHOTOGRAPHS, *OTHERS):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"")
    return tmp_path


def test_copies_of_systems_and_viewers_are_no_photographs(folder: Path) -> None:
    photographs = [str(folder / name) for name in PHOTOGRAPHS]
    assert vehanchor.find_images(folder) == photographs
    assert vehanchor.find_images(f"{folder}/**/*.[jJ][pP][gG]") == photographs


def test_what_is_named_is_listed_wherever_it_is(folder: Path) -> None:
    for name in (".hidden.jpg", "Thumbnails", "@missing/*.jpg", "__MACOSX/*.JPG"):
        named = str(folder / name)
        if "missing" in name:
            with pytest.raises(ImageNotFoundError):
                vehanchor.find_images(named)
        else:
            assert len(vehanchor.find_images(named)) == 1


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_a_name_is_found_in_either_unicode_form(
    form: Literal["NFC", "NFD"], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stored = unicodedata.normalize(form, "été/café.png")
    (other,) = {unicodedata.normalize(each, stored) for each in ("NFC", "NFD")} - {stored}
    path = tmp_path / stored
    path.parent.mkdir()
    path.write_bytes(encoded(".png"))
    open_raster(tmp_path / other).close()
    assert where_it_is(tmp_path / other) == str(path.resolve())
    monkeypatch.chdir(tmp_path)
    assert vehanchor.find_images(other) == [stored]
    assert vehanchor.find_images(str(Path(other).parent)) == [stored]
    assert existing(stored) == stored
    assert Path(existing(f"{other}x")) == Path(stored).parent / f"{Path(other).name}x"
