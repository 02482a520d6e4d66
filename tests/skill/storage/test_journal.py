from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from vehanchor.errors import InvalidParameterError, OutputError
from vehanchor.imagery.identity import Source
from vehanchor.storage.atomic import whole_file
from vehanchor.storage.journal import Journal


def _journal(path: Path | None, settings: dict[str, Any] | None = None, **choices: Any) -> Journal[Any]:
    return Journal(path, settings or {"model": "m"}, dump=lambda value: value, load=lambda value: value, **choices)


def test_results_come_back_in_the_order_asked_for(tmp_path: Path) -> None:
    journal = _journal(tmp_path / "deep" / "j.jsonl")
    for number in range(5):
        journal.add(("f", number), {"n": number})
    for again in (journal, _journal(journal.path)):
        assert len(again) == 5
        assert list(again.values([("f", 3), ("f", 0)])) == [{"n": 3}, {"n": 0}]
        assert (("f", 4) in again, ("f", 5) in again) == (True, False)
        assert again.get(("f", 5)) is None


def test_a_journal_can_be_removed(tmp_path: Path) -> None:
    journal = _journal(tmp_path / "j.jsonl")
    assert [file.name for file in tmp_path.iterdir()] == ["j.jsonl"]
    journal.remove()
    journal.remove()
    assert list(tmp_path.iterdir()) == []


def test_without_a_path_results_live_in_memory() -> None:
    journal = _journal(None)
    journal.add(("a",), 1)
    journal.add(("b",), None)
    assert list(journal.values([("b",), ("a",)])) == [None, 1]


