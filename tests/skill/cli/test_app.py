"""``vehanchor estimate``, ``vehanchor models``, and the command line itself."""

from __future__ import annotations

import contextlib
import json
import os
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from typer.testing import CliRunner, Result

from tests.models import car_park, write_detector, write_other_model
from tests.skill.imagery.files import bmp_header
from vehanchor import analyse_scale, engine, records
from vehanchor.cli import app as cli
from vehanchor.cli import estimated_file
from vehanchor.cli.cli_options import ParsedOptions
from vehanchor.errors import VehAnchorError
from vehanchor.models import zoo as model_zoo
from vehanchor.records.ruler_registry import RULERS
from vehanchor.rulers.active import ruler_class
from vehanchor.storage.journal import Source

LENGTH_PX = 30.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of 20 cars, of 3, of none; a text; a detector, and a model that is not one."""
    path = tmp_path_factory.mktemp("cli")
    rng = np.random.default_rng(0)
    for name, n_vehicles in (("cars", 20), ("few", 3), ("none", 0)):
        lengths = rng.normal(LENGTH_PX, 1.5, n_vehicles)
        lengths[4:5] = 70.0
        cv2.imwrite(str(path / f"{name}.png"), car_park(lengths, 900, 500)[:, :, ::-1])
    (path / "text.png").write_text("this is not an image")
    write_detector(path / "detector.onnx", metadata={"license": "CC0-1.0"})
    write_other_model(path / "classifier.onnx")
    return path


@pytest.fixture
def run(folder: Path, plain_terminal: None, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run ``vehanchor`` in the folder of images."""
    monkeypatch.chdir(folder)
    return lambda *arguments: CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def _estimate(run: Any, *arguments: object) -> Result:
    """Run ``vehanchor estimate``; if no ruler is named, by vehicles alone, which is quicker."""
    options = list(arguments)
    if not {"--rulers", "--known-length", "--options"} & set(arguments):
        options += ["--rulers", "vehicles"]
    result: Result = run("estimate", "--detector", "detector.onnx", *options)
    return result


def _lines(result: Result) -> list[dict[str, Any]]:
    return [json.loads(line) for line in result.stdout.splitlines()]


def _read(path: Path) -> NDArray[Any]:
    picture = cv2.imread(str(path))
    assert picture is not None
    return picture


# --- estimate


def _words(text: str) -> str:
    """Join the lines of a folded cell."""
    return " ".join(text.split())


def test_the_facts_have_the_chance_of_each_ruler(run: Any) -> None:
    wrong_line = ["--known-length", 10, 10, 410, 10, 400]
    result = _estimate(run, "cars.png", "--rulers", "vehicles,known_length", *wrong_line)
    chances = re.findall(r"m/px, right with a chance of (\S+)", result.stdout)
    assert len(chances) == 2
    assert float(chances[1]) < 0.5 < float(chances[0])


def test_the_facts_of_vehicles_alone_have_no_chances(run: Any) -> None:
    assert "a chance" not in _estimate(run, "cars.png", "--rulers", "vehicles").stdout


def test_the_facts_of_a_line_alone_have_its_scale(run: Any) -> None:
    line = ["--rulers", "known_length", "--known-length", 0, 0, 500, 0, 100]
    facts = _estimate(run, "none.png", *line).stdout
    assert "known length 0.2000 m/px, right with a chance of 0.8" in _words(facts)
    assert "not searched" in facts
    assert "900 x 500 px = 180.0 x 100.0 m" in facts


def test_the_facts_advise_to_use_vehicles_if_they_are_off(run: Any) -> None:
    facts = _estimate(run, "cars.png", "--rulers", "camera,known_length").stdout
    assert "also use the ruler vehicles" in _words(facts)
    assert "or include cars" not in facts


def test_one_image_has_facts(run: Any) -> None:
    result = _estimate(run, "cars.png")
    assert (result.exit_code, result.stderr) == (0, "")
    for fact in ("cars.png", "m/px  (95 %:", "19 kept of 20 found"):
        assert fact in result.stdout
    assert "if at least one ruler is right)" in _words(result.stdout)


