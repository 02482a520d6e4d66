"""Test the camera facts in the subtitles of DJI's films."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.metadata.lens import lens
from vehanchor_flight.subtitles import read_camera_facts, read_film_facts

if TYPE_CHECKING:
    from pathlib import Path


def _entry(number: int, second: int, text: str) -> str:
    return f"{number}\n00:00:{second:02},000 --> 00:00:{second:02},033\n{text}\n\n"


@pytest.mark.parametrize(
    ("text", "height_m", "focal_35mm"),
    [
        ("[focal_len: 24.00] [rel_alt: 1.300 abs_alt: 145.2]", 1.3, 24.0),
        ("[focal_len : 240] [dzoom_ratio: 10000, delta:0] [rel_alt: 45.0 abs_alt: 645.0]", 45, 24),
        ("[focal_len : 1620] [rel_alt: 45.000 abs_alt: 645.000]", 45.0, 162.0),
        ("[focal_len: 162.00] [rel_alt: 45.000 abs_alt: 645.000]", 45.0, 162.0),
        ("[focal_len : 24] [rel_alt: 39.94 abs_alt: 189.94] </font>", 39.94, 24.0),
        ("GPS(13.8,55.7,16) BAROMETER: 1.9", 1.9, None),
        ("HOME(149.0251,-20.2532) GPS(149.0,-20.2,16) BAROMETER:64.3", 64.3, None),
        (
            "F/2.8, SS 206.14, ISO 150, GPS (-122.1, 37.4, 19), D 24.3m, H 12.3m, H.S 2.75m/s",
            12.3,
            None,
        ),
    ],
)
def test_each_layout_gives_height_and_lens(
    text: str, height_m: float, focal_35mm: float | None
) -> None:
    camera = read_camera_facts(text)
    assert camera is not None
    assert (camera.height_m, camera.focal_35mm) == (height_m, focal_35mm)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[altitude: 260.226990]",
        "[abs_alt: 145.2]",
        "[rel_alt: nan abs_alt: 1]",
        "[rel_alt: 1.2.3 abs_alt: 1]",
        "[rel_alt: 40,800 abs_alt: 111,639]",
        "[rel_alt: 99999999999999999999 abs_alt: 1]",
        "H.S 2.75m/s, V.S 0.00m/s",
        "Hello, this is a film of 12 m",
    ],
)
def test_what_is_no_height_above_take_off_is_not_read(text: str) -> None:
    assert read_camera_facts(text) is None


@pytest.mark.parametrize(
    ("text", "off_nadir_deg"),
    [
        ("[gb_yaw: 12.3 gb_pitch: -90.0 gb_roll: 0.0]", 0.0),
        ("[gb_yaw: 12.3 gb_pitch: -45.0 gb_roll: 0.0]", 45.0),
        ("[gimbal_yaw: 12.3] [gimbal_pitch: -30.0] [gimbal_roll: 0.0]", 60.0),
    ],
)
def test_the_gimbal_gives_the_tilt(text: str, off_nadir_deg: float) -> None:
    camera = read_camera_facts(text)
    assert camera is not None
    assert camera.off_nadir_deg == pytest.approx(off_nadir_deg, abs=1e-6)


def test_angles_of_zero_are_unknown() -> None:
    assert read_camera_facts("[gb_yaw: 0.0 gb_pitch: 0.0 gb_roll: 0.0]") is None


@pytest.mark.parametrize(("ratio", "zoom"), [("10000", 1.0), ("20000", 2.0), ("1.50", 1.5)])
def test_the_digital_zoom_is_read(ratio: str, zoom: float) -> None:
    camera = read_camera_facts(f"[focal_len: 24.00] [dzoom_ratio: {ratio}, delta:0]")
    assert camera is not None
    assert camera.digital_zoom == zoom


def test_a_time_of_the_film_has_the_facts_of_its_entry(tmp_path: Path) -> None:
    texts = [f"[rel_alt: {height}.0 abs_alt: 9]" for height in (10, 20)]
    content = _entry(1, 0, texts[0]) + _entry(2, 1, texts[1])
    (tmp_path / "film.SRT").write_text(content)
    facts = read_film_facts(str(tmp_path / "film.MP4"))
    assert facts is not None
    heights = [camera and camera.height_m for camera in map(facts.at, (0.5, 1.5, 60.0))]
    assert heights == [10.0, 20.0, None]


def test_a_film_without_subtitles_has_no_facts(tmp_path: Path) -> None:
    assert read_film_facts(str(tmp_path / "film.mp4")) is None


def test_subtitles_of_a_dialogue_have_no_facts(tmp_path: Path) -> None:
    (tmp_path / "film.srt").write_text(_entry(1, 0, "Good morning!"))
    assert read_film_facts(str(tmp_path / "film.mp4")) is None


@pytest.mark.parametrize(
    "content",
    [b"\x00" * 5000, b"00:00:00,000 --> " * 4000, b"\xff\xfe[rel_alt", b"[rel_alt: 1] " * 9000],
)
def test_damaged_subtitles_have_no_facts(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "film.srt").write_bytes(content)
    assert read_film_facts(str(tmp_path / "film.mp4")) is None


@pytest.mark.timeout(120)
@pytest.mark.parametrize("word", ["H", "rel_alt", "focal_len :", "gb_pitch"])
def test_many_blanks_cost_no_time(tmp_path: Path, word: str) -> None:
    line = f"1\n00:00:00,000 --> 00:00:00,033\n {word}{' ' * 1900}x\n\n"
    (tmp_path / "film.srt").write_text(line * 5000)
    assert read_film_facts(str(tmp_path / "film.mp4")) is None


def test_nothing_is_read_after_the_last_second(tmp_path: Path) -> None:
    entries = [_entry(k + 1, k, f"[rel_alt: {k}.5 abs_alt: 9]") for k in range(9)]
    (tmp_path / "film.srt").write_text("".join(entries))
    facts = read_film_facts(str(tmp_path / "film.mp4"), last_s=3.0)
    assert facts is not None
    assert facts.times_s == (0.0, 1.0, 2.0, 3.0)


def test_a_folder_of_the_name_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "film.srt").mkdir()
    assert read_film_facts(str(tmp_path / "film.mp4")) is None


def test_no_more_than_the_limit_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = _entry(1, 0, "[rel_alt: 10.0 abs_alt: 9]")
    second = _entry(2, 1, "[rel_alt: 20.0 abs_alt: 9]")
    (tmp_path / "film.srt").write_text(first + second)
    monkeypatch.setattr("vehanchor_flight.subtitles._MAX_BYTES", len(first))
    facts = read_film_facts(str(tmp_path / "film.mp4"))
    assert facts is not None
    assert len(facts.times_s) == 1


def test_the_lens_of_a_film_alone_is_not_sure() -> None:
    image = ImageFacts(3840, 2160)
    of_photograph = lens(image, CameraMetadata(focal_35mm=24.0))
    of_film = lens(image, CameraMetadata(focal_35mm=24.0, is_film=True))
    assert of_photograph is not None
    assert of_film is not None
    assert of_film.chance_wrong > 0.1 > of_photograph.chance_wrong
