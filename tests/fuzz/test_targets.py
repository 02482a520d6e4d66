from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from tests.fuzz.drive import Checked, Slow, drive_blindly, mutated
from tests.fuzz.targets import CORPUS, TARGETS


@pytest.mark.promise("fuzzing")
@pytest.mark.parametrize("name", TARGETS)
def test_mutations_of_the_corpus_give_answers_or_our_errors(name: str, tmp_path: Path) -> None:
    corpus = CORPUS[name]()
    random = np.random.default_rng(16)
    checked = Checked(TARGETS[name], tmp_path)
    for data in corpus:
        checked(data)
        for _ in range(3):
            checked(mutated(data, corpus, random))
    assert not any(tmp_path.iterdir())


def _fails(data: bytes) -> None:
    if data:
        raise ZeroDivisionError


def _hangs(data: bytes) -> None:
    while True:
        pass


@pytest.fixture
def failing(tmp_path: Path) -> Checked:
    """A target that fails, after a drive."""
    checked = Checked(_fails, tmp_path)
    drive_blindly(checked, [b"seed"], seconds=math.inf, seed=1, n_inputs=9)
    return checked


def test_the_drive_continues_after_a_failure(failing: Checked) -> None:
    assert failing.n_failures > 1


def test_an_input_that_fails_is_kept(failing: Checked, tmp_path: Path) -> None:
    assert list(tmp_path.iterdir())


def test_an_input_that_hangs_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.fuzz.drive.HANG_S", 0.02)
    with pytest.raises(Slow):
        Checked(_hangs, tmp_path)(b"x")