def test_json_is_the_record_with_its_photograph(run: Any, folder: Path) -> None:
    result = _estimate(run, "cars.png", "--json")
    assert result.exit_code == 0
    assert result.stderr == ""
    (line,) = _lines(result)
    assert line.pop("photograph") == "cars.png"
    # The command and the library therefore have the same defaults.
    analysis = analyse_scale(
        folder / "cars.png", detector=folder / "detector.onnx", rulers=("vehicles",)
    )
    expected = analysis.estimate
    assert line == expected.model_dump(mode="json")
    assert records.GsdEstimate.model_validate_json(json.dumps(line)) == expected
    assert line["gsd_m_per_px"] == pytest.approx(5.045 / LENGTH_PX, rel=0.05)


def test_one_bad_image_does_not_stop_the_rest(run: Any) -> None:
    images = ("cars.png", "text.png", "missing.png", "few.png")
    result = _estimate(run, *images, "--json", "--rulers", "vehicles")
    assert result.exit_code == 2
    cars, text, missing, few = _lines(result)
    assert (cars["photograph"], cars["status"]) == ("cars.png", "ok")
    assert text["photograph"] == "text.png"
    assert text["error"]["code"] == "image_undecodable"
    assert missing["error"]["code"] == "image_not_found"
    assert (few["photograph"], few["status"]) == ("few.png", "low_confidence")
    assert [line.split(":")[0] for line in result.stderr.splitlines()] == [
        "error[image_undecodable]",
        "error[image_not_found]",
    ]


# The decoder of one image ends its process. The script is a file, because the process of several
# images reads it again.
POISONED_COMMAND = """
import os, signal
from vehanchor.cli.app import main
from vehanchor.imagery.sources import opening

decode = opening.decode

def crash(data, source, header):
    if "poison" in source:
        os.kill(os.getpid(), signal.SIGSEGV)
    return decode(data, source, header)

opening.decode = crash
if __name__ == "__main__":
    main()
"""


@pytest.fixture(scope="module")
def poisoned(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> subprocess.CompletedProcess[str]:
    """An estimate of three images, the second of which crashes its decoder."""
    path = tmp_path_factory.mktemp("poisoned")
    for name in ("few.png", "poison.png", "last.png"):
        (path / name).symlink_to(folder / "few.png")
    (path / "run.py").write_text(POISONED_COMMAND)
    command = [sys.executable, "run.py", "estimate", "few.png", "poison.png", "last.png", "--json"]
    command += ["--detector", str(folder / "detector.onnx"), "--rulers", "vehicles"]
    return subprocess.run(command, cwd=path, capture_output=True, text=True, check=False)


@pytest.mark.promise("crashes")
def test_an_image_that_crashes_its_decoder_has_an_error(
    poisoned: subprocess.CompletedProcess[str],
) -> None:
    lines = [json.loads(line) for line in poisoned.stdout.splitlines()]
    assert [line["photograph"] for line in lines] == ["few.png", "poison.png", "last.png"]
    assert lines[1]["error"]["code"] == "worker_died"


@pytest.mark.promise("crashes")
def test_the_images_after_a_crash_are_estimated(
    poisoned: subprocess.CompletedProcess[str],
) -> None:
    first, _, last = (json.loads(line) for line in poisoned.stdout.splitlines())
    assert first | {"photograph": ""} == last | {"photograph": ""}


def test_the_exit_status_tells_of_a_crash(poisoned: subprocess.CompletedProcess[str]) -> None:
    assert poisoned.returncode == 2
    assert poisoned.stderr.startswith(
        "error[worker_died]: poison.png: this image ended the process"
    )


def test_a_defect_that_one_of_several_images_triggers_is_its_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Defect:
        def analyse_scale(self, *_: object, **__: object) -> None:
            raise IndexError("list index out of range")

    monkeypatch.delenv("VEHANCHOR_TRACEBACK", raising=False)
    monkeypatch.setattr(ParsedOptions, "loaded_engine", lambda _: Defect())
    estimate = estimated_file._prepare_process(ParsedOptions({}))
    result = estimate(estimated_file.PhotographFile("a.png", {}, details=False), print)
    assert result.error is not None
    assert result.error.code == "internal_error"
    assert "IndexError: list index out of range" in str(result.error)


def test_several_images_have_one_table_of_names_in_their_folder(run: Any, folder: Path) -> None:
    images = [folder / name for name in ("cars.png", "text.png", "few.png")]
    result = _estimate(run, *images)
    assert result.exit_code == 2
    heading, *lines = result.stdout.splitlines()
    assert heading.startswith("2 photographs in ")
    rows = [line.split() for line in lines if ".png" in line]
    assert [row[0] for row in rows] == ["cars.png", "few.png"]
    assert rows[1][-2:] == ["low_confidence", "imprecise"]
    assert f"error[image_undecodable]: {folder / 'text.png'}: " in result.stderr


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["cars.png", "--alpha", "wide"], "invalid_parameter"),
        (["cars.png", "--known-length", "0", "0", "9000", "0", "500"], "invalid_known_length"),
        (["cars.png", "--frame", "450", "300"], "frame_mismatch"),
        (["cars.png", "--provider", "AbacusExecutionProvider"], "provider_unavailable"),
        (["cars.png", "--detector", "classifier.onnx"], "model_contract"),
        (["cars.png", "--geotiff", "copy.png"], "output_unwritable"),
        (["cars.png", "--overlay", "./cars.png"], "invalid_parameter"),
        (["cars.png", "--overlay", "same.png", "--scale-bar", "same.png"], "invalid_parameter"),
        (["cars.png", "few.png", "--overlay", "one.png"], "invalid_parameter"),
    ],
)
def test_bad_input_is_one_line_with_status_2(run: Any, arguments: list[str], code: str) -> None:
    result = _estimate(run, *arguments)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith(f"error[{code}]: ")
    assert result.stderr.count("\n") == 1


