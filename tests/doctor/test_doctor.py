from __future__ import annotations

import importlib.metadata
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.conftest import ROOT
from vehanchor.cli.app import app
from vehanchor.engine import Engine
from vehanchor_doctor import checks

SCENES = ROOT / "examples" / "scenes"


def run(*arguments: object) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, [str(each) for each in arguments])
    return result.exit_code, result.stdout, result.stderr


def test_the_bundled_model_passes_the_self_test() -> None:
    found = checks.self_test(Engine())
    assert found.passed, found


@pytest.mark.parametrize(("gsd", "status"), [(None, "no_scale"), (0.1, "low_confidence"), (0.2, "ok")])
def test_a_scale_that_is_wrong_or_not_to_be_used_fails_it(
    gsd: float | None, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    failed = checks.SelfTest(0.1, gsd, status, 1.0)
    assert not failed.passed
    monkeypatch.setattr(checks, "self_test", lambda detector: failed)
    code, out, _ = run("doctor")
    assert code == 1
    assert "FAILED" in out


def test_what_is_installed_is_told_and_what_is_missing_by_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    original = importlib.metadata.version

    def version(name: str) -> str:
        if name == "rasterio":
            raise importlib.metadata.PackageNotFoundError(name)
        return original(name)

    monkeypatch.setattr(checks, "version", version)
    code, out, _ = run("doctor", "--no-test")
    assert code == 0
    assert re.search(r"vehanchor\s+0\.", out)
    assert "CPUExecutionProvider" in out
    assert re.search(r"rasterio\s+missing: pip install 'vehanchor\[geo\]'", out)


def test_it_says_of_a_folder_how_many_will_do_and_what_helps_the_others(tmp_path: Path) -> None:
    for name in ("safe.jpg", "no_cars.jpg"):
        found = next(iter(SCENES.glob(name)), None)
        if found is not None:
            (tmp_path / name).write_bytes(found.read_bytes())
    (tmp_path / "broken.jpg").write_bytes(b"no image")
    cv2.imwrite(str(tmp_path / "large.png"), np.full((400, 400, 3), 90, np.uint8))  # a large JPEG is read by windows
    n = len(list(tmp_path.iterdir()))
    code, out, _ = run("doctor", "--no-test", tmp_path)
    assert code == 0
    assert f"{n} of {n} images" in out
    assert re.search(rf"usable\s+1 of {n} ", out)
    assert re.search(r"1 x image_undecodable\s+an error", out)
    code, out, _ = run("doctor", "--no-test", "--max-megapixels", "0.1", tmp_path)
    assert re.search("1 x image_too_large", out)
    code, out, _ = run("doctor", "--no-test", "--sample", "1", tmp_path)
    assert f"1 of {n} images" in out


def test_a_folder_without_images_is_an_error(tmp_path: Path) -> None:
    code, _, told = run("doctor", "--no-test", tmp_path)
    assert code == 2
    assert "image_not_found" in told
