"""Journals, their sources and codecs, and files that are written as a whole."""

from __future__ import annotations

import errno
import json
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
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
from vehanchor.rulers.ruler import as_assumed, point_witness, prior_witness
from vehanchor.scale.density import lognormal
from vehanchor.scale.posterior import Mark, Witness
from vehanchor.scale.reliability import Shared
from vehanchor.storage.atomic import beside, whole_file, write_record
from vehanchor.storage.codec import Codec
from vehanchor.storage.exclusive import has_locks
from vehanchor.storage.journal import Journal, Source
from vehanchor_flight.photograph import StoredPhotograph, photograph_codec

# --- Files


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A file that is to be replaced, alone in its folder."""
    path = tmp_path / "t.csv"
    path.write_text("old")
    return path


def test_a_file_is_replaced_once_the_new_one_is_whole(old: Path) -> None:
    with whole_file(old) as partial:
        partial.write_text("new")
        assert old.read_text() == "old"
    assert old.read_text() == "new"
    assert [file.name for file in old.parent.iterdir()] == ["t.csv"]


def test_an_interruption_leaves_the_old_file(old: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        _write_half(old)
    assert old.read_text() == "old"
    assert [file.name for file in old.parent.iterdir()] == ["t.csv"]


def _write_half(path: Path) -> None:
    with whole_file(path) as partial:
        partial.write_text("half")
        raise KeyboardInterrupt


def test_a_missing_folder_is_an_output_error(tmp_path: Path) -> None:
    with (
        pytest.raises(OutputError, match="cannot write"),
        whole_file(tmp_path / "no" / "t.csv") as partial,
    ):
        partial.write_text("nowhere")


# --- Journals


def _journal(
    path: Path | None, settings: dict[str, Any] | None = None, **options: Any
) -> Journal[Any]:
    return Journal(
        path,
        settings or {"model": "m"},
        dump=lambda value: value,
        load=lambda value: value,
        **options,
    )


def test_several_settings_have_their_own_results_in_one_file(tmp_path: Path) -> None:
    path = tmp_path / "j.journal"
    first = _journal(path, {"alpha": 1.5})
    second = _journal(path, {"alpha": None})
    first.add(("a",), "first")
    second.add(("a",), "second")
    first.add(("b",), "first")
    assert [_journal(path, {"alpha": 1.5}).get((name,)) for name in "ab"] == ["first", "first"]
    assert [_journal(path, {"alpha": None}).get((name,)) for name in "ab"] == ["second", None]


def test_a_sole_journal_names_the_settings_that_differ(tmp_path: Path) -> None:
    path = tmp_path / "j.journal"
    _journal(path, {"search": {"tile_px": 512, "min_score": None}}).add(("a",), 1)
    message = r"with search.tile_px 512 \(now 640\): finish .* or burn it"
    other = {"search": {"tile_px": 640, "min_score": None}}
    with pytest.raises(InvalidParameterError, match=message):
        _journal(path, other, sole=True, remedy="burn it")


@pytest.mark.parametrize("name", ["file/j.journal", "."])
def test_an_unwritable_path_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot keep results in"):
        _journal(tmp_path / name)


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


def test_a_source_changes_with_the_size_or_time_of_its_file(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    missing = Source.of(path)
    path.write_bytes(b"abc")
    first = Source.of(path)
    assert first == (str(path.resolve()), 3, path.stat().st_mtime_ns)
    os.utime(path, ns=(1, 1))
    touched = Source.of(path)
    path.write_bytes(b"abcd")
    os.utime(path, ns=(1, 1))
    longer = Source.of(path)
    assert len({missing, first, touched, longer}) == 4


def test_a_link_has_the_source_of_its_file(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(b"abc")
    (tmp_path / "link.png").symlink_to(path)
    assert Source.of(tmp_path / "link.png") == Source.of(path)


# Adds long results, and prints the number of each.
ADD_RESULTS = """
import sys
from pathlib import Path
from vehanchor.storage.journal import Journal

journal = Journal(Path(sys.argv[1]), {"model": "m"}, dump=dict, load=dict, sole=True)
for number in range(len(journal), 10**6):
    journal.add(("f", number), {"n": number, "long": "x" * 5000})
    print(number, flush=True)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="Windows has no kill -9")
