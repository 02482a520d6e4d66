from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.sam_models import keep_weights_beside, write_sam2
from vehanchor.errors import ModelNotFoundError
from vehanchor.models.cache import file_cached
from vehanchor.models.files import check_model_file


class Loaded:
    """A stand-in for a model: what its file held."""

    def __init__(self, path: Path, threads: int | None) -> None:
        check_model_file(path)
        self.content, self.threads = path.read_bytes(), threads


@file_cached(max_models=2)
def load(path: Path, *, threads: int | None = None, providers: tuple[str, ...] = ("CPU",)) -> Loaded:
    del providers
    return Loaded(path, threads)


@pytest.fixture
def model(tmp_path: Path) -> Path:
    path = tmp_path / "model.onnx"
    path.write_bytes(b"first")
    return path


def test_a_file_is_loaded_once_for_each_set_of_options(model: Path) -> None:
    first = load(model)
    assert load(model) is first
    assert load(model, threads=1) is not first
    assert load(model, threads=1) is load(model, threads=1)


def test_a_replaced_file_is_loaded_anew(model: Path) -> None:
    before = load(model)
    other = model.with_name("other")
    other.write_bytes(b"other")  # of the same size
    os.utime(other, ns=(model.stat().st_mtime_ns, model.stat().st_mtime_ns))
    other.replace(model)
    after = load(model)
    assert (before.content, after.content) == (b"first", b"other")
    assert load(model) is after


def test_a_file_that_was_written_over_is_loaded_anew(model: Path) -> None:
    load(model)
    model.write_bytes(b"longer than the first")
    assert load(model).content == b"longer than the first"
    model.write_bytes(b"same as long as first")
    os.utime(model, ns=(1, model.stat().st_mtime_ns + 1_000_000))
    assert load(model).content == b"same as long as first"


def test_a_relative_path_is_another_file_in_another_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "model.onnx").write_text(name)
    found = []
    for name in ("a", "b", "a"):
        monkeypatch.chdir(tmp_path / name)
        found.append(load(Path("model.onnx")))
    assert [each.content for each in found] == [b"a", b"b", b"a"]
    assert found[2] is found[0]
    assert load(tmp_path / "a" / "model.onnx") is found[0]


def test_other_weights_beside_the_file_are_loaded_anew(tmp_path: Path) -> None:
    _, decoder = write_sam2(tmp_path)
    beside = keep_weights_beside(decoder, ".weights")
    first = load(decoder)
    assert load(decoder) is first
    beside.write_bytes(beside.read_bytes() + b"\0")
    assert load(decoder) is not first


def test_what_fails_is_tried_again(tmp_path: Path) -> None:
    path = tmp_path / "late.onnx"
    with pytest.raises(ModelNotFoundError):
        load(path)
    path.write_bytes(b"here now")
    assert load(path).content == b"here now"


def test_a_path_that_no_file_system_knows_is_left_to_the_loader(tmp_path: Path) -> None:
    for path in (tmp_path, Path("a\0b"), Path("a" * 5000)):
        with pytest.raises((ModelNotFoundError, OSError, ValueError)):
            load(path)


def test_the_one_unused_for_longest_goes_first(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in "abc"]
    for path in paths:
        path.write_text(path.name)
    first, second = load(paths[0]), load(paths[1])
    assert load(paths[0]) is first
    load(paths[2])
    assert load(paths[0]) is first
    assert load(paths[1]) is not second


def test_paths_given_by_keyword_are_files_too(model: Path) -> None:
    first = load(path=model)
    assert load(path=model) is first
    model.write_bytes(b"another")
    assert load(path=model).content == b"another"
