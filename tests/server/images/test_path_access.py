"""Nothing outside the roots is ever read, and refusals reveal nothing about it."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, BinaryIO
from unicodedata import normalize

import pytest

from vehanchor.imagery.sources.sidecars import Sidecars
from vehanchor_server.errors import CallError
from vehanchor_server.images import path_access as path_access_module
from vehanchor_server.images.path_access import PathAccess
from vehanchor_server.settings import Settings

SECRET = b"outside the root"


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    directory = tmp_path / "outside"
    directory.mkdir()
    (directory / "secret.png").write_bytes(SECRET)
    return directory


@pytest.fixture
def root(tmp_path: Path, outside: Path) -> Path:
    directory = tmp_path / "root"
    (directory / "deep").mkdir(parents=True)
    (directory / "a.png").write_bytes(b"inside")
    (directory / "deep" / "b c%41.png").write_bytes(b"deeper")
    return directory.resolve()


def content(opened: str | BinaryIO) -> bytes:
    return Path(opened).read_bytes() if isinstance(opened, str) else opened.read()


def str_of(opened: str | BinaryIO) -> str:
    assert isinstance(opened, str)
    return opened


def read(root: Path, named: str) -> bytes:
    with PathAccess([root]).open(named) as opened:
        return content(opened)


def refusal(root: Path, named: str) -> CallError:
    with pytest.raises(CallError) as caught, PathAccess([root]).open(named) as opened:
        pytest.fail(f"{named!r} was opened: {content(opened)!r}")
    return caught.value


def test_a_name_is_opened_in_either_unicode_form(root: Path) -> None:
    forms = [
        normalize(form, "\N{LATIN SMALL LETTER E WITH ACUTE}t\N{LATIN SMALL LETTER E WITH ACUTE}")
        for form in ("NFC", "NFD")
    ]
    for stored, other in (forms, forms[::-1]):
        (root / stored).mkdir()
        (root / stored / f"{stored}.png").write_bytes(b"summer")
        assert read(root, f"{other}/{other}.png") == b"summer"
        assert read(root / stored, str(root / other / f"{other}.png")) == b"summer"
        assert refusal(root, f"{other}/{other}x.png").code == "image_not_found"
        (root / stored / f"{stored}.png").unlink()
        (root / stored).rmdir()


def test_files_below_a_root_are_opened(root: Path) -> None:
    assert read(root, str(root / "a.png")) == b"inside"
    assert read(root, str(root / "deep" / "b c%41.png")) == b"deeper"
    assert read(root, (root / "deep" / "b c%41.png").as_uri()) == b"deeper"
    assert read(root, f"file://localhost{root}/a.png") == b"inside"
    assert read(root, f"FILE://{root}/a.png") == b"inside"
    assert read(root, f"{root}//./a.png") == b"inside"


@pytest.mark.promise("links")
def test_links_that_stay_below_the_root_are_followed(root: Path) -> None:
    (root / "link.png").symlink_to(root / "a.png")
    (root / "linked").symlink_to(root / "deep", target_is_directory=True)
    assert read(root, str(root / "link.png")) == b"inside"
    assert read(root, str(root / "linked" / "b c%41.png")) == b"deeper"


def test_every_root_counts(root: Path, outside: Path) -> None:
    with PathAccess([root, outside]).open(str(outside / "secret.png")) as opened:
        assert content(opened) == SECRET


def test_a_sibling_whose_name_begins_like_the_root_is_outside(root: Path) -> None:
    twin = Path(f"{root}-private")
    twin.mkdir()
    (twin / "secret.png").write_bytes(SECRET)
    assert refusal(root, str(twin / "secret.png")).code == "path_not_allowed"


@pytest.mark.promise("links")
def test_links_out_of_the_root_are_refused(root: Path, outside: Path) -> None:
    (root / "file.png").symlink_to(outside / "secret.png")
    (root / "relative.png").symlink_to("../outside/secret.png")
    (root / "directory").symlink_to(outside, target_is_directory=True)
    (root / "twice.png").symlink_to(root / "file.png")
    (root / "loop.png").symlink_to(root / "loop.png")
    for named in ("file.png", "relative.png", "directory/secret.png", "twice.png", "loop.png"):
        assert refusal(root, str(root / named)).code == "path_not_allowed"


@pytest.mark.promise("walk")
@pytest.mark.parametrize("replaced_by", ["link", "linked folder", "fifo"])
def test_a_name_replaced_after_its_check_is_refused_at_once(
    root: Path, outside: Path, monkeypatch: pytest.MonkeyPatch, replaced_by: str
) -> None:
    (root / "deep" / "secret.png").write_bytes(b"decoy")
    victim = root / "deep" if replaced_by == "linked folder" else root / "deep" / "secret.png"
    original = path_access_module._open_part

    def swapped(part: str, flags: int, directory: int) -> int:
        if part == victim.name:
            victim.rename(root / "moved")
            if replaced_by == "fifo":
                os.mkfifo(victim)
            else:
                victim.symlink_to(
                    outside if replaced_by == "linked folder" else outside / "secret.png"
                )
        return original(part, flags, directory)

    monkeypatch.setattr(path_access_module, "_open_part", swapped)
    refused = refusal(root, str(root / "deep" / "secret.png"))
    # Linux calls a linked folder no directory
    assert refused.code in ("path_not_allowed", "image_not_found")


def test_an_opened_file_stays_the_one_that_was_checked(root: Path, outside: Path) -> None:
    path = root / "a.png"
    with PathAccess([root]).open(str(path)) as opened:
        path.unlink()
        path.symlink_to(outside / "secret.png")
        assert content(opened) == b"inside"


def test_a_refused_path_comes_with_a_reason(
    root: Path,
) -> None:
    assert "The nearest names are deep/b c%41.png." in str(refusal(root, "B C_41.png"))
    assert "Check the path; view_image" in str(refusal(root, "quite-different.tiff"))
    assert "is a folder. Name a file in it" in str(refusal(root, "deep"))
    assert "this is a URL, not a path" in str(refusal(root, "https://images.example/a.png"))


def test_the_first_root_with_the_file_of_a_relative_path_wins(root: Path, outside: Path) -> None:
    (outside / "only_there.png").write_bytes(b"there")
    (root / "both.png").write_bytes(b"first")
    (outside / "both.png").write_bytes(b"second")
    access = PathAccess([root, outside])
    for named, content in (("only_there.png", b"there"), ("both.png", b"first")):
        with access.open(named) as opened:
            assert Path(str(opened)).read_bytes() == content
    (root / "only_there.png").symlink_to("/etc/hostname")
    with pytest.raises(CallError, match="path_not_allowed"), access.open("only_there.png"):
        pytest.fail("a link out of the root was followed")


def test_links_that_leave_the_root_reveal_nothing_outside(root: Path, tmp_path: Path) -> None:
    (tmp_path / "back").symlink_to(root, target_is_directory=True)
    targets = (
        f"/proc/{os.getpid()}/root{root}/a.png",
        f"/proc/999999999/root{root}/a.png",
        f"{tmp_path}/back/a.png",
        "../back/a.png",
        "../no/a.png",
        "deep/../../root/a.png",
    )
    for i, target in enumerate(targets):
        (root / f"link{i}.png").symlink_to(target)
    assert len({str(refusal(root, str(root / f"link{i}.png"))) for i in range(len(targets))}) == 1


def test_a_root_may_be_named_as_the_operator_wrote_it(root: Path, tmp_path: Path) -> None:
    spelled = tmp_path / "spelled"
    spelled.symlink_to(root, target_is_directory=True)
    settings = Settings(roots=(spelled,))
    assert settings.roots == (root,)
    for name in (spelled, root):
        with PathAccess(settings.roots, settings.spelled_roots).open(str(name / "a.png")) as opened:
            assert content(opened) == b"inside"


def test_links_may_climb_inside_a_root_or_lead_to_another(root: Path, outside: Path) -> None:
    (root / "deep" / "up.png").symlink_to("../a.png")
    (root / "deep" / "round.png").symlink_to("../deep/./../a.png")
    (root / "other.png").symlink_to(outside / "secret.png")
    assert read(root, str(root / "deep" / "up.png")) == b"inside"
    assert read(root, str(root / "deep" / "round.png")) == b"inside"
    with PathAccess([root, outside]).open(str(root / "other.png")) as opened:
        assert content(opened) == SECRET


def test_a_long_name_is_shortened_before_it_is_told(root: Path) -> None:
    error = refusal(root, f"{root}/{'a/' * 1000}a.png")
    assert error.code == "image_not_found"
    assert len(str(error)) < 200


def test_special_files_are_not_images(root: Path) -> None:
    os.mkfifo(root / "fifo.png")
    assert refusal(root, str(root)).code == "image_not_found"
    assert refusal(root, str(root / "deep")).code == "image_not_found"
    assert refusal(root, str(root / "fifo.png")).code == "image_not_found"
    with tempfile.TemporaryDirectory(dir="/tmp") as short, socket.socket(socket.AF_UNIX) as bound:
        bound.bind(f"{short}/s.png")
        assert refusal(Path(short).resolve(), f"{short}/s.png").code == "image_not_found"
    assert refusal(Path("/dev").resolve(), "/dev/zero").code == "image_not_found"


@pytest.mark.promise("roots")
def test_outside_the_roots_existing_files_are_refused_like_missing_ones(
    root: Path, outside: Path
) -> None:
    there = refusal(root, str(outside / "secret.png"))
    missing = refusal(root, str(outside / "missing.png"))
    assert str(there) == str(missing)
    (root / "to_there.png").symlink_to(outside / "secret.png")
    (root / "to_nowhere.png").symlink_to(outside / "missing.png")
    there = refusal(root, str(root / "to_there.png"))
    missing = refusal(root, str(root / "to_nowhere.png"))
    assert str(there) == str(missing)
    assert "to_there" not in str(there)
    assert str(outside) not in str(there)
    assert str(root) in str(there)


def test_no_descriptor_stays_open(root: Path, outside: Path) -> None:
    (root / "link.png").symlink_to(outside / "secret.png")
    before = len(list(Path("/proc/self/fd").iterdir()))
    for name in ("a.png", "link.png", "deep", "missing.png", "deep/b c%41.png"):
        try:
            with PathAccess([root]).open(str(root / name)):
                pass
        except CallError:
            pass
    assert len(list(Path("/proc/self/fd").iterdir())) == before


@pytest.fixture
def without_directory_descriptors(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make paths be opened as on Windows."""
    monkeypatch.setattr(os, "supports_dir_fd", set[object]())


