from __future__ import annotations

import errno
import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest

from tests.conftest import ROOT
from tests.skill.cut_off import CALIBRATION
from vehanchor.analysis.journal_classes import STORED_CLASSES
from vehanchor.detection.detections import Detections
from vehanchor.detection.scene_scale import SceneScalePrior
from vehanchor.errors import InvalidParameterError, OutputError
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.raster import RasterNote
from vehanchor.rulers.ruler import assumed, point_witness, prior_witness
from vehanchor.scale.density import lognormal
from vehanchor.scale.posterior import Mark, Witness
from vehanchor.scale.reliability import Shared
from vehanchor.storage.atomic import whole_file, write_record
from vehanchor.storage.codec import Codec
from vehanchor.storage.journal import Journal, Source
from vehanchor_flight.photograph import StoredPhotograph, photograph_codec


def _journal(
    path: Path | None, settings: dict[str, Any] | None = None, **choices: Any
) -> Journal[Any]:
    return Journal(
        path,
        settings or {"model": "m"},
        dump=lambda value: value,
        load=lambda value: value,
        **choices,
    )


def test_several_settings_share_a_file_and_do_not_see_each_other(tmp_path: Path) -> None:
    path = tmp_path / "j.journal"
    first = _journal(path, {"alpha": 1.5})
    second = _journal(path, {"alpha": None})
    first.add(("a",), "first")
    second.add(("a",), "second")
    first.add(("b",), "first")
    assert [_journal(path, {"alpha": 1.5}).get((name,)) for name in "ab"] == ["first", "first"]
    assert [_journal(path, {"alpha": None}).get((name,)) for name in "ab"] == ["second", None]


def test_a_sole_journal_says_in_what_other_settings_differ(tmp_path: Path) -> None:
    path = tmp_path / "j.journal"
    _journal(path, {"search": {"tile_px": 512, "min_score": None}}).add(("a",), 1)
    with pytest.raises(
        InvalidParameterError, match=r"with search.tile_px 512 \(now 640\): finish .* or burn it"
    ):
        _journal(path, {"search": {"tile_px": 640, "min_score": None}}, sole=True, remedy="burn it")


def test_a_place_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "j.journal", tmp_path):
        with pytest.raises(OutputError, match="cannot keep results in"):
            _journal(path)