@pytest.mark.parametrize("cut", [1, 7, 30, 10_000])
def test_a_last_line_that_was_cut_off_does_not_count(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "j.jsonl"
    journal = _journal(path)
    journal.add(("a",), 1)
    whole = path.read_bytes()
    journal.add(("b",), "x" * 50)
    path.write_bytes(path.read_bytes()[: max(len(whole), path.stat().st_size - cut)])
    again = _journal(path)
    assert (again.get(("a",)), again.get(("b",))) == (1, None)
    again.add(("b",), 3)
    assert _journal(path).get(("b",)) == 3
    assert all(json.loads(line) for line in path.read_text().splitlines())


def test_the_last_result_of_a_key_holds(tmp_path: Path) -> None:
    journal = _journal(tmp_path / "j.jsonl")
    journal.add(("a",), 1)
    journal.add(("a",), 2)
    assert journal.get(("a",)) == _journal(journal.path).get(("a",)) == 2


def test_several_settings_share_a_file_and_do_not_see_each_other(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    first, second = _journal(path, {"alpha": 1.5}), _journal(path, {"alpha": None})
    first.add(("a",), "first")
    second.add(("a",), "second")
    first.add(("b",), "first")
    assert list(_journal(path, {"alpha": 1.5}).values([("a",), ("b",)])) == ["first", "first"]
    assert [_journal(path, {"alpha": None}).get((name,)) for name in "ab"] == ["second", None]


def test_a_sole_journal_says_in_what_other_settings_differ(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    _journal(path, {"search": {"tile_px": 512, "min_score": None}}).add(("a",), 1)
    with pytest.raises(InvalidParameterError, match=r"with search.tile_px 512 \(now 640\): finish .* or burn it"):
        _journal(path, {"search": {"tile_px": 640, "min_score": None}}, sole=True, remedy="burn it")


@pytest.mark.parametrize(
    "content", [b"not json\n", b"no end", b"[]\n", b'{"a": 1}\n', b'{"settings": "x", "facts": {}}\n{"no file": 1}\n']
)
def test_a_file_that_is_no_journal_is_left_alone(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.journal"
    path.write_bytes(content)
    with pytest.raises(InvalidParameterError, match="is not a line of a journal, or is damaged: move the file away"):
        _journal(path)
    assert path.read_bytes() == content


def test_a_place_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "j.jsonl", tmp_path):
        with pytest.raises(OutputError, match="cannot keep results in"):
            _journal(path)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux's full disk")
def test_a_full_disk_is_told(tmp_path: Path) -> None:
    journal = _journal(tmp_path / "j.jsonl")
    journal.path = Path("/dev/full")
    with pytest.raises(OutputError, match="No space left"):
        journal.add(("a",), 1)
    assert ("a",) not in journal


def test_threads_may_add_at_once(tmp_path: Path) -> None:
    journal = _journal(tmp_path / "j.jsonl")

    def add_twenty(k: int) -> None:
        for n in range(20):
            journal.add((k, n), f"{k} {n}")

    threads = [Thread(target=add_twenty, args=(k,)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    keys = [(k, n) for k in range(8) for n in range(20)]
    assert list(_journal(journal.path).values(keys)) == [f"{k} {n}" for k, n in keys]


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
    with pytest.raises(OutputError, match="cannot write"), whole_file(tmp_path / "no" / "t.csv") as partial:
        partial.write_text("nowhere")


def test_a_journal_of_another_version_is_refused_with_a_sentence(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    path.write_text(json.dumps({"settings": "0123", "facts": {"journal_version": 1, "model": "m"}}) + "\n")
    with pytest.raises(InvalidParameterError, match=r"journal_version 1 \(now 3\).*move the file away"):
        _journal(path, sole=True)


def test_a_result_that_cannot_be_read_any_more_is_told_with_the_remedy(tmp_path: Path) -> None:
    def load(value: Any) -> Any:
        raise KeyError(value)

    path = tmp_path / "j.jsonl"
    _journal(path).add(("a",), 1)
    journal: Journal[Any] = Journal(path, {"model": "m"}, dump=int, load=load, remedy="start anew")
    with pytest.raises(InvalidParameterError, match=r"unreadable.*start anew"):
        journal.get(("a",))


def test_a_damaged_value_is_told_with_its_line(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    journal = _journal(path)
    journal.add(("a",), {"n": 1.25, "names": ["x"]})
    whole = path.read_bytes()
    nested = b"[" * 100_000 + b"]" * 100_000
    for value in (b"null", b"{}", b'{"n": 1.5, "names": ["x"]}', nested):
        path.write_bytes(whole.replace(b'{"n": 1.25, "names": ["x"]}', value))
        with pytest.raises(InvalidParameterError, match="line 2, is not a line of a journal, or is damaged: move"):
            _journal(path)
    path.write_bytes(whole)
    assert _journal(path).get(("a",)) == {"n": 1.25, "names": ["x"]}


def test_a_journal_belongs_to_one_run_at_a_time(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    with _journal(path, sole=True) as first:
        first.add(("a",), 1)
        for anew in (False, True):
            with pytest.raises(OutputError, match=r"another run is using .*: wait until it has ended"):
                _journal(path, sole=True, anew=anew)
        assert first.get(("a",)) == 1
    with _journal(path, sole=True) as second:
        assert second.get(("a",)) == 1
    with _journal(path, sole=True, anew=True) as third:
        assert len(third) == 0
        third.remove()
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_was_killed_holds_nothing(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    held = (
        "import os; from pathlib import Path; from vehanchor.storage.journal import Journal\n"
        f"journal = Journal(Path({str(path)!r}), {{}}, dump=str, load=str, sole=True); journal.add(('a',), 'x')\n"
        "os.kill(os.getpid(), 9)"
    )
    assert subprocess.run([sys.executable, "-c", held], check=False).returncode == -9
    with Journal(path, {}, dump=str, load=str, sole=True) as journal:
        assert journal.get(("a",)) == "x"


@pytest.mark.parametrize("sole", [True, False])
@pytest.mark.parametrize("exists", [True, False])
def test_a_link_is_not_followed(tmp_path: Path, sole: bool, exists: bool) -> None:
    victim, path = tmp_path / "victim", tmp_path / "j.jsonl"
    if exists:
        victim.write_bytes(b"")
    path.symlink_to(victim)
    with pytest.raises(OutputError, match=r"j\.jsonl' is a link: remove it"):
        _journal(path, sole=sole)
    assert victim.exists() == exists
