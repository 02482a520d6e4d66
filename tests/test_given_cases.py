"""The files of ``../shared/cases``: what people reported about other tools, each with its right answer.

The folder is no part of the project: where it is missing, the tests are skipped. The tests of the modules that read
images have rendered files of the same kinds.
"""

from __future__ import annotations

import csv
import json
import os
import shlex
import shutil
import subprocess
import sys
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from vehanchor.cli.app import app

FOLDER = Path(os.environ.get("VEHANCHOR_CASES", Path(__file__).parents[2] / "shared" / "cases"))
TABLE = FOLDER / "cases.csv"
ROWS = list(csv.DictReader(TABLE.read_text(encoding="utf-8").splitlines())) if TABLE.is_file() else []
COMMANDS = [
    (row["file"].rpartition(".")[0], command.strip())
    for row in ROWS
    for command in row["how_to_run"].split(";")
    if command.strip().startswith("vehanchor estimate")
]

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not ROWS, reason=f"no files at {FOLDER}; set VEHANCHOR_CASES")]


def _run(command: str) -> dict[str, Any]:
    words = shlex.split(command)[1:]
    return _json([*words, *(["--json"] if "--json" not in words else [])])


def _json(words: list[str]) -> dict[str, Any]:
    result = CliRunner().invoke(app, words)
    read: dict[str, Any] = json.loads(result.stdout)
    return read


def _warned(record: dict[str, Any], *words: str) -> bool:
    said = " ".join(each["message"] for each in record["warnings"])
    return all(word in said for word in words)


Right = Callable[[dict[str, Any]], bool]


def _scale(gsd: float, rel: float = 0.02) -> Right:
    return lambda record: bool(record["gsd_m_per_px"] == pytest.approx(gsd, rel=rel))


def _ok(gsd: float) -> Right:
    return lambda record: record["status"] == "ok" and _scale(gsd, 0.1)(record)


def _tilted(degrees: float, gsd: float) -> Right:
    return lambda record: _scale(gsd)(record) and abs(record["tilt"]["tilt_deg"] - degrees) < 0.5


def _unusable(*words: str) -> Right:
    return lambda record: record["gsd_m_per_px"] is None and _warned(record, *words)


def _or_warned(right: Right, *words: str) -> Right:
    return lambda record: right(record) or _warned(record, *words)


def _as_masked(record: dict[str, Any]) -> bool:
    control = _run("vehanchor estimate a01_mask_left.tif --json")
    return bool(record["n_vehicles"] == control["n_vehicles"] > 0)


RIGHT: dict[str, Right] = {
    "h01_cars_stale_lens_no_height": lambda record: not (record["status"] == "ok" and record["gsd_m_per_px"] < 0.1),
    "h02_cars_takeoff_from_a_hill": lambda record: record["status"] != "ok" or _ok(0.12)(record),
    "h03_cars_right_height": _ok(0.12),
    "h04_cars_gimbal_zero_yaw": lambda record: (
        "--no-metadata" in record["error"]["message"] if "error" in record else _ok(0.12)(record) and _warned(record)
    ),
    "m00_control": lambda record: record["status"] == "low_confidence" and _scale(0.1096, 0.05)(record),
    "m07_height_feet": _scale(0.1096),
    "m07_decimal_comma": _scale(0.1107, 0.005),
    "m07_xmp_rational": _scale(0.0907),
    "m07_height_zero": _unusable("is 0 m"),
    "m07_height_negative": _unusable("-12.5 m"),
    "m07_height_nan": _unusable("'nan'"),
    "m09_focal_plane_0": _scale(0.119),
    "m10_focal_plane_after_resize": _or_warned(_scale(0.1431), "wide"),
    "m10_focal_plane_original_size": _scale(0.1431),
    "m12_skydio_struct_x2d": _scale(0.0491),
    "m12_skydio_flat_x2d": _scale(0.0491),
    "m11_focal_px_12_decimals": _scale(0.0685),
    "m11_focal_px_no_units": _scale(0.0685),
    "m11_focal_px_units_pixels": _scale(0.0685),
    "m11_focal_mm_units": _scale(0.0685),
    "m13_autel_make_camera_narrow": _tilted(60, 0.0816),
    "m13_autel_make_autel_narrow": _tilted(60, 0.0816),
    "m13_autel_make_camera_nadir": _scale(0.0721),
    "m14_png_xmp_only": _scale(0.2193, 0.03),
    "m15_roll_180_past_nadir": lambda record: abs(record["tilt"]["tilt_deg"] - 20) < 0.5,
    "m16_gimbal_zero": lambda record: (
        _scale(0.070)(record) and record["gsd_ci95_high_m_per_px"] > 1.3 * record["gsd_m_per_px"]
    ),
    "m18_digital_zoom": _unusable("enlarged 2 times"),
    "m18_zoom_only_35mm": lambda record: (
        record["gsd_ci95_low_m_per_px"] < 0.0548 and record["gsd_ci95_high_m_per_px"] > 0.1096
    ),
    "m19_pitch_14_decimals": _tilted(30, 0.1361),
    "m20_tiff_exif_pointer_type13": _scale(0.213),
    "m20_tiff_exif_pointer_long": _scale(0.213),
    "m21_drone": lambda record: "export" in record.get("error", {"message": ""})["message"],
    "m22_thermal_float": _scale(0.1319),
    "a00_base": _ok(0.12),
    "a01_alpha_left": _as_masked,
    "a01_mask_left": lambda record: record["n_vehicles"] > 0,
    "a02_float_9999_untagged": lambda record: _ok(0.12)(record) and _warned(record, "-9999"),
    "a02_uint16_65535_untagged": lambda record: _ok(0.12)(record) and _warned(record, "65535"),
    **dict.fromkeys(("a02_float_9999_tagged", "a02_uint16_65535_tagged", "a02_uint16_12bit"), _ok(0.12)),
    "a02_gray_float": _ok(0.12),
    **dict.fromkeys(("m08_focal_0_0", "m08_focal_0_1", "m08_focal_5_0_f35_0"), _scale(0.171)),
}
"""Right answers by the file's name; the metadata of all others give the scale of their control."""


@pytest.mark.parametrize(("name", "command"), COMMANDS)
def test_a_file_gets_its_right_answer(name: str, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(FOLDER)
    record = _run(command)
    assert RIGHT.get(name, _scale(0.1096))(record), json.dumps(record, indent=1)


def test_a_folder_has_no_thumbnails_and_no_hidden_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    subprocess.run([sys.executable, FOLDER / "f01_folder_with_thumbnails.py", "f01"], check=True)
    control = _json(["estimate", "f01/DJI_0001.JPG", "--json"])
    flight = _json(["flight", "photographs", "f01", "--same-scale", "--json"])
    assert len(flight["photographs"]) == 1
    assert flight["n_vehicles"] == control["n_vehicles"]
    assert CliRunner().invoke(app, ["batch", "f01", "-o", "f01.csv", "--overwrite"]).exit_code == 0
    with Path("f01.csv").open(encoding="utf-8") as table:
        assert [row["file"] for row in csv.DictReader(table)] == [str(Path("f01", "DJI_0001.JPG"))]


def test_a_server_opens_a_name_in_another_normal_form(tmp_path: Path) -> None:
    shutil.copy(FOLDER / "a00_base.png", tmp_path / unicodedata.normalize("NFD", "café.png"))
    words = [sys.executable, *map(str, (FOLDER / "mcp_call.py", tmp_path, FOLDER / "p04_nfc_name.json"))]
    done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=100)
    assert "isError True" not in done.stdout, done.stdout