def test_threads_may_add_at_once(tmp_path: Path) -> None:
    journal = _journal(tmp_path / "j.journal")

    def add_twenty(k: int) -> None:
        for n in range(20):
            journal.add((k, n), f"{k} {n}")

    threads = [Thread(target=add_twenty, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    again = _journal(journal.path)
    assert all(again.get((k, n)) == f"{k} {n}" for k in range(8) for n in range(20))


def test_a_file_is_another_source_once_its_size_or_time_is(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    missing = Source.of(path)
    path.write_bytes(b"abc")
    first = Source.of(path)
    assert first == (str(path.resolve()), 3, path.stat().st_mtime_ns)
    os.utime(path, ns=(1, 1))
    touched = Source.of(path)
    path.write_bytes(b"abcd")
    os.utime(path, ns=(1, 1))
    assert len({missing, first, touched, Source.of(path)}) == 4
    (tmp_path / "link.png").symlink_to(path)
    assert Source.of(tmp_path / "link.png") == Source.of(path)


def _interrupted(path: Path) -> None:
    with whole_file(path) as partial:
        partial.write_text("half")
        raise KeyboardInterrupt


def test_a_file_is_replaced_only_once_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt):
        _interrupted(path)
    assert path.read_text() == "old"
    with whole_file(path) as partial:
        partial.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert [file.name for file in tmp_path.iterdir()] == ["t.csv"]
    with (
        pytest.raises(OutputError, match="cannot write"),
        whole_file(tmp_path / "no" / "t.csv") as partial,
    ):
        partial.write_text("nowhere")


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="Windows has no kill -9")
def test_a_run_that_is_killed_loses_nothing(tmp_path: Path) -> None:
    path = tmp_path / "j.journal"
    add = (
        "import sys; from pathlib import Path; from vehanchor.storage.journal import "
        "Journal\njournal = Journal(Path(sys.argv[1]), {'model': 'm'}, dump=dict, load=dict, "
        "sole=True)\nfor number in range(len(journal), 10**6):\n    journal.add(('f', number), "
        "{'n': number, 'long': 'x' * 5000}); print(number, flush=True)\n"
    )
    for seconds in (0.0, 0.01, 0.1):
        process = subprocess.Popen(
            [sys.executable, "-c", add, str(path)], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        told = [int(process.stdout.readline())]
        time.sleep(seconds)
        process.kill()
        told += map(int, process.communicate()[0].splitlines())
        with _journal(path, sole=True) as journal:
            assert len(journal) - 1 - told[-1] in (0, 1), (
                "the next result may be there before it is told"
            )
            found = [journal.get(("f", n)) for n in range(len(journal))]
            assert [each and each["n"] for each in found] == list(range(len(journal)))


@pytest.mark.parametrize("content", [b"not json\n", b"no end", b"x" * 5000])
def test_a_file_that_is_no_journal_is_left_alone(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.journal"
    path.write_bytes(content)
    with pytest.raises(
        InvalidParameterError, match=r"is not a journal, or is damaged .*: move the file away"
    ):
        _journal(path)
    assert path.read_bytes() == content
    assert len(_journal(path, anew=True)) == 0


def test_a_database_of_another_program_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "x.journal"
    with closing(sqlite3.connect(path)) as other:
        other.execute("CREATE TABLE results (name TEXT)")
    content = path.read_bytes()
    for anew in (False, True):
        with pytest.raises(InvalidParameterError, match="it belongs to another program"):
            _journal(path, anew=anew)
    assert path.read_bytes() == content


def test_a_damaged_value_is_told_with_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / "j.journal"
    with _journal(path) as journal:
        journal.add(("a",), {"n": 1.25, "names": ["x"]})
    path.write_bytes(path.read_bytes().replace(b'"names"', b'"names('))
    with pytest.raises(
        InvalidParameterError, match=r"unreadable result of \('a',\).*: move the file away"
    ):
        _journal(path).get(("a",))


def test_a_journal_belongs_to_one_run_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "j.journal"
    with _journal(path, sole=True) as first:
        first.add(("a",), 1)
        for anew in (False, True):
            with pytest.raises(
                OutputError, match=r"another run is using .*: wait until it has ended"
            ):
                _journal(path, sole=True, anew=anew)
        assert first.get(("a",)) == 1
    with _journal(path, sole=True) as second:
        assert second.get(("a",)) == 1
    with _journal(path, sole=True, anew=True) as third:
        assert len(third) == 0
        third.remove()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("sole", [True, False])
@pytest.mark.parametrize("exists", [True, False])
def test_a_link_is_not_followed(tmp_path: Path, sole: bool, exists: bool) -> None:
    victim = tmp_path / "victim"
    path = tmp_path / "j.journal"
    if exists:
        victim.write_bytes(b"")
    path.symlink_to(victim)
    with pytest.raises(OutputError, match=r"j\.journal' is a link: remove it"):
        _journal(path, sole=sole)
    assert victim.exists() == exists


def _stored() -> StoredPhotograph:
    scene = SceneScalePrior(np.linspace(0.1, 0.3, 7), 9)
    found = Detections(np.random.default_rng(1).normal(size=(4, 5)), np.linspace(0.1, 0.9, 4))
    facts = ImageFacts(
        10,
        20,
        georeference_gsd_m_per_px=None,
        notices=(RasterNote("a", "b"),),
        camera=CameraMetadata(make="x", height_m=3.0),
    )
    return StoredPhotograph(facts, found, 0.7, prior=scene)


def test_intermediate_results_come_back_exactly() -> None:
    before = _stored()
    after = photograph_codec().load(json.loads(json.dumps(photograph_codec().dump(before))))
    assert isinstance(after, StoredPhotograph)
    assert after.image == before.image
    assert after.detail_share == 0.7
    assert np.array_equal(after.detections.boxes, before.detections.boxes)
    assert after.detections.boxes.dtype == before.detections.boxes.dtype
    assert after.prior is not None
    assert before.prior is not None
    assert np.array_equal(after.prior.density, before.prior.density)
    after.detections.boxes[0] = 1  # and may be changed


def test_a_journal_with_former_names_is_read() -> None:
    stored = json.dumps(photograph_codec().dump(_stored()))
    for former, today in {
        "resolved": "detail_share",
        "scales": "reductions",
        "looks": "appearance",
    }.items():
        assert f'"{today}"' in stored
        stored = stored.replace(f'"{today}"', f'"{former}"')
    assert photograph_codec().load(json.loads(stored)).detail_share == 0.7


@pytest.mark.parametrize(
    "found",
    [
        {"=": "subprocess:Popen", "fields": {"args": "true"}},
        {"=": "vehanchor_flight.photograph:StoredPhotograph", "fields": {}},
        {"=": "array", "dtype": "O", "shape": [1], "data": ""},
    ],
)
def test_a_journal_can_start_nothing(found: object) -> None:
    with pytest.raises(ValueError, match="stored"):
        photograph_codec().load(found)


@pytest.mark.parametrize(
    "witness",
    [
        point_witness(
            "camera",
            0.1,
            log_sd=0.02,
            chance_wrong=0.05,
            said="{}",
            shared=[Shared("lens", 0.03)],
            marks=[Mark(((1, 2),), "up")],
        ),
        assumed(point_witness("height", 0.1, log_sd=0.1, chance_wrong=0.05, said="{}")),
        prior_witness("scene_scale", lognormal(0.1, 0.2), power=0.7, n=24),
        Witness("courts", n=0),
    ],
    ids=lambda witness: witness.kind,
)
def test_all_witnesses_of_the_rulers_can_be_stored(witness: Witness) -> None:
    codec = Codec(STORED_CLASSES)
    found = codec.load(json.loads(json.dumps(codec.dump(witness))))
    assert type(found) is Witness
    assert found.interval == witness.interval
    assert (found.shared, found.marks, found.assumed) == (
        witness.shared,
        witness.marks,
        witness.assumed,
    )
    assert [lack.reason for lack in found.lacks] == [lack.reason for lack in witness.lacks]
    assert np.array_equal(found.density, witness.density)


def test_a_refused_flush_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "c.json"
    path.write_bytes(b"old")

    def refused(descriptor: int) -> None:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "fsync", refused)
    with pytest.raises(OutputError):
        write_record(path, CALIBRATION)
    assert path.read_bytes() == b"old"


@pytest.mark.promise("files")
@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="Windows has no limit of a file's size")
def test_no_file_is_half_written_wherever_the_disk_is_full_or_the_process_killed(
    tmp_path: Path,
) -> None:
    command = [sys.executable, "-m", "tests.skill.cut_off", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["wrong"] == []
    assert found["ends"]["refused"] > 100
    assert found["ends"]["killed"] > 40
