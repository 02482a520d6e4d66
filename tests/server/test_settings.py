from __future__ import annotations

import os
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any

import pytest

from vehanchor.options import ImageLimits
from vehanchor_server.settings import Settings, SettingsError


def test_the_defaults_read_nothing_and_listen_to_this_machine_only() -> None:
    settings = Settings()
    assert settings.roots == ()
    assert settings.image_hosts == ()
    assert settings.loopback
    assert settings.deadline_s < 60
    settings.check_exposure()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"deadline_s": 0}, "deadline_s is 0"),
        ({"max_body_mb": -1}, "max_body_mb"),
        ({"max_megapixels": float("nan")}, "max_megapixels"),
        ({"threads": 0}, "threads"),
        ({"min_score": 1.5}, "min_score"),
        ({"roots": (Path("/nowhere"),)}, "existing directory"),
        ({"roots": (Path(__file__),)}, "not a directory"),
        ({"roots": (Path("/"),)}, "whole file system"),
        ({"segmenter": (Path("encoder.onnx"),)}, "its encoder and its decoder"),
        ({"image_hosts": ("https://a.test",)}, "plain host name"),
        ({"image_hosts": ("*.test",)}, "plain host name"),
        ({"image_hosts": ("a.test:https",)}, "plain host name"),
        ({"image_hosts": ("",)}, "plain host name"),
        ({"oidc_issuer": "https://a.test"}, "belong together"),
        ({"oidc_issuer": "http://a.test", "oidc_audience": "x"}, "https://"),
        ({"oidc_issuer": "https://a.test", "oidc_audience": "x", "token_file": Path("t")}, "exclude each other"),
    ],
)
def test_options_without_meaning_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        Settings(**options)


def test_the_memory_of_decoding_follows_the_pixels_until_it_is_named() -> None:
    assert Settings().image_limits == ImageLimits(max_unpacked_bytes=1)  # no caller fills the disk
    assert Settings(max_megapixels=500).image_limits.max_decoded_bytes == 5_000_000_000
    assert Settings(max_megapixels=500, max_decoded_mb=64).image_limits.max_decoded_bytes == 64 << 20


def test_roots_are_resolved_once(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert Settings(roots=(tmp_path / "link",)).roots == ((tmp_path / "real").resolve(),)


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
        (
            {
                "host": "0.0.0.0",
                "oidc_issuer": "https://a.test",
                "oidc_audience": "x",
                "public_url": "https://b.test/mcp",
            },
            True,
        ),
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
        "VEHANCHOR_TOKEN_FILE": "/run/tokens",
        "VEHANCHOR_DETECTOR": "",
        "VEHANCHOR_SEGMENTER": f"/models/e.onnx{os.pathsep}/models/d.onnx",
        "VEHANCHOR_CALIBRATION": "/models/europe.json",
        "VEHANCHOR_PORT": "81",
        "OTHER": "x",
    }
    settings = Settings.from_environment(environ, port=9000, host=None)
    assert settings.roots == (tmp_path, tmp_path / "b")
    assert settings.image_hosts == ("a.test", "b.test:8443")
    assert (settings.threads, settings.deadline_s, settings.insecure) == (3, 7.5, True)
    assert settings.token_file == Path("/run/tokens")
    assert settings.detector is None
    assert settings.segmenter == (Path("/models/e.onnx"), Path("/models/d.onnx"))
    assert settings.calibration == Path("/models/europe.json")
    assert settings.port == 9000
    assert settings.host == "127.0.0.1"


@pytest.mark.parametrize(("name", "text"), [("PORT", "http"), ("DEADLINE_S", "soon"), ("INSECURE", "maybe")])
def test_a_variable_that_cannot_be_read_is_named(name: str, text: str) -> None:
    with pytest.raises(SettingsError, match=f"VEHANCHOR_{name} is '{text}'"):
        Settings.from_environment({f"VEHANCHOR_{name}": text})


def test_settings_survive_the_way_to_a_worker_process(tmp_path: Path) -> None:
    settings = Settings(
        roots=(tmp_path,),
        image_hosts=("a.test", "b.test:8443"),
        detector="/models/a.onnx",
        precision="int8",
        segmenter=(Path("/models/e.onnx"), Path("/models/d.onnx")),
        calibration=Path("/models/europe.json"),
        threads=2,
        min_score=0.25,
        effort="fast",
        max_tiles=40,
        max_search_s=20.0,
        max_image_mb=1.5,
        max_concurrency=3,
        deadline_s=9.0,
        host="0.0.0.0",
        port=81,
        allowed_hosts=("x.test", "y.test:*"),
        allowed_origins=("https://x.test",),
        public_url="https://x.test/mcp",
        token_file=tmp_path / "tokens",
        workers=3,
        insecure=True,
        in_process=True,
        max_decoded_mb=70.0,
    )
    assert Settings.from_json(settings.to_json()) == settings
    assert Settings.from_json(Settings().to_json()) == Settings()


@pytest.mark.parametrize("name", ["a:b", "a,b", "a;b", " a", "a\udcff"])
def test_a_root_of_any_name_survives_the_way_to_a_worker_process(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    assert Settings.from_json(Settings(roots=(tmp_path / name,)).to_json()).roots == (tmp_path / name,)


@pytest.mark.parametrize(
    "address", ["example.org", "example.org/mcp", "ftp://example.org/mcp", "https://", "http://[::1/mcp"]
)
def test_an_address_for_callers_is_a_whole_one(address: str) -> None:
    with pytest.raises(SettingsError, match=r"^public_url is .*: write all of it, as in https://example\.org/mcp"):
        Settings(public_url=address)


def test_who_listens_everywhere_with_an_issuer_has_to_say_where(tmp_path: Path) -> None:
    issuer = {"oidc_issuer": "https://issuer.test", "oidc_audience": "vehanchor"}
    with pytest.raises(SettingsError, match=r"^listening on 0\.0\.0\.0 with an issuer: give --public-url"):
        Settings(host="0.0.0.0", **issuer)  # type: ignore[arg-type]
    assert Settings(host="0.0.0.0", public_url="https://x.test/mcp", **issuer).authenticated  # type: ignore[arg-type]
    assert Settings(host="127.0.0.1", **issuer).authenticated  # type: ignore[arg-type]


def test_a_variable_with_a_directory_whose_name_holds_the_separator_is_refused(tmp_path: Path) -> None:
    for name in ("other", "flight", "b", f"flight{os.pathsep}b"):
        (tmp_path / name).mkdir()
    text = os.pathsep.join([str(tmp_path / "other"), str(tmp_path / "flight"), "b"])
    with pytest.raises(SettingsError, match=r"^VEHANCHOR_ROOTS is .*exists, but .* separates paths.*option"):
        Settings.from_environment({"VEHANCHOR_ROOTS": text})


@pytest.mark.parametrize("field", fields(Settings), ids=lambda field: str(field.name))
def test_every_field_says_its_help_its_panel_and_its_default(field: Field[Any]) -> None:
    assert field.metadata["option"].help.endswith(".")
    assert field.metadata["panel"]
    assert field.default is not MISSING
