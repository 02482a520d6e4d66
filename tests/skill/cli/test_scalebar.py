from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.models import blank_image, write_detector
from vehanchor.cli.app import app


def run(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["scalebar", *(str(each) for each in arguments)])
    return result.exit_code, result.stderr


@pytest.fixture
def image(tmp_path: Path) -> Path:
    assert cv2.imwrite(str(tmp_path / "image.png"), blank_image(1000, 600))
    return tmp_path / "image.png"


def test_the_bar_is_as_long_as_it_says(image: Path) -> None:
    out = image.with_name("out.png")
    assert run(image, "-o", out, "--gsd", "0.1", "--world-file") == (0, "")
    before, after = cv2.imread(str(image)), cv2.imread(str(out))
    assert before is not None
    assert after is not None
    assert after.shape == before.shape
    white = np.argwhere((after == 255).all(2) & (before != 255).any(2))
    bar = white[white[:, 0] > white[:, 0].max() - 3]
    assert bar[:, 1].max() - bar[:, 1].min() == pytest.approx(200, abs=2)  # 20 m, a fifth of the picture's width
    a, _, _, d, x, y = (float(line) for line in out.with_suffix(".pgw").read_text().split())
    assert (a, d, x, y) == pytest.approx((0.1, -0.1, 0.05, -0.05))


def test_a_picture_that_is_reduced_has_its_own_pixel_size(tmp_path: Path) -> None:
    large, out = tmp_path / "large.png", tmp_path / "out.jpg"
    assert cv2.imwrite(str(large), blank_image(4096, 1024))
    assert run(large, "-o", out, "--gsd", "0.1", "--world-file")[0] == 0
    assert float(out.with_suffix(".jgw").read_text().split()[0]) == pytest.approx(0.2)


def test_without_a_usable_scale_nothing_is_written(image: Path, tmp_path: Path) -> None:
    out = image.with_name("out.png")
    code, told = run(image, "-o", out, "--detector", write_detector(tmp_path / "painted.onnx"))
    assert (code, told.strip()) == (3, "no bar: there is no scale; nothing was written")
    assert not out.exists()


def test_the_image_itself_is_never_overwritten(image: Path) -> None:
    code, told = run(image, "-o", image, "--gsd", "0.1")
    assert code == 2
    assert "is the image itself" in told
