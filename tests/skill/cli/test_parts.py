"""Parts of the command line: what is installed, names as people read them, garbage collection during imports."""

from __future__ import annotations

import gc
import importlib.metadata
import re

import pytest
from typer.testing import CliRunner

from vehanchor.cli import installation
from vehanchor.cli.app import app
from vehanchor.cli.collection import paused_collection
from vehanchor.cli.installation import PictureCheck
from vehanchor.cli.terminal import under_one_folder


def _checked() -> tuple[int, str]:
    result = CliRunner().invoke(app, ["models", "--check"])
    return result.exit_code, result.stdout


def test_the_bundled_picture_has_the_scale_that_is_known() -> None:
    code, out = _checked()
    assert code == 0, out
    assert re.search(r"check\s+passed", out)
    assert re.search(r"vehanchor\s+0\.", out)
    assert "CPUExecutionProvider" in out


@pytest.mark.parametrize(("gsd", "status"), [(None, "no_scale"), (0.15, "low_confidence"), (0.2, "ok")])
def test_a_scale_that_is_wrong_or_not_usable_fails(
    gsd: float | None, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installation, "check_picture", lambda engine: PictureCheck(gsd, status, 1.0))
    code, out = _checked()
    assert code == 1
    assert "FAILED" in out


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    original = importlib.metadata.version

    def version(name: str) -> str:
        if name == "rasterio":
            raise importlib.metadata.PackageNotFoundError(name)
        return original(name)

    monkeypatch.setattr(installation, "version", version)
    monkeypatch.setattr(installation, "check_picture", lambda engine: PictureCheck(0.15, "ok", 1.0))
    assert re.search(r"rasterio\s+missing: pip install 'vehanchor\[geo\]'", _checked()[1])


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


def test_collection_is_paused_in_the_block_and_leaves_its_objects_out_later() -> None:
    frozen = gc.get_freeze_count()
    try:
        with paused_collection():
            assert not gc.isenabled()
            assert gc.get_freeze_count() <= frozen  # what is frozen can still be freed
        assert gc.isenabled()
        assert gc.get_freeze_count() > frozen
    finally:
        gc.unfreeze()
