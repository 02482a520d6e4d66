"""Tables of known lengths as spreadsheets write them."""

from __future__ import annotations

from pathlib import Path

import pytest

from vehanchor.errors import KnownLengthError
from vehanchor.rulers.known_length_table import lines_in
from vehanchor_evaluation.table import survey_table

COMMAS = "file,x1,y1,x2,y2,metres,what\nphoto.jpg,0,0,100,0,36.5,\n"
SEMICOLONS = "file;x1;y1;x2;y2;metres\nphoto.jpg;0;0;100;0;36,5\n"


def _metres(content: bytes, tmp_path: Path) -> float | str | None:
    table = tmp_path / "lines.csv"
    table.write_bytes(content)
    image = tmp_path / "photo.jpg"
    ((line,),) = lines_in(table, [image]).values()
    return line.metres


@pytest.mark.parametrize(
    "content",
    [
        COMMAS.encode(),
        SEMICOLONS.encode(),
        COMMAS.replace(",", "\t").encode(),
        COMMAS.replace(",", "|").encode(),
        COMMAS.replace("36.5", '"36,5"').encode(),
        COMMAS.replace("photo.jpg", ".\\photo.jpg").encode(),
        SEMICOLONS.encode("utf-16-le"),
        SEMICOLONS.encode("utf-16-be"),
        SEMICOLONS.encode("utf-16"),
        SEMICOLONS.encode("utf-8-sig"),
        SEMICOLONS.encode("utf-32"),
        SEMICOLONS.encode("utf-32-le"),
        SEMICOLONS.encode("utf-32-be"),
        f"\n\n{SEMICOLONS}".encode(),
        COMMAS.replace("\n", "\r").encode(),
        COMMAS.replace("what", "\N{LATIN SMALL LETTER E WITH ACUTE}").encode("cp1252"),
        f"{COMMAS},,,,,,\n\n".encode(),
        f"{SEMICOLONS};;;;;\n".encode(),
        f"sep=;\n{SEMICOLONS}".encode(),
        SEMICOLONS.replace("x1;", " X1 ;").replace(";0;0", " ; 0;0").encode(),
    ],
)
def test_the_tables_of_spreadsheets_are_read(content: bytes, tmp_path: Path) -> None:
    assert _metres(content, tmp_path) == 36.5


def test_images_of_known_scale_have_the_same_tables(tmp_path: Path) -> None:
    (tmp_path / "photo.jpg").write_bytes(b"")
    table = tmp_path / "table.csv"
    table.write_text("file;gsd_m_per_px\nphoto.jpg;0,25\n;\n", encoding="utf-16")
    (image,) = survey_table(table).images
    assert image.gsd_m_per_px == 0.25


@pytest.mark.parametrize(
    ("start", "reason"),
    [
        (b"PK\3\4", "save it as CSV"),
        (b"\xd0\xcf\x11\xe0", "save it as CSV"),
        (b"\x1f\x8b", "unpack it"),
    ],
)
def test_files_that_are_no_text_say_what_to_do(start: bytes, reason: str, tmp_path: Path) -> None:
    with pytest.raises(KnownLengthError, match=reason):
        _metres(start + bytes(40), tmp_path)


def test_lines_before_the_table_count_in_messages(tmp_path: Path) -> None:
    table = f"\nsep=;\n{SEMICOLONS.replace('36,5', 'x')}"
    with pytest.raises(KnownLengthError, match="line 4"):
        _metres(table.encode(), tmp_path)


def test_a_missing_column_is_named(tmp_path: Path) -> None:
    with pytest.raises(KnownLengthError, match="no column metres"):
        _metres(SEMICOLONS.replace("metres", "length").encode(), tmp_path)


@pytest.mark.promise("sidecars")
def test_a_table_of_very_many_columns_is_refused(tmp_path: Path) -> None:
    with pytest.raises(KnownLengthError, match="it has 1007 columns"):
        _metres(("," * 1000 + COMMAS).encode(), tmp_path)


def test_many_lines_of_one_image_keep_their_order(tmp_path: Path) -> None:
    table = tmp_path / "lines.csv"
    rows = [f"photo.jpg,0,0,100,0,{number}," for number in range(1, 200)]
    table.write_text("\n".join([COMMAS.splitlines()[0], *rows]))
    (lines,) = lines_in(table, [tmp_path / "photo.jpg"]).values()
    assert [line.metres for line in lines] == list(range(1, 200))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (COMMAS.replace("36.5,", "36,5,"), "line 2 has more cells .* decimal comma"),
        (COMMAS.replace("what", "metres"), "the column metres has two places"),
    ],
)
def test_cells_without_a_column_are_refused(content: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(KnownLengthError, match=message):
        _metres(content.replace("5,\n", "5,1\n").encode(), tmp_path)


def test_a_comma_that_may_separate_thousands_is_refused(tmp_path: Path) -> None:
    with pytest.raises(KnownLengthError, match=r"metres is '1,000'"):
        _metres(COMMAS.replace("36.5", '"1,000"').encode(), tmp_path)


def test_a_name_with_a_nul_is_refused(tmp_path: Path) -> None:
    with pytest.raises(KnownLengthError, match="line 2: embedded null"):
        _metres(COMMAS.replace("photo.jpg", "pho\0to.jpg").encode(), tmp_path)
