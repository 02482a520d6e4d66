"""Images' names as people read them."""

from __future__ import annotations

import pytest

from vehanchor.cli.terminal import under_one_folder


@pytest.mark.parametrize(
    ("names", "folder", "short"),
    [
        (["/a/b/c.jpg", "/a/b/d/e.jpg"], "/a/b", ["c.jpg", "d/e.jpg"]),
        (["flight/a.jpg", "flight/b.jpg"], "flight", ["a.jpg", "b.jpg"]),
        (["/a/b.jpg", "c.jpg"], "", ["/a/b.jpg", "c.jpg"]),
        (["#1", "frame at 3 s"], "", ["#1", "frame at 3 s"]),
    ],
)
def test_names_are_told_without_the_folder_that_all_lie_in(names: list[str], folder: str, short: list[str]) -> None:
    assert under_one_folder(names) == (folder, short)
