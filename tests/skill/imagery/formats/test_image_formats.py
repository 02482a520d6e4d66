"""Rules for every format in ``IMAGE_FORMATS``: a new format is tested here without a line."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest

import vehanchor
from tests import bombs
from tests.conftest import ROOT
from tests.skill.imagery.files import RGB, header_of, read_all
from tests.skill.imagery.samples import SAMPLES
from vehanchor.errors import ImageDecodeError
from vehanchor.imagery.formats.header import IMAGE_FORMATS, SUFFIXES, recognise_format
from vehanchor.imagery.sources.opening import DECODERS_OF_EXTRAS

_WITH_EXTRA = [name for name, image in IMAGE_FORMATS.items() if image.extra is not None]
_WITHOUT_EXTRA = [name for name in IMAGE_FORMATS if name not in _WITH_EXTRA]
_MAX_MEAN_DIFFERENCE = 3.0
"""Mean error of lossy formats, in grey levels."""


@pytest.mark.parametrize("name", IMAGE_FORMATS)
def test_its_file_is_recognised_by_one_format(name: str) -> None:
    start = SAMPLES[name][:32]
    assert [key for key, image in IMAGE_FORMATS.items() if image.recognises(start)] == [name]
    assert recognise_format(start) is IMAGE_FORMATS[name]


@pytest.mark.parametrize("name", IMAGE_FORMATS)
def test_its_header_has_its_name(name: str) -> None:
    assert header_of(SAMPLES[name]).format == name


@pytest.mark.parametrize("name", _WITHOUT_EXTRA)
def test_its_pixels_are_read(name: str) -> None:
    difference = np.abs(read_all(SAMPLES[name]).astype(int) - RGB)
    assert difference.mean() <= _MAX_MEAN_DIFFERENCE


@pytest.mark.parametrize("share", [0.02, 0.2, 0.5, 0.9, 0.97])
@pytest.mark.parametrize("name", _WITHOUT_EXTRA)
def test_a_part_of_its_file_is_not_measured(name: str, share: float) -> None:
    data = SAMPLES[name]
    with pytest.raises(ImageDecodeError):
        read_all(data[: int(share * len(data))])


@pytest.mark.parametrize("name", IMAGE_FORMATS)
def test_its_files_are_found_in_a_folder(name: str, tmp_path: Path) -> None:
    suffixes = IMAGE_FORMATS[name].suffixes
    paths = [tmp_path / f"photo{suffix}" for suffix in suffixes]
    for path in paths:
        path.touch()
    assert vehanchor.find_images(tmp_path) == sorted(map(str, paths))


def test_no_suffix_belongs_to_two_formats() -> None:
    assert len(SUFFIXES) == len(set(SUFFIXES))


def test_every_format_with_an_extra_has_a_decoder() -> None:
    assert list(DECODERS_OF_EXTRAS) == _WITH_EXTRA


@pytest.mark.parametrize("name", _WITH_EXTRA)
def test_its_extra_installs_its_package(name: str) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extra = IMAGE_FORMATS[name].extra
    assert extra is not None
    (requirement, *_) = project["optional-dependencies"][extra.name]
    assert requirement.startswith(extra.package)


def test_every_format_that_opencv_decodes_has_its_memory_measured() -> None:
    """``bombs.FORMATS`` are the files whose memory a slow test measures."""
    measured = {header_of(make(16)).format for make in bombs.FORMATS.values()}
    assert measured == {name for name, image in IMAGE_FORMATS.items() if image.opencv}


def test_the_documentation_names_every_format() -> None:
    text = (ROOT / "docs/reading.md").read_text(encoding="utf-8")
    inputs = text.partition("## Inputs\n")[2].partition("\n## ")[0]
    missing = [name for name in IMAGE_FORMATS if name not in " ".join(inputs.split())]
    assert missing == []