def test_the_options_reach_the_method(run: Any) -> None:
    options: list[object] = ["--tile", 320, "--stride", 200, "--class", "0", "--bands", 1, 2, 3]
    options += ["--alpha", "none", "--threads", 1, "--provider", "CPUExecutionProvider"]
    options += ["--region", "europe", "--frame", 450, 250]
    (record,) = _lines(_estimate(run, "cars.png", "--json", *options))
    assert (record["n_vehicles"], record["details"]["reference_length_m"]) == (20, 4.5)
    assert record["frame"]["gsd_m_per_px"] == pytest.approx(2 * record["gsd_m_per_px"])
    assert "450 x 250 px:" in _estimate(run, "cars.png", *options).stdout


@pytest.mark.parametrize("wrong", [("--alpha", "-1"), ("--options", "missing.toml")])
def test_a_wrong_option_gives_each_image_its_line_of_json(run: Any, wrong: tuple[str, str]) -> None:
    result = _estimate(run, "cars.png", "few.png", "--json", *wrong)
    assert result.exit_code == 2
    errors = [(line["photograph"], line["error"]["code"]) for line in _lines(result)]
    assert errors == [("cars.png", "invalid_parameter"), ("few.png", "invalid_parameter")]


@pytest.mark.parametrize(
    "arguments",
    [["--tile", "wide"], ["--aggregation", "mode"], ["--no-such-option"], ["--frame", "1"]],
)
def test_options_that_cannot_be_parsed_end_with_status_2(run: Any, arguments: list[str]) -> None:
    result = _estimate(run, "cars.png", *arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert arguments[0].removeprefix("--") in result.stderr
    assert "Traceback" not in result.stderr


@pytest.fixture(scope="module")
def capped(folder: Path) -> Path:
    """A detector that finds at most ten vehicles, of which a record warns."""
    return write_detector(folder / "capped.onnx", layout="end2end", cap=10)


def test_warnings_go_to_stderr(run: Any, capped: Path) -> None:
    result = _estimate(run, "cars.png", "--detector", capped)
    assert result.exit_code == 0
    assert result.stderr.startswith("warning[detections_capped]: ")


def test_warnings_stay_inside_the_json(run: Any, capped: Path) -> None:
    result = _estimate(run, "cars.png", "--json", "--detector", capped)
    assert result.stderr == ""
    assert _lines(result)[0]["warnings"][0]["code"] == "detections_capped"


def test_with_stem_in_the_name_every_image_gets_its_overlay(run: Any, tmp_path: Path) -> None:
    result = _estimate(run, "cars.png", "none.png", "--overlay", tmp_path / "{stem}_over.png")
    assert result.exit_code == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["cars_over.png", "none_over.png"]


def test_a_record_survives_an_overlay_that_cannot_be_written(
    run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full_disk(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    result = _estimate(run, "cars.png", "--json", "--rulers", "vehicles", "--overlay", "over.png")
    assert result.exit_code == 2
    assert _lines(result)[0]["status"] == "ok"
    error = "error[output_unwritable]: cannot write 'over.png': No space left on device\n"
    assert result.stderr == error


def test_a_missing_extra_ends_the_command_before_the_work(
    run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    result = _estimate(run, "cars.png", "--plot", "plot.png")
    assert result.exit_code == 2
    assert result.stdout == ""
    assert result.stderr.startswith("error[missing_extra]: ")
    assert "pip install '.[plots]'" in result.stderr


@pytest.fixture
def odd_name(folder: Path, tmp_path: Path) -> Path:
    """An image whose name has markup, and a byte that is not UTF-8."""
    path = tmp_path / os.fsdecode(b"[red]\xff.png")
    try:
        path.write_bytes((folder / "cars.png").read_bytes())
    except OSError:
        pytest.skip("the file system refuses such names")
    return path


def test_markup_in_a_name_is_printed_as_it_is(run: Any, odd_name: Path) -> None:
    facts = _estimate(run, odd_name).stdout
    assert "[red]\\" in facts.replace("\n", "").replace(" ", "")


def test_json_has_a_name_with_undecodable_bytes(run: Any, odd_name: Path) -> None:
    (line,) = _lines(_estimate(run, odd_name, "--json"))
    assert line["photograph"] == str(odd_name).replace("\udcff", "\\udcff")


@pytest.mark.parametrize("as_json", [[], ["--json"]])
@pytest.mark.parametrize(
    ("raised", "status", "error"),
    [
        (KeyboardInterrupt(), 130, ""),
        (MemoryError(), 2, "error[out_of_memory]: "),
        (ZeroDivisionError("oh"), 1, "error[internal_error]: ZeroDivisionError: oh."),
    ],
)
def test_an_early_end_has_a_status_with_at_most_one_line(
    run: Any,
    monkeypatch: pytest.MonkeyPatch,
    raised: BaseException,
    status: int,
    error: str,
    as_json: list[str],
) -> None:
    _fail_with(raised, monkeypatch)
    result = _estimate(run, "cars.png", *as_json)
    assert (result.exit_code, result.stdout) == (status, "")
    assert result.stderr.startswith(error)
    assert result.stderr.count("\n") == (1 if error else 0)


@pytest.mark.parametrize(
    ("raised", "expected"),
    [
        (KeyboardInterrupt(), SystemExit),
        (MemoryError(), SystemExit),
        (ZeroDivisionError("oh"), ZeroDivisionError),
    ],
)
def test_a_variable_shows_the_traceback_of_a_defect(
    run: Any,
    monkeypatch: pytest.MonkeyPatch,
    raised: BaseException,
    expected: type[BaseException],
) -> None:
    _fail_with(raised, monkeypatch)
    monkeypatch.setenv("VEHANCHOR_TRACEBACK", "1")
    assert isinstance(_estimate(run, "cars.png").exception, expected)


def _fail_with(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(engine.Engine, "analyse_scale", fail)


@pytest.mark.skipif(sys.platform == "win32", reason="pipes")
@pytest.mark.parametrize("arguments", [["models", "--sizes", "--json"], ["-h"]])
def test_a_closed_pipe_causes_no_traceback(folder: Path, arguments: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run(
            [sys.executable, "-m", "vehanchor", *arguments],
            cwd=folder,
            stdout=writing,
            stderr=subprocess.PIPE,
            check=False,
        )
    finally:
        os.close(writing)
    assert done.stderr == b""
    assert done.returncode == 1


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is full")
def test_a_full_disk_behind_stdout_is_named(folder: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "vehanchor", "--version"],
            cwd=folder,
            stdout=full,
            stderr=subprocess.PIPE,
            check=False,
        )
    assert done.returncode == 2
    assert done.stderr.startswith(b"error[output_unwritable]: cannot write to the standard output")


@pytest.mark.skipif(sys.platform == "win32", reason="shells")
def test_without_a_standard_output_a_command_ends_cleanly(folder: Path) -> None:
    command = f"{sys.executable} -m vehanchor --version >&-"
    done = subprocess.run(command, shell=True, cwd=folder, capture_output=True, check=False)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.skipif(sys.platform == "win32", reason="links")
def test_a_link_to_itself_is_not_found(tmp_path: Path) -> None:
    loop = tmp_path / "loop.png"
    loop.symlink_to(loop.name)
    assert Source.of(loop) == (str(loop), -1, 0)
    result = CliRunner().invoke(cli.app, ["estimate", str(loop)])
    assert result.exit_code == 2
    assert "error[image_not_found]" in result.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals")
def test_the_progress_bar_leaves_stdout_alone(folder: Path) -> None:
    import pty

    terminal, child = pty.openpty()
    command = ["estimate", "cars.png", "text.png", "--json"]
    command += ["--detector", "detector.onnx", "--rulers", "vehicles"]
    done = subprocess.run(
        [sys.executable, "-m", "vehanchor", *command],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=child,
        check=False,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "100"},
    )
    os.close(child)
    shown = b""
    # Linux raises this at the end of a terminal whose other side is closed.
    with contextlib.suppress(OSError):
        while part := os.read(terminal, 1 << 16):
            shown += part
    os.close(terminal)
    assert done.returncode == 2
    sources = [json.loads(line)["photograph"] for line in done.stdout.splitlines()]
    assert sources == ["cars.png", "text.png"]
    assert b"1/2 cars.png" in shown
    assert b"error[image_undecodable]" in shown


# --- models


@pytest.fixture
def bundled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of bundled models that has a segmenter, and another default detector."""
    metadata = {
        "vehanchor.reference_length_m": "4.65",
        "vehanchor.min_score": "0.3",
        "license": "Apache-2.0",
    }
    write_detector(tmp_path / f"{model_zoo.DEFAULT_DETECTOR}.onnx", metadata=metadata)
    for path in model_zoo.resolve_segmenter():
        (tmp_path / path.name).symlink_to(path)
    monkeypatch.setattr(model_zoo, "_BUNDLED", tmp_path)
    return tmp_path


@pytest.mark.usefixtures("bundled")
def test_models_list_shows_bundled_models(run: Any) -> None:
    result = run("models", "list")
    assert result.exit_code == 0
    for fact in (f"{model_zoo.DEFAULT_DETECTOR} (default)", "4.65 m", "Apache-2.0", "9 to 120 px"):
        assert fact in result.stdout
    assert "segmenter of measure" in result.stdout


@pytest.mark.usefixtures("bundled")
def test_models_list_has_an_object_for_each_bundled_model(run: Any) -> None:
    detector, segmenter = _lines(run("models", "list", "--json"))
    assert (detector["default"], detector["reference_length_m"]) == (True, 4.65)
    assert (segmenter["kind"], segmenter["contract"]) == ("segmenter", "sam")
    assert (len(detector["sha256"]), len(segmenter["sha256"])) == (64, 64)


def test_models_rulers_states_what_each_ruler_needs(run: Any) -> None:
    shown = _words(run("models", "--rulers").stdout)
    for kind in RULERS:
        assert f"{kind} {ruler_class(kind).help}" in shown


def test_models_rulers_has_an_object_for_each_ruler(run: Any) -> None:
    rows = _lines(run("models", "--rulers", "--json"))
    assert [row["kind"] for row in rows] == list(RULERS)
    assert {row["kind"] for row in rows if not row["sets_scale"]} == {"scene_scale"}
    assert all(row["needs"] for row in rows)


def test_models_info_shows_the_metadata_of_a_model(run: Any) -> None:
    result = run("models", "info", "detector.onnx")
    assert result.exit_code == 0
    for fact in ("small vehicle", "CC0-1.0", "europe 4.5 m, north_america 5.5 m", "5.045 m", "any"):
        assert fact in result.stdout


def test_models_info_shows_defaults_for_errors_without_a_file(run: Any) -> None:
    assert "defaults; one car's box 14.5 %" in run("models", "info", "detector.onnx").stdout


def test_models_info_shows_the_file_of_the_errors(run: Any) -> None:
    result = run("models", "info", model_zoo.DEFAULT_DETECTOR)
    assert "vehicles.errors.toml; one car's box 12 %" in result.stdout


def test_models_info_has_the_errors_as_json(run: Any) -> None:
    (card,) = _lines(run("models", "info", "detector.onnx", "--json"))
    assert card["errors_file"] is None
    assert card["errors"]["boxes"]["log_sd"] == 0.145


def test_models_info_has_the_metadata_as_json(run: Any) -> None:
    (card,) = _lines(run("models", "info", "detector.onnx", "--json"))
    assert card["class_names"] == {"0": "small vehicle"}
    assert card["fixed_size_px"] is None
    assert card["min_score"] == 0.1


# --- the command line itself


def test_the_module_prints_its_version(folder: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "vehanchor", "--version"],
        cwd=folder,
        stdout=subprocess.PIPE,
        check=True,
    )
    assert done.stdout.decode().strip() == f"vehanchor {version('vehanchor')}"


def test_opencv_adds_no_line_to_the_error_of_a_damaged_image(tmp_path: Path) -> None:
    (tmp_path / "half.bmp").write_bytes(bmp_header(60, 40))
    environment = {name: value for name, value in os.environ.items() if name != "OPENCV_LOG_LEVEL"}
    command = [sys.executable, "-m", "vehanchor", "estimate", "half.bmp"]
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("error[image_undecodable]: the BMP (half.bmp) cannot be decoded")


@pytest.mark.parametrize("asked", [["--help"], ["estimate", "--help"]], ids=" ".join)
def test_help_loads_nothing_heavy(folder: Path, asked: list[str]) -> None:
    code = f"""
import sys
from vehanchor.cli.app import main
sys.argv = ["vehanchor", *{asked}]
try:
    main()
finally:
    heavy = {{"cv2", "numpy", "onnxruntime", "scipy", "matplotlib", "rasterio"}}
    print(sorted(heavy & set(sys.modules)), file=sys.stderr)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, check=False
    )
    assert done.returncode == 0
    assert b"metres" in done.stdout
    assert done.stderr.decode().strip() == "[]"


def test_an_estimate_loads_neither_scipy_nor_random_numbers(folder: Path) -> None:
    code = """
import sys
from vehanchor.cli.app import main
sys.argv = ["vehanchor", "estimate", "cars.png"]
try:
    main()
finally:
    print(sorted({"scipy", "numpy.random"} & set(sys.modules)), file=sys.stderr)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, check=False
    )
    assert done.returncode == 0
    assert done.stderr.decode().strip() == "[]"


def test_every_error_of_the_library_has_a_code_of_its_own() -> None:
    kinds = [VehAnchorError]
    for kind in kinds:
        kinds.extend(kind.__subclasses__())
    assert len({kind.code for kind in kinds}) == len(set(kinds))


# --- options with several values


@pytest.fixture
def n_detections(run: Any) -> int:
    record = json.loads(_estimate(run, "--json", "cars.png").stdout)
    return int(record["details"]["n_detections"])


def test_vehicles_are_corrected_by_hand(run: Any, n_detections: int) -> None:
    corrections = ["--drop", n_detections, "--add", 0, 0, 20, 0, "--add", "0,60,20,60"]
    result = _estimate(run, "--json", "cars.png", *corrections)
    assert result.exit_code == 0, result.output
    record = json.loads(result.stdout)
    assert record["details"]["by_hand"] == {"dropped": 1, "added": 2}
    assert record["details"]["n_detections"] == n_detections + 1


def test_an_unknown_number_of_a_vehicle_is_refused(run: Any, n_detections: int) -> None:
    n = n_detections
    result = _estimate(run, "cars.png", "--drop", n + 1)
    error = (
        f"drop has number {n + 1}, which is not a vehicle of this image: its vehicles are 1 to {n}"
    )
    assert error in result.stderr


def test_corrections_by_hand_belong_to_one_image(run: Any) -> None:
    several = _estimate(run, "cars.png", "none.png", "--drop", 1)
    assert "drop belongs to one image" in several.stderr
    assert "The images here begin with 'cars.png', 'none.png'" in several.stderr
    assert "--drop" not in run("batch", "--help").stdout


LINE_ALONE = ("--rulers", "known_length", "--json")


def test_a_line_may_be_one_text(run: Any) -> None:
    result = _estimate(run, "--known-length", "0 0 300 0 90", *LINE_ALONE, "cars.png")
    assert json.loads(result.stdout)["rulers"][0]["n"] == 1


def test_a_line_may_be_several_values_with_a_word(run: Any) -> None:
    line = ("--known-length", 0, 0, 300, 0, "90+-9", "measured")
    result = _estimate(run, *line, *LINE_ALONE, "none.png")
    (ruler,) = json.loads(result.stdout)["rulers"]
    explanation = "The given line, measured, gives 0.3 m/px (0.271 to 0.332"
    assert ruler["explanation"].startswith(explanation)


def test_a_line_without_a_number_is_named_whole(run: Any) -> None:
    result = _estimate(run, "cars.png", "--known-length", 0, 0, 300, 90)
    assert "the known length is '0 0 300 90'" in result.stderr
