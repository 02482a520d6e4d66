"""Results are data: the page, the README and the documents take numbers from the data files."""

from __future__ import annotations

import argparse
import datetime
import json
import re
from importlib.util import find_spec
from pathlib import Path

import pytest

from research.results.page import TOPICS, main, missing_quotes, page, quotes, render
from research.results.record import FOLDER, Table, add_record_option, load, recording, tables_of
from tests.conftest import ROOT

ENTRIES = [(topic, key) for topic in TOPICS for key in load(topic)]
PRINTED = """Some words.

| images | n | median | said |
|---|---|---|---|
| all | 1,424 | 3.26% | 2 of 3 |
| few | 63 | -8.50 % | none |
| none | 0 | - | |
"""


def test_the_page_is_current() -> None:
    assert (FOLDER / "README.md").read_text(encoding="utf-8") == page()
    assert main(["--check"]) == 0


def test_a_visitor_reads_the_page_in_one_go() -> None:
    assert len(page().splitlines()) <= 140


def test_the_documents_quote_what_was_measured() -> None:
    assert not missing_quotes()


def test_every_percentage_of_the_readmes_accuracy_is_quoted_from_the_data() -> None:
    text = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    section = text.partition("## How accurate it is")[2].partition(" ## ")[0]
    assert len(re.findall(r"\d+\.\d+ ?%", section)) >= 8
    for quote in quotes()["README.md"]:
        assert quote in section
        section = section.replace(quote, "")
    assert not re.findall(r"\d+\.\d+ ?%", section)


def test_every_data_file_is_a_topic_of_the_page() -> None:
    assert {path.stem for path in FOLDER.glob("*.json")} == {*TOPICS, "quotes"}


@pytest.mark.parametrize(
    ("topic", "key"), ENTRIES, ids=[f"{topic}.{key}" for topic, key in ENTRIES]
)
def test_an_entry_states_date_machine_and_command(topic: str, key: str) -> None:
    entry = load(topic)[key]
    assert entry["title"]
    assert entry["machine"]
    datetime.date.fromisoformat(entry["date"])
    assert entry["rows"]
    assert {len(row) for row in entry["rows"]} == {len(entry["columns"])}
    assert len(set(entry["columns"])) == len(entry["columns"])
    assert set(entry["units"]) <= set(entry["columns"])
    for module in re.findall(r"-m (research[\w.]*)", entry["command"]):
        assert find_spec(module), module


def test_columns_of_numbers_become_numbers() -> None:
    (table,) = tables_of(PRINTED)
    assert table == Table(
        ["images", "n", "median", "said"],
        {"median": "%"},
        [["all", 1424, 3.26, "2 of 3"], ["few", 63, -8.5, "none"], ["none", 0, None, None]],
    )
    assert table.value("few", "median") == -8.5
    with pytest.raises(KeyError, match="0 rows"):
        table.value("some", "median")


def test_what_is_printed_is_what_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with recording("scale", ["val", "more"], "", folder=tmp_path, model={"vehicles": "d48a"}):
        print(PRINTED)
        print("| a | b |\n|---|---|\n| 1 | x |")
    assert PRINTED in capsys.readouterr().out
    written = load("scale", tmp_path)
    assert list(written) == ["val", "more"]
    assert Table(*(written["val"][name] for name in Table._fields)) == tables_of(PRINTED)[0]
    assert written["more"]["rows"] == [[1, "x"]]
    assert written["val"]["date"] == datetime.date.today().isoformat()
    assert written["val"]["model"] == {"vehicles": "d48a"}
    assert "onnxruntime" in written["val"]["machine"]


def test_a_new_run_keeps_only_title_and_aim(tmp_path: Path) -> None:
    last = {
        "val": {"title": "Scale", "aim": "4 %", "note": "old", "date": "2026-01-01"},
        "other": {"title": "x"},
    }
    (tmp_path / "scale.json").write_text(json.dumps(last), encoding="utf-8")
    with recording("scale", ["val"], "", folder=tmp_path):
        print(PRINTED)
    written = load("scale", tmp_path)
    assert written["other"] == last["other"]
    assert (written["val"]["title"], written["val"]["aim"]) == ("Scale", "4 %")
    assert "note" not in written["val"]


def test_only_the_option_writes_and_variants_have_own_keys(
    tmp_path: Path,
) -> None:
    parser = add_record_option(argparse.ArgumentParser())
    for printed in ([], ["--record", "int8"]):
        with recording("scale", ["val"], parser.parse_args(printed).record, folder=tmp_path):
            print(PRINTED)
        assert [path.name for path in tmp_path.iterdir()] == (["scale.json"] if printed else [])
    assert list(load("scale", tmp_path)) == ["val_int8"]


def test_a_placeholder_gives_a_cell_with_its_unit_or_a_table() -> None:
    entry = load("scale")["val"]
    (all_sets,) = (row for row in entry["rows"] if row[0] == "labelled, all sets")
    assert (
        render("{{scale.val | labelled, all sets | median}}")
        == f"{all_sets[entry['columns'].index('median')]:.2f} %"
    )
    table = render("{{table scale.val | images; n = photographs | rows labelled, c}}").splitlines()
    assert table[0] == "| images | photographs |"
    assert [line.split(" | ")[0] for line in table[2:]] == ["| labelled, cannes"]