@pytest.mark.usefixtures("without_directory_descriptors")
def test_a_file_is_opened_without_directory_descriptors(root: Path) -> None:
    assert read(root, str(root / "a.png")) == b"inside"


@pytest.mark.usefixtures("without_directory_descriptors")
def test_a_file_that_is_removed_while_it_is_opened_leaves_no_descriptor(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = root / "a.png"
    original = os.open

    def open_and_remove(name: Any, flags: int, **keywords: Any) -> int:
        descriptor = original(name, flags, **keywords)
        if name == path:
            path.unlink()
        return descriptor

    before = len(list(Path("/proc/self/fd").iterdir()))
    monkeypatch.setattr(os, "open", open_and_remove)
    refused = refusal(root, str(path))
    monkeypatch.undo()
    assert refused.code == "image_not_found"
    assert len(list(Path("/proc/self/fd").iterdir())) == before


@pytest.mark.parametrize(
    "named",
    [
        "local://a.png",
        "data:image/png;base64,AAAA",
        "blob:https://a/b",
        "sandbox:/mnt/data/a.png",
        "~/a.png",
        "$HOME/a.png",
        "%USERPROFILE%\\a.png",
        "C:\\a.png",
        "\\\\server\\share\\a.png",
        "s3://b/a.png",
    ],
)
def test_names_of_other_places_point_to_the_list_of_images(root: Path, named: str) -> None:
    error = refusal(root, named)
    assert error.code == "image_not_found"
    assert "view_image without image" in str(error)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the image is a file object")
def test_a_file_beside_an_image_is_read_under_the_same_checks(root: Path, outside: Path) -> None:
    (root / "a.png.msk").write_bytes(b"mask")
    (root / "deep" / "b.png").write_bytes(b"image")
    (root / "deep" / "b.png.msk").symlink_to(outside / "secret.png")
    with PathAccess([root]).open("a.png") as opened:
        assert Sidecars(str_of(opened)).mask(100) == b"mask"
    with PathAccess([root]).open("deep/b.png") as opened:
        assert Sidecars(str_of(opened)).mask(100) is None


_IN_ANOTHER_LOCALE = """
import os, sys
from pathlib import Path
from vehanchor_server.images.path_access import PathAccess
assert sys.getfilesystemencoding() != "utf-8"
access = PathAccess([Path(sys.argv[1])])
names, _ = access.listed(0, 9)
for name in names:
    with access.open(name) as opened:
        content = Path(opened).read_bytes() if isinstance(opened, str) else opened.read()
        print(ascii(name), len(content))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="names are Unicode there")
def test_names_are_unicode_in_every_locale(tmp_path: Path) -> None:
    name = "\N{LATIN SMALL LETTER E WITH ACUTE}\N{CJK UNIFIED IDEOGRAPH-65E5}.png"
    (tmp_path / name).write_bytes(b"four")
    locale = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    finished = subprocess.run(
        [sys.executable, "-c", _IN_ANOTHER_LOCALE, tmp_path],
        env={**os.environ, **locale},
        capture_output=True,
        text=True,
        check=True,
    )
    assert finished.stdout == f"{str(tmp_path / name)!a} 4\n"
