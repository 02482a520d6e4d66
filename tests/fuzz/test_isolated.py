"""The fuzzer of structures finds what ends, hangs or fills a process, and goes on."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.fuzz import isolated
from tests.fuzz.crashing import serve_crashing
from tests.fuzz.isolated import Isolated
from tests.fuzz.structures import Mutator, format_name, structure_of
from tests.skill.imagery.samples import SAMPLES
from vehanchor.imagery.formats.header import IMAGE_FORMATS

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="/proc")


@pytest.fixture
def child(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Isolated:
    """A child that crashes and hangs."""
    monkeypatch.setattr(isolated, "serve", serve_crashing)
    monkeypatch.setattr(isolated, "_HANG_IN_C_S", 1.0)
    monkeypatch.setattr(isolated, "_POLL_S", 0.1)
    return Isolated(tmp_path)


@pytest.mark.parametrize("data", [b"crash", b"hang"])
def test_an_image_that_ends_or_holds_its_process_is_a_finding(
    data: bytes, child: Isolated, tmp_path: Path
) -> None:
    assert child.fails(data)
    assert not child.fails(b"sound")
    child.stop()
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [data]


@pytest.mark.parametrize("name", IMAGE_FORMATS)
def test_numbers_and_parts_of_every_format_are_found(name: str) -> None:
    structure = structure_of(SAMPLES[name])
    assert len(structure.numbers) > 20
    assert structure.parts or name == "BMP"


def test_every_format_has_its_share_of_the_mutants() -> None:
    mutator = Mutator(list(SAMPLES.values()), seed=3)
    names = {format_name(next(mutator)) for _ in range(200)}
    assert names >= set(IMAGE_FORMATS)


@pytest.mark.promise("fuzzing")
def test_mutants_end_no_process(tmp_path: Path) -> None:
    child = Isolated(tmp_path)
    mutator = Mutator(list(SAMPLES.values()), seed=11)
    n_failures = sum(child.fails(next(mutator)) for _ in range(100))
    child.stop()
    assert n_failures == 0
