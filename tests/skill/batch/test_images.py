"""Images of a run: directories, patterns and files."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.skill.batch.runs import FILES, run_command
from vehanchor.batch import find_images
from vehanchor.errors import ImageNotFoundError


def test_a_directory_is_searched_recursively(folder: Path) -> None:
    assert find_images([str(folder)]) == [str(folder / name) for name in FILES]


@pytest.mark.parametrize(
    "names", [["nowhere"], ["cars.png", "nowhere"], ["nowhere.png/"], ["a.png", "b.jpg"]]
)
def test_a_missing_folder_ends_the_command_without_an_output(
    names: list[str], tmp_path: Path
) -> None:
    result = run_command(*names, "--output", tmp_path / "table.csv")
    assert result.exit_code == 2
    assert result.stderr.startswith("error[image_not_found]: there is no file")
    assert list(tmp_path.iterdir()) == []


def test_a_pattern_matches_images_alone() -> None:
    assert find_images("*") == ["broken.jpg", "cars.png", "empty.png"]


def test_each_image_is_listed_once_in_the_order_of_the_inputs() -> None:
    inputs = ["empty.png", "*.png", "deep", "**/*.PNG"]
    assert find_images(inputs) == ["empty.png", "cars.png", "deep/below/cars.PNG"]


def test_a_file_may_have_the_characters_of_a_pattern(folder: Path, tmp_path: Path) -> None:
    odd = tmp_path / "photo[1].png"
    odd.write_bytes((folder / "cars.png").read_bytes())
    assert find_images([str(odd)]) == [str(odd)]


def test_folders_behind_links_are_searched_once(folder: Path, tmp_path: Path) -> None:
    data = (folder / "cars.png").read_bytes()
    top = tmp_path / "top"
    for name in ("elsewhere", "top/real"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "cars.png").write_bytes(data)
    (top / "link").symlink_to(tmp_path / "elsewhere")
    (top / "a second name").symlink_to(top / "real")
    (top / "real/round").symlink_to(top)
    (tmp_path / "only links").mkdir()
    (tmp_path / "only links/2026").symlink_to(tmp_path / "elsewhere")
    assert find_images([str(top)]) == [str(top / "link/cars.png"), str(top / "real/cars.png")]
    assert find_images(tmp_path / "only links") == [str(tmp_path / "only links/2026/cars.png")]


@pytest.mark.parametrize("inputs", [[], ["*.tiff"], ["empty folder"]])
def test_inputs_without_images_are_refused(
    inputs: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty folder").mkdir()
    with pytest.raises(ImageNotFoundError, match="no image"):
        find_images(inputs)
