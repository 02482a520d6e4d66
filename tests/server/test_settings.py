from __future__ import annotations

import os
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

import pytest

from vehanchor_server.settings import Settings, SettingsError

ISSUER = ("https://a.test", "x")


def test_the_defaults_read_nothing_and_listen_to_this_machine_only() -> None:
    settings = Settings()
    assert (settings.roots, settings.image_hosts, settings.host) == ((), (), "127.0.0.1")
    assert settings.deadline_s < 60
    assert settings.image_limits.max_unpacked_bytes == 1  # no caller fills the disk
    settings.check_exposure()


def test_there_are_at_most_eighteen_settings_each_with_its_help_its_panel_and_its_default() -> None:
    assert len(fields(Settings)) <= 18
    for each in fields(Settings):
        words = each.metadata["words"]
        assert words.help.endswith(".")
        assert words.panel
        assert each.default is not MISSING


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"deadline_s": 0}, "deadline_s is 0"),
        ({"max_megapixels": float("nan")}, "max_megapixels"),
        ({"threads": 0}, "threads"),
        ({"isolation": "none"}, "isolation is 'none': use confined, unconfined, in-process"),
        ({"roots": (Path("/nowhere"),)}, "existing directory"),
        ({"roots": (Path(__file__),)}, "not a directory"),
        ({"roots": (Path("/"),)}, "whole file system"),
        ({"segmenter": (Path("encoder.onnx"),)}, "its encoder and its decoder"),
        ({"image_hosts": ("https://a.test",)}, "plain host name"),
        ({"image_hosts": ("*.test",)}, "plain host name"),
        ({"image_hosts": ("a.test:https",)}, "plain host name"),
        ({"image_hosts": ("",)}, "plain host name"),
        ({"oidc": ("https://a.test",)}, "the issuer's https:// URL and the audience"),
        ({"oidc": ("http://a.test", "x")}, "the issuer's https:// URL"),
        ({"oidc": ISSUER, "token_file": Path("t")}, "exclude each other"),
        ({"oidc": ISSUER, "host": "0.0.0.0"}, r"^listening on 0\.0\.0\.0 with an issuer: give --public-url"),
        *(
            ({"public_urls": (url,)}, r"^public_url is .*: write all of it, as in https://example\.org/mcp")
            for url in ("example.org", "example.org/mcp", "ftp://example.org/mcp", "https://", "http://[::1/mcp")
        ),
    ],
)
def test_options_without_meaning_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        Settings(**options)


def test_the_memory_of_decoding_and_of_workers_follows_the_pixels() -> None:
    small, large = Settings(max_megapixels=25), Settings(max_megapixels=500)
    assert large.image_limits.max_decoded_bytes == 20 * small.image_limits.max_decoded_bytes == 5_500_000_000
    for settings in (small, large):
        assert settings.max_worker_bytes > 2 * settings.image_limits.max_decoded_bytes


def test_roots_are_resolved_once(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    settings = Settings(roots=(tmp_path / "link",))
    assert settings.roots == ((tmp_path / "real").resolve(),)
    assert settings.spelled_roots == (tmp_path / "link",)


@pytest.mark.promise("tokens")
@pytest.mark.parametrize(
    ("options", "allowed"),
    [
        ({"host": "127.0.0.1"}, True),
        ({"host": "localhost"}, True),
        ({"host": "::1"}, True),
        ({"host": "0.0.0.0"}, False),
        ({"host": "::"}, False),
        ({"host": "192.168.1.5"}, False),
        ({"host": "0.0.0.0", "insecure": True}, True),
        ({"host": "0.0.0.0", "token_file": Path("tokens")}, True),
        ({"host": "0.0.0.0", "oidc": ISSUER, "public_urls": ("https://b.test/mcp",)}, True),
    ],
)
def test_a_public_address_needs_authentication(options: dict[str, Any], allowed: bool) -> None:
    settings = Settings(**options)
    if allowed:
        settings.check_exposure()
    else:
        with pytest.raises(SettingsError, match="refusing to listen"):
            settings.check_exposure()


def test_variables_are_read_and_flags_come_first(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    environ = {
        "VEHANCHOR_ROOTS": f"{tmp_path}{os.pathsep}{tmp_path / 'b'}",
        "VEHANCHOR_IMAGE_HOSTS": "A.test, b.test:8443",
        "VEHANCHOR_THREADS": "3",
        "VEHANCHOR_DEADLINE_S": "7.5",
        "VEHANCHOR_INSECURE": "yes",
        "VEHANCHOR_DETECTOR": "",
        "VEHANCHOR_SEGMENTER": f"/models/e.onnx{os.pathsep}/models/d.onnx",
        "VEHANCHOR_OIDC": "https://a.test, x",
        "VEHANCHOR_PORT": "81",
        "OTHER": "x",
    }
    settings = Settings.from_environment(environ, port=9000, host=None)
    assert settings == Settings(
        roots=(tmp_path, tmp_path / "b"),
        image_hosts=("a.test", "b.test:8443"),
        threads=3,
        deadline_s=7.5,
        insecure=True,
        segmenter=(Path("/models/e.onnx"), Path("/models/d.onnx")),
        oidc=ISSUER,
        port=9000,
    )


@pytest.mark.parametrize(
    ("name", "text"),
    [("PORT", "http"), ("DEADLINE_S", "soon"), ("INSECURE", "maybe"), ("OIDC", "https://a.test"), ("ISOLATION", "x")],
)
def test_a_variable_that_cannot_be_read_is_named(name: str, text: str) -> None:
    with pytest.raises(SettingsError, match=f"VEHANCHOR_{name} is '{text}'"):
        Settings.from_environment({f"VEHANCHOR_{name}": text})