def test_a_killed_run_loses_no_result(tmp_path: Path) -> None:
    path = tmp_path / "j.journal"
    for seconds in (0.0, 0.01, 0.1):
        process = subprocess.Popen(
            [sys.executable, "-c", ADD_RESULTS, str(path)], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        printed = [int(process.stdout.readline())]
        time.sleep(seconds)
        process.kill()
        rest, _ = process.communicate()
        printed += map(int, rest.splitlines())
        with _journal(path, sole=True) as journal:
            n_results = len(journal)
            # The process may have added a result without having printed its number.
            assert n_results - 1 - printed[-1] in (0, 1)
            results = [journal.get(("f", n)) for n in range(n_results)]
            assert [result and result["n"] for result in results] == list(range(n_results))


@pytest.mark.parametrize("content", [b"not json\n", b"no end", b"x" * 5000])
def test_a_file_that_is_not_a_journal_is_replaced_only_on_request(
    tmp_path: Path, content: bytes
) -> None:
    path = tmp_path / "x.journal"
    path.write_bytes(content)
    message = r"is not a journal, or is damaged .*: move the file away"
    with pytest.raises(InvalidParameterError, match=message):
        _journal(path)
    assert path.read_bytes() == content
    assert len(_journal(path, anew=True)) == 0


@pytest.mark.parametrize("anew", [False, True])
def test_a_database_of_another_program_is_never_changed(tmp_path: Path, anew: bool) -> None:
    path = tmp_path / "x.journal"
    with closing(sqlite3.connect(path)) as other:
        other.execute("CREATE TABLE results (name TEXT)")
    content = path.read_bytes()
    with pytest.raises(InvalidParameterError, match="it belongs to another program"):
        _journal(path, anew=anew)
    assert path.read_bytes() == content


def test_a_damaged_value_is_refused_with_the_remedy(tmp_path: Path) -> None:
    path = tmp_path / "j.journal"
    with _journal(path) as journal:
        journal.add(("a",), {"n": 1.25, "names": ["x"]})
    path.write_bytes(path.read_bytes().replace(b'"names"', b'"names('))
    message = r"unreadable result of \('a',\).*: move the file away"
    with pytest.raises(InvalidParameterError, match=message):
        _journal(path).get(("a",))


@pytest.mark.parametrize("anew", [False, True])
def test_a_sole_journal_is_locked_until_it_is_closed(tmp_path: Path, anew: bool) -> None:
    path = tmp_path / "j.journal"
    with _journal(path, sole=True) as first:
        first.add(("a",), 1)
        message = r"another run is using .*: wait until it has ended"
        with pytest.raises(OutputError, match=message):
            _journal(path, sole=True, anew=anew)
        assert first.get(("a",)) == 1
    with _journal(path, sole=True) as second:
        assert second.get(("a",)) == 1


def test_a_journal_may_be_started_anew(tmp_path: Path) -> None:
    path = tmp_path / "j.journal"
    with _journal(path, sole=True) as first:
        first.add(("a",), 1)
    with _journal(path, sole=True, anew=True) as second:
        assert len(second) == 0


def test_a_removed_journal_leaves_no_file(tmp_path: Path) -> None:
    with _journal(tmp_path / "j.journal", sole=True) as journal:
        journal.add(("a",), 1)
        journal.remove()
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


# --- Codecs


@pytest.fixture
def photograph() -> StoredPhotograph:
    """Intermediate results of a photograph, with values of every kind."""
    scene = SceneScalePrior(np.linspace(0.1, 0.3, 7), 9)
    boxes = np.random.default_rng(1).normal(size=(4, 5))
    detections = Detections(boxes, np.linspace(0.1, 0.9, 4))
    facts = ImageFacts(
        10,
        20,
        georeference_gsd_m_per_px=None,
        notices=(RasterNote("a", "b"),),
        camera=CameraMetadata(make="x", height_m=3.0),
    )
    return StoredPhotograph(facts, detections, 0.7, prior=scene)


@pytest.fixture
def stored(photograph: StoredPhotograph) -> str:
    return json.dumps(photograph_codec().dump(photograph))


@pytest.fixture
def loaded(stored: str) -> StoredPhotograph:
    loaded = photograph_codec().load(json.loads(stored))
    assert isinstance(loaded, StoredPhotograph)
    return loaded


def test_values_of_json_come_back_exactly(
    photograph: StoredPhotograph, loaded: StoredPhotograph
) -> None:
    assert loaded.image == photograph.image
    assert loaded.detail_share == 0.7


def test_arrays_come_back_exactly(photograph: StoredPhotograph, loaded: StoredPhotograph) -> None:
    assert np.array_equal(loaded.detections.boxes, photograph.detections.boxes)
    assert loaded.detections.boxes.dtype == photograph.detections.boxes.dtype
    assert loaded.prior is not None
    assert photograph.prior is not None
    assert np.array_equal(loaded.prior.density, photograph.prior.density)


def test_arrays_that_come_back_can_be_changed(loaded: StoredPhotograph) -> None:
    loaded.detections.boxes[0] = 1
    assert (loaded.detections.boxes[0] == 1).all()


def test_a_journal_with_former_names_is_read(stored: str) -> None:
    names = {"resolved": "detail_share", "scales": "reductions", "looks": "appearance"}
    for former, today in names.items():
        assert f'"{today}"' in stored
        stored = stored.replace(f'"{today}"', f'"{former}"')
    assert photograph_codec().load(json.loads(stored)).detail_share == 0.7


@pytest.mark.parametrize(
    "foreign",
    [
        {"=": "subprocess:Popen", "fields": {"args": "true"}},
        {"=": "vehanchor_flight.photograph:StoredPhotograph", "fields": {}},
        {"=": "array", "dtype": "O", "shape": [1], "data": ""},
    ],
)
def test_a_foreign_journal_can_run_nothing(foreign: object) -> None:
    with pytest.raises(ValueError, match="stored"):
        photograph_codec().load(foreign)


@pytest.mark.parametrize(
    "witness",
    [
        point_witness(
            "camera",
            0.1,
            log_sd=0.02,
            chance_wrong=0.05,
            statement="{}",
            shared=[Shared("lens", 0.03)],
            marks=[Mark(((1, 2),), "up")],
        ),
        as_assumed(point_witness("height", 0.1, log_sd=0.1, chance_wrong=0.05, statement="{}")),
        prior_witness("scene_scale", lognormal(0.1, 0.2), power=0.7, n=24),
        Witness("courts", n=0),
    ],
    ids=lambda witness: witness.kind,
)
def test_all_witnesses_of_the_rulers_can_be_stored(witness: Witness) -> None:
    codec = Codec(STORED_CLASSES)
    loaded = codec.load(json.loads(json.dumps(codec.dump(witness))))
    assert type(loaded) is Witness
    assert loaded.interval == witness.interval
    assert loaded.shared == witness.shared
    assert loaded.marks == witness.marks
    assert loaded.assumed == witness.assumed
    assert [lack.reason for lack in loaded.lacks] == [lack.reason for lack in witness.lacks]
    assert np.array_equal(loaded.density, witness.density)


# --- A full disk


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
def test_no_file_is_half_written_at_any_byte(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.skill.cut_off", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["wrong"] == []
    assert report["ends"]["refused"] > 100
    assert report["ends"]["killed"] > 40


# --- Places to write


@pytest.mark.parametrize("letter", ["a", "\N{CJK UNIFIED IDEOGRAPH-7A7A}"])
def test_a_name_of_any_legal_length_is_written(letter: str, tmp_path: Path) -> None:
    stem = letter * (250 // len(letter.encode()))
    path = tmp_path / f"{stem}.csv"
    with whole_file(path) as partial:
        partial.write_text("new")
    with closing(_journal(beside(path, ".journal"))) as journal:
        journal.add(("a",), 1)
    assert path.read_text() == "new"


def test_a_long_name_is_always_shortened_alike(tmp_path: Path) -> None:
    long = tmp_path / ("a" * 250)
    other = tmp_path / ("a" * 249 + "b")
    assert beside(long, ".journal") == beside(long, ".journal")
    assert beside(long, ".journal") != beside(other, ".journal")
    assert beside(tmp_path / "t.csv", ".journal").name == "t.csv.journal"


@pytest.fixture
def lockless(monkeypatch: pytest.MonkeyPatch) -> None:
    """A system on which SQLite can open no file with locks."""
    connect: Callable[..., sqlite3.Connection] = sqlite3.connect

    def refuse_locks(address: str, *arguments: Any, **options: Any) -> sqlite3.Connection:
        if "nolock=1" in address:
            return connect(address, *arguments, **options)
        error = sqlite3.OperationalError("disk I/O error")
        error.sqlite_errorcode = sqlite3.SQLITE_IOERR
        raise error

    monkeypatch.setattr("vehanchor.storage.journal.has_locks", lambda _: False)
    monkeypatch.setattr("vehanchor.storage.journal.sqlite3.connect", refuse_locks)


@pytest.mark.usefixtures("lockless")
def test_a_journal_on_a_mount_without_locks_keeps_results(tmp_path: Path) -> None:
    path = tmp_path / "j.journal"
    with closing(_journal(path, sole=True)) as journal:
        journal.add(("a",), 1)
        with pytest.raises(OutputError, match=r"another run is using .* delete"):
            _journal(path, sole=True)
    with closing(_journal(path, sole=True)) as journal:
        assert journal.get(("a",)) == 1
    assert [file.name for file in tmp_path.iterdir()] == ["j.journal"]


@pytest.mark.usefixtures("lockless")
def test_the_lock_of_a_process_that_has_ended_is_taken_over(tmp_path: Path) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    lock = tmp_path / "j.journal.lock"
    lock.write_text(f"{socket.gethostname()} {ended.pid}")
    with closing(_journal(tmp_path / "j.journal", sole=True)) as journal:
        journal.add(("a",), 1)
    assert not lock.exists()


def test_a_usual_folder_has_locks(tmp_path: Path) -> None:
    assert has_locks(tmp_path)
    assert list(tmp_path.iterdir()) == []
