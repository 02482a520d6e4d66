"""Five hundred ways out of the roots and to other hosts: none leads anywhere, and none tells what is there."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from pathlib import Path
from urllib.parse import quote

import pytest

from vehanchor_server.errors import CallError
from vehanchor_server.images.fetch import Fetcher
from vehanchor_server.images.path_access import PathAccess

UP = "../" * 12
FORMS: tuple[Callable[[str, str], str], ...] = (
    *(lambda root, path, form=form: form.format(root=root, path=path, up=UP) for form in (
        "{path}", "/{path}", "//{path}", "/.{path}", "{path}/", "{path}/.", "{path}\0.png", "{path}%00.png", "~{path}",
        "file://{path}", "FILE://{path}", "file://localhost{path}", "file:///{path}", "file:{path}", "file://.{path}",
        "file://[{path}", "file://user@localhost{path}", "file://{path}?a=1", "file://{path}#a", "http://localhost{path}",
        "{root}/..{path}", "{root}/{up}{path}", "{root}//{up}{path}", "{root}/./{up}{path}", "{root}/deep/{up}{path}",
        "{root}/a.png/{up}{path}", "{root}/missing/{up}{path}", "file://{root}/{up}{path}", "{root}\0{path}",
        "{root}{path}", "{root}/{path}", "file://{root}{path}", "{root}/out{path}", "{root}/up{path}",
        "{root}/up/up{path}",
        "/proc/self/root{path}", "/proc/1/root{path}", "/proc/thread-self/root{path}", "/proc/self/cwd/{up}{path}",
        "/dev/fd/../../..{path}", "{root}/proc{path}", "\\\\?\\{path}", "{root}\\..{path}",
    )),
    lambda root, path: quote(path),
    lambda root, path: f"file://{quote(path, safe='')}",
    lambda root, path: f"{root}/{quote(UP + path, safe='')}",
    lambda root, path: f"file://{root}/{quote(UP + path, safe='')}",
    lambda root, path: f"file://{root}/{quote(quote(UP + path, safe=''), safe='')}",
    lambda root, path: f"file://{root}/{UP.replace('.', '%2e')}{path}",
    lambda root, path: f"{root}/{UP.replace('.', chr(0x2024))}{path}",
)  # fmt: skip


@pytest.mark.parametrize("n_ways", [350])
def test_no_way_out_of_a_root_is_open_and_none_tells_what_exists(tmp_path: Path, n_ways: int) -> None:
    root = (tmp_path / "root").resolve()
    (root / "deep").mkdir(parents=True)
    (root / "a.png").write_bytes(b"inside")
    (root / "out").symlink_to("/")
    (root / "up").symlink_to("..")
    (root / "proc").symlink_to("/proc/self/root")
    (tmp_path / "secret.png").write_bytes(b"outside")
    pairs = [(str(tmp_path / "secret.png"), str(tmp_path / "absent.png")), ("/etc/passwd", "/etc/passwx")]
    pairs += [("/proc/1/status", "/proc/999999999/status"), (str(tmp_path), f"{tmp_path}x")]
    ways = list(product(FORMS, pairs))
    for form, (present, absent) in ways:
        answers = []
        for path in (present, absent):
            named = form(str(root), path)
            with pytest.raises(CallError) as caught, PathAccess([root]).open(named) as opened:
                pytest.fail(f"{named!r} was opened: {opened!r}")
            told = (
                str(caught.value)
                .replace(f"server: {root}.", "server.")
                .replace(repr(named)[1:-1], "NAMED")
                .replace(named[-80:], "NAMED")
            )
            answers.append(caught.value.code if caught.value.code == "image_not_found" else told.replace(path, "PATH"))
            assert caught.value.code in ("path_not_allowed", "image_not_found"), named
        assert answers[0] == answers[1], (form("ROOT", present), answers)
    assert 2 * len(ways) >= n_ways


@pytest.mark.anyio
async def test_no_other_host_is_looked_up_and_none_asked() -> None:
    async def resolve(host: str, port: int) -> list[str]:
        assert (host, port) == ("images.test", 443)
        return ["10.0.0.1"]

    fetcher = Fetcher(("images.test",), 1000, 5.0, resolve=resolve)
    hosts = (
        "127.0.0.1", "localhost", "[::1]", "2130706433", "0x7f.1", "0177.0.0.1", "169.254.169.254",
        "[::ffff:127.0.0.1]",
        "images.test.", "images.test.evil.test", "evil.test", "images.test@evil.test", "images.test:80",
        "images.test:0",
        "images.test:99999", "evil.test#images.test", "evil.test\\@images.test", "imag\u0435s.test", "user@images.test",
        "user:pw@images.test", "[images.test]", "images.test%00.evil.test", "images.test%2eevil.test", "",
    )  # fmt: skip
    urls = [
        f"{scheme}{host}/a.png" for scheme, host in product(("https://", "http://", "HTTPS:", "ftp://", "//"), hosts)
    ]
    urls += [
        f"{scheme}images.test/a.png" for scheme in ("http://", "ftp://", "file://", "gopher://", "data:", "//", "")
    ]
    for url in [*urls, *(url.replace("/a.png", "") for url in urls)]:
        with pytest.raises(CallError) as caught:
            await fetcher.fetch(url)
        assert caught.value.code == "url_not_allowed", url
    assert 2 * len(urls) >= 200
