from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from numpy.typing import NDArray
from rasterio.transform import Affine
from typer.testing import CliRunner, Result

from tests.models import blank_image, paint_vehicles, write_detector
from vehanchor.cli import app as cli
from vehanchor.detection.boxes import box_corners
from vehanchor.detection.detector import Detector
from vehanchor.errors import ImageTooLargeError, InvalidParameterError, OutputError
from vehanchor.estimate import analyse_scale
from vehanchor.options import Lengths, Reference, ScaleOptions, Search
from vehanchor_evaluation import search
from vehanchor_evaluation.dota import labelled_boxes, survey_dota
from vehanchor_evaluation.geotiff import survey_geotiffs
from vehanchor_evaluation.gsd import summarise_errors
from vehanchor_evaluation.known_scale import FileIssue
from vehanchor_evaluation.search import DetectionLog, open_detection_log, search_images
from vehanchor_evaluation.table import survey_table
from vehanchor_scenes import render_scene

REFERENCE_M = 5.045


def _dota_lines(boxes: NDArray[np.float64], name: str = "small-vehicle") -> str:
    return "".join(" ".join(f"{v:.1f}" for v in c.ravel()) + f" {name} 0\n" for c in box_corners(boxes))


def _cars(length_px: float, n: int = 12) -> NDArray[np.float64]:
    return np.array([[40 + 70 * (k % 6), 50 + 60 * (k // 6), length_px, 12, 0.0] for k in range(n)], dtype=np.float64)


def _paint(path: Path, boxes: NDArray[np.float64]) -> None:
    image = blank_image(480, 240)
    paint_vehicles(image, boxes)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image[:, :, ::-1])


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_detector(tmp_path_factory.mktemp("model") / "detector.onnx")


@pytest.fixture
def dota(tmp_path: Path) -> Path:
    """A split of DOTA v1.5 as it is downloaded, with all that can be wrong with a file.

    P0000: 20 px cars found, 22 px labelled, at 5.045 m / 20 px; P0001: the scale is 10 % less than found; P0002:
    nothing found; P0003: found 30 % too long, no labelled vehicle.
    """
    folder = tmp_path / "val"
    images, labels = folder / "images" / "part1" / "images", folder / "labelTxt-v1.5" / "DOTA-v1.5_val"
    old, upright = folder / "labelTxt-v1.0" / "labelTxt", folder / "labelTxt-v1.5" / "DOTA-v1.5_val_hbb"
    for path in (labels, old, upright):
        path.mkdir(parents=True)
    found, truth = REFERENCE_M / 20, REFERENCE_M / 20
    files: dict[str, tuple[NDArray[np.float64], str]] = {
        "P0000": (_cars(20), f"imagesource:GoogleEarth\ngsd:{truth}\n{_dota_lines(_cars(22))}"),
        "P0001": (_cars(20), f"imagesource:GoogleEarth\ngsd:{found / 0.9}\n{_dota_lines(_cars(20))}1 2 3 car\n"),
        "P0002": (_cars(20, 0), f"imagesource:GoogleEarth\ngsd:{truth}\n{_dota_lines(_cars(20))}"),
        "P0003": (_cars(26), f"imagesource:GF-2\ngsd:{truth}\n{_dota_lines(_cars(40), 'plane')}"),
        "P0004": (_cars(20), f"imagesource:GoogleEarth\ngsd:None\n{_dota_lines(_cars(20))}"),
        "P0005": (_cars(20), _dota_lines(_cars(20))),
    }
    for name, (boxes, text) in files.items():
        _paint(images / f"{name}.png", boxes)
        (labels / f"{name}.txt").write_text(text)
        (old / f"{name}.txt").write_text(text.replace("gsd:", "gsd:9"))
        (upright / f"{name}.txt").write_text(text.replace("gsd:", "gsd:8"))
    _paint(images / "P0006.png", _cars(20))  # without labels
    _paint(folder / "images" / "part2" / "P0000.png", _cars(20))  # the name is taken
    (images / "P0007.png").write_bytes(b"no image")
    (labels / "P0007.txt").write_text(f"gsd:{truth}\n")
    (labels / "P0008.txt").write_text(f"gsd:{truth}\n")  # without an image
    _paint(images / "P0009.png", _cars(20))
    (labels / "P0009.txt").write_bytes(b"gsd:0.2\n\xff\xfe\n")
    return folder


def _run(*arguments: object) -> Result:
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as handle:
        return list(csv.DictReader(handle))


# --- Data


def test_a_split_of_dota_is_read_as_downloaded(dota: Path) -> None:
    data = survey_dota(dota)
    assert [image.path.name for image in data.images] == [
        "P0000.png", "P0001.png", "P0002.png", "P0003.png", "P0007.png"
    ]  # fmt: skip
    assert data.images[0].gsd_m_per_px == REFERENCE_M / 20  # neither version 1.0's nor the upright boxes' header
    assert [image.labelled_vehicles for image in data.images] == [12, 12, 12, 0, 0]
    issues = {(issue.file.name, issue.reason, issue.skipped) for issue in data.issues}
    assert issues == {
        ("P0004.png", "no_gsd", True),
        ("P0005.png", "no_gsd", True),
        ("P0006.png", "no_label", True),
        ("P0000.png", "duplicate_name", True),
        ("P0001.txt", "malformed_labels", False),
        ("P0008.txt", "no_image", True),
        ("P0009.txt", "unreadable_labels", True),
    }
    malformed = next(issue for issue in data.issues if issue.reason == "malformed_labels")
    assert "line 15" in malformed.message
    assert "1 2 3 car" in malformed.message


def test_version_2_keeps_the_scale_in_its_meta_folder(dota: Path) -> None:
    (dota / "labelTxt-v2.0").mkdir()
    (dota / "meta").mkdir()
    (dota / "labelTxt-v2.0" / "P0000.txt").write_text(_dota_lines(_cars(22)))
    (dota / "meta" / "P0000.txt").write_text("acquisition dates:2014\nimagesource:GoogleEarth\ngsd:0.31\n")
    data = survey_dota(dota)
    assert [(image.path.name, image.gsd_m_per_px) for image in data.images] == [("P0000.png", 0.31)]
    assert len(survey_dota(dota, dota / "labelTxt-v1.5").images) == 5
    (dota / "meta" / "P0000.txt").write_text("imagesource:GoogleEarth\n")
    assert survey_dota(dota).images == ()


def test_labels_of_a_scene_come_back_as_drawn(tmp_path: Path) -> None:
    scene = render_scene(0.2, width_px=300, height_px=300, seed=3, layout="parking")
    for name in ("images", "labelTxt"):
        (tmp_path / name).mkdir()
    cv2.imwrite(str(tmp_path / "images" / "P1.png"), scene.image[:, :, ::-1])
    (tmp_path / "labelTxt" / "P1.txt").write_text(f"imagesource:scene\n{scene.dota_text()}")
    (image,) = survey_dota(tmp_path).images
    assert image.gsd_m_per_px == 0.2
    assert image.labels is not None
    drawn = [vehicle.length_px for vehicle in scene.vehicles if vehicle.kind == "small-vehicle"]
    assert labelled_boxes(image.labels)[:, 2] == pytest.approx(drawn, abs=0.01)


def test_a_folder_that_is_no_split_says_what_to_name(dota: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidParameterError, match="name one of its splits: val"):
        survey_dota(tmp_path)
    (tmp_path / "bare" / "images").mkdir(parents=True)
    with pytest.raises(InvalidParameterError, match="--labels"):
        survey_dota(tmp_path / "bare")
    with pytest.raises(InvalidParameterError, match="no label folder"):
        survey_dota(dota, tmp_path / "nowhere")


def test_a_table_reports_bad_lines_and_finds_labels_beside_its_images(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        _paint(tmp_path / "images" / f"{name}.png", _cars(20))
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "a.txt").write_text("")
    (tmp_path / "images" / "b.txt").write_text("")
    table = tmp_path / "table.csv"
    table.write_text(
        "file,gsd_m_per_px,set\nimages/a.png,0.2,x\nimages/b.png,wide,x\nimages/b.png,0.3,y\nimages/a.png,0.2,x\n"
        "images/none.png,0.2,x\n,0.2,x\nimages/c.png,0.2,y\n"
    )
    data = survey_table(table)
    assert [(image.path.stem, image.labels and image.labels.parent.name) for image in data.images] == [
        ("a", "labels"),
        ("b", "images"),
        ("c", None),
    ]
    assert sorted(issue.reason for issue in data.issues) == [
        "duplicate_name", "malformed_row", "malformed_row", "no_image"
    ]  # fmt: skip
    assert [image.path.stem for image in data.chosen(set_name="y").images] == ["b", "c"]
    assert [image.path.stem for image in data.chosen(limit=1).images] == ["a"]
    table.write_text("name,gsd\na,0.1\n")
    with pytest.raises(InvalidParameterError, match=r"no line of the table can be used.*line 2"):
        survey_table(table)
    with pytest.raises(InvalidParameterError, match="cannot read table"):
        survey_table(tmp_path / "none.csv")


def _write_geotiff(path: Path, crs: str, pixel: float, x: float, y: float) -> Path:
    with rasterio.open(
        path, "w", driver="GTiff", width=480, height=240, count=3, dtype="uint8", crs=crs,
        transform=Affine(pixel, 0, x, 0, -pixel, y),
    ) as file:  # fmt: skip
        image = blank_image(480, 240)
        paint_vehicles(image, _cars(20))
        file.write(np.moveaxis(image, 2, 0))
    return path


def test_the_true_scale_of_a_geotiff_is_corrected_for_its_latitude(tmp_path: Path) -> None:
    latitude_60_m = 8399737.89  # northing of 60 degrees in Web Mercator
    files = [
        _write_geotiff(tmp_path / "metres.tif", "EPSG:25832", 0.25, 500000, 5500000),
        _write_geotiff(tmp_path / "mercator.tif", "EPSG:3857", 0.5, 1000000, latitude_60_m),
        _write_geotiff(tmp_path / "degrees.tif", "EPSG:4326", 2e-6, 10, 0),
    ]
    _paint(tmp_path / "plain.png", _cars(20))
    (tmp_path / "broken.tif").write_bytes(b"II*\0")
    data = survey_geotiffs([*files, tmp_path / "plain.png", tmp_path / "broken.tif", files[0]])
    assert [image.gsd_m_per_px for image in data.images] == pytest.approx([0.25, 0.25, 0.2219], rel=1e-3)
    assert [(issue.file.name, issue.reason) for issue in data.issues] == [
        ("plain.png", "no_georeference"),
        ("broken.tif", "image_undecodable"),
    ]
    assert len(survey_geotiffs([tmp_path]).images) == 3
    with pytest.raises(InvalidParameterError, match="no file or folder"):
        survey_geotiffs([tmp_path / "none"])


# --- The search


def _log(path: Path, model: Detector) -> DetectionLog:
    return open_detection_log(path, model, ScaleOptions())


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the images that were really searched."""
    names: list[str] = []
    whole = search._search

    def counting(file: Path, **arguments: Any) -> Any:
        names.append(file.name)
        return whole(file, **arguments)

    monkeypatch.setattr(search, "_search", counting)
    return names


def test_an_interrupted_search_goes_on_where_it_stopped(tmp_path: Path, detector: Path, counted: list[str]) -> None:
    files = [tmp_path / f"{k}.png" for k in range(4)]
    for file in files:
        _paint(file, _cars(20))
    model = Detector(detector)

    def interrupt(done: int, _total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    log = tmp_path / "deep" / "log.jsonl"
    with pytest.raises(KeyboardInterrupt):
        list(search_images(files, model, ScaleOptions(), log=_log(log, model), progress=interrupt))
    kept = len(log.read_text().splitlines()) - 1  # after the settings
    assert 2 <= kept <= 3
    log.write_bytes(log.read_bytes()[:-40])  # and the machine went down while it was writing
    counted.clear()
    again = dict(search_images(files, model, ScaleOptions(), log=_log(log, model), workers=2))
    assert len(counted) == 4 - (kept - 1)
    counted.clear()
    cached = dict(search_images(files, model, ScaleOptions(), log=_log(log, model)))
    assert counted == []
    assert list(cached) == list(again) == files
    for file in files:
        found, fresh = cached[file], analyse_scale(file, detector=model)
        assert not isinstance(found, FileIssue)
        assert found.analysis(model.card, ScaleOptions()).estimate == fresh.estimate
        assert (found.detections.boxes == fresh.detections.boxes).all()


def test_a_search_is_repeated_for_other_settings_and_for_changed_files(
    tmp_path: Path, detector: Path, counted: list[str]
) -> None:
    file, log, model = tmp_path / "a.png", tmp_path / "log.jsonl", Detector(detector)
    _paint(file, _cars(20))
    plain, strict = ScaleOptions(), ScaleOptions(search=Search(min_score=0.95))
    other_half = ScaleOptions(lengths=Lengths("mean", None), reference=Reference(4.0))
    for options, n_searches in ((plain, 1), (plain, 1), (other_half, 1), (strict, 2), (plain, 2), (strict, 2)):
        found = search_images([file], model, options, log=open_detection_log(log, model, options))
        ((_, result),) = found
        assert not isinstance(result, FileIssue)
        assert len(result.detections.boxes) == (0 if options is strict else 12)
        assert len(counted) == n_searches
    assert len(open_detection_log(log, model, plain)) == 1
    assert len(open_detection_log(log, model, plain, ["car"])) == 0
    _paint(file, _cars(20, 3))
    (result,) = dict(search_images([file], model, plain, log=_log(log, model))).values()
    assert not isinstance(result, FileIssue)
    assert len(result.detections.boxes) == 3


def test_an_unreadable_image_is_an_issue_and_is_tried_again(tmp_path: Path, detector: Path) -> None:
    good, bad = tmp_path / "good.png", tmp_path / "bad.png"
    _paint(good, _cars(20))
    bad.write_bytes(b"no image")
    model, log = Detector(detector), tmp_path / "log.jsonl"
    found = dict(search_images([bad, good, tmp_path / "none.png"], model, ScaleOptions(), log=_log(log, model)))
    assert [item.reason if isinstance(item, FileIssue) else "" for item in found.values()] == [
        "image_undecodable", "", "image_not_found"
    ]  # fmt: skip
    _paint(bad, _cars(20))
    found = dict(search_images([bad, good], model, ScaleOptions(), log=_log(log, model)))
    assert not any(isinstance(item, FileIssue) for item in found.values())


def test_a_log_that_cannot_be_used_is_told(tmp_path: Path, detector: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "log.jsonl", tmp_path):
        with pytest.raises(OutputError, match="cannot keep results"):
            _log(path, Detector(detector))
    (tmp_path / "notes.txt").write_text("not a log")
    with pytest.raises(InvalidParameterError, match="no line of a journal"):
        _log(tmp_path / "notes.txt", Detector(detector))


# --- The commands


def test_errors_are_over_the_images_with_an_estimate_as_the_paper_counts(dota: Path, detector: Path) -> None:
    out = dota.parent / "out"
    result = _run("evaluate", "gsd", "--dota", dota, "--detector", detector, "--out", out)
    assert result.exit_code == 0, result.stderr
    report = json.loads((out / "gsd.json").read_text())
    rows = {row["name"]: row for row in report["rows"]}
    # found: 0 %, -10 %, nothing, -23.1 %; labelled: -9.1 %, -10 %, 0 %, none
    assert list(rows) == ["detector", "labels", "detector, intersection", "labels, intersection"]
    found, labelled = rows["detector"], rows["labels"]
    assert (found["images"], found["of_images"], found["coverage"]) == (3, 4, 0.75)
    assert (found["median"], found["mean"]) == pytest.approx((0.1, (0.1 + 1 - 20 / 26) / 3), abs=1e-3)
    assert found["within_20"] == pytest.approx(2 / 3)
    assert (labelled["images"], labelled["of_images"]) == (3, 4)
    assert labelled["median"] == pytest.approx(1 - 20 / 22, abs=1e-3)
    assert labelled["mean"] == pytest.approx((1 - 20 / 22 + 0.1) / 3, abs=1e-3)
    assert rows["detector, intersection"]["images"] == rows["labels, intersection"]["images"] == 2
    assert rows["detector, intersection"]["mean"] == pytest.approx(0.05, abs=1e-3)
    assert report["skipped"] == {
        "duplicate_name": 1, "image_undecodable": 1, "no_gsd": 2, "no_image": 1, "no_label": 1, "unreadable_labels": 1
    }  # fmt: skip
    assert report["noted"] == {"malformed_labels": 1}
    assert (report["no_vehicle_found"], report["no_vehicle_labelled"]) == (1, 1)
    assert report["reference_length_m"] == [REFERENCE_M]

    assert [row["name"] for row in _rows(out / "gsd.csv")] == list(rows)
    assert (out / "gsd.md").read_text() in result.stdout
    images = {Path(row["file"]).name: row for row in _rows(out / "images.csv")}
    assert float(images["P0001.png"]["signed_error"]) == pytest.approx(-0.1, abs=1e-3)
    assert images["P0002.png"]["gsd_m_per_px"] == ""
    assert images["P0003.png"]["labels_gsd_m_per_px"] == ""
    assert len(_rows(out / "issues.csv")) == sum(report["skipped"].values()) + 1
    assert "warning[no_label]" in result.stderr


def test_high_errors_are_counted_with_guard_and_confidence(tmp_path: Path, detector: Path) -> None:
    lines = ["file,gsd_m_per_px"]
    for name, length, truth in (("a", 30, 1.0), ("b", 30, 1.5), ("c", 12, 1.0), ("d", 12, 2.0)):
        _paint(tmp_path / f"{name}.png", _cars(length))
        lines.append(f"{name}.png,{truth * REFERENCE_M / length}")
    (tmp_path / "table.csv").write_text("\n".join(lines))
    result = _run(
        "evaluate", "gsd", "--table", tmp_path / "table.csv", "--detector", detector, "--out", tmp_path / "out"
    )
    assert result.exit_code == 0, result.stderr
    report = json.loads((tmp_path / "out" / "gsd.json").read_text())
    assert (report["high_errors"], report["high_errors_guarded"], report["high_errors_low_confidence"]) == (2, 1, 1)
    assert (report["low_errors"], report["low_errors_guarded"], report["low_errors_low_confidence"]) == (2, 1, 1)
    images = _rows(tmp_path / "out" / "images.csv")
    confidence = [float(row["confidence"]) for row in images]
    error = [abs(float(row["signed_error"])) for row in images]
    assert report["confidence_error_pearson"] == pytest.approx(np.corrcoef(confidence, error)[0, 1], abs=1e-3)
    assert report["rows"][0]["name"] == "detector"
    assert len(report["rows"]) == 1  # no labels, no baseline


def test_a_second_run_and_the_other_tables_search_nothing_again(dota: Path, detector: Path, counted: list[str]) -> None:
    common = ["--dota", dota, "--detector", detector, "--out", dota.parent / "out"]
    assert _run("evaluate", "gsd", *common, "--limit", 2).exit_code == 0
    assert sorted(counted) == ["P0000.png", "P0001.png"]
    assert _run("evaluate", "gsd", *common).exit_code == 0
    assert sorted(counted[2:]) == ["P0002.png", "P0003.png", "P0007.png"]
    del counted[:]
    first = (dota.parent / "out" / "gsd.json").read_bytes()
    assert _run("evaluate", "gsd", *common).exit_code == 0
    assert _run("evaluate", "ablation", *common).exit_code == 0
    assert counted == ["P0007.png"] * 2  # an image that cannot be read is tried again
    assert (dota.parent / "out" / "gsd.json").read_bytes() == first


def test_the_ablation_repeats_the_second_half_with_one_choice_changed(tmp_path: Path, detector: Path) -> None:
    boxes = _cars(20)
    boxes[:, 2] = [20, 20, 20, 20, 20, 21, 21, 22, 24, 26, 28, 60]
    _paint(tmp_path / "images" / "a.png", boxes)
    _paint(tmp_path / "images" / "b.png", _cars(20, 3))
    _paint(tmp_path / "images" / "c.png", _cars(20, 0))
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "a.txt").write_text(_dota_lines(boxes))
    truth = REFERENCE_M / 20
    (tmp_path / "t.csv").write_text(
        f"file,gsd_m_per_px\nimages/a.png,{truth}\nimages/b.png,{truth * 3}\nimages/c.png,{truth}\n"
    )
    result = _run("evaluate", "ablation", "--table", tmp_path / "t.csv", "--detector", detector, "--out", tmp_path)
    assert result.exit_code == 0, result.stderr
    rows = _rows(tmp_path / "ablation.csv")
    table = {(row["choice"], row["setting"], row["boxes"]): row for row in rows}

    def median(choice: str, setting: str, boxes: str = "labels") -> float:
        return float(table[choice, setting, boxes]["median"])

    def expected(**options: Any) -> float:
        chosen = ScaleOptions.of(options)
        found = analyse_scale(tmp_path / "images" / "a.png", chosen, detector=detector).estimate.gsd_m_per_px
        assert found is not None
        return abs(found / truth - 1)

    for aggregation in ("kde", "weighted_kde", "median", "mean"):
        assert median("aggregation", aggregation) == pytest.approx(expected(aggregation=aggregation), abs=1e-3)
    assert median("aggregation", "mean") > median("aggregation", "median") > 0
    for setting, alpha in (("1", 1.0), ("1.5", 1.5), ("none", None)):
        assert median("alpha", setting) == pytest.approx(expected(alpha=alpha), abs=1e-3)
    for setting, length in (("4.5 / 5.045", 4.5), ("1", REFERENCE_M), ("5.5 / 5.045", 5.5)):
        assert median("reference length", setting) == pytest.approx(expected(reference_length_m=length), abs=1e-3)
    assert table["reference length", "4.5 / 5.045", "labels"]["paper_median"] == "0.1059"
    assert table["vehicles", "N < 5", "detector"]["images"] == "1"
    assert median("vehicles", "N < 5", "detector") == pytest.approx(2 / 3, abs=1e-3)
    assert table["vehicles", "5 <= N < 20", "detector"]["images"] == "1"
    assert table["vehicles", "N >= 20", "detector"]["median"] == ""
    assert table["true scale", "< 0.3 m/px", "detector"]["images"] == "1"
    assert table["true scale", "> 0.7 m/px", "detector"]["images"] == "1"
    assert table["aggregation", "kde", "detector"]["of_images"] == "3"


def test_sets_have_rows_and_regions_of_their_own(tmp_path: Path, detector: Path) -> None:
    for name in ("a", "b"):
        _paint(tmp_path / f"{name}.png", _cars(20))
    truth = REFERENCE_M / 20
    (tmp_path / "t.csv").write_text(f"file,gsd_m_per_px,set\na.png,{truth},eu\nb.png,{truth},us\n")
    arguments = ["evaluate", "gsd", "--table", tmp_path / "t.csv", "--detector", detector, "--out", tmp_path]
    result = _run(*arguments, "--set-region", "eu=europe")
    assert result.exit_code == 0, result.stderr
    rows = {row["name"]: row for row in _rows(tmp_path / "gsd.csv")}
    assert float(rows["detector, eu"]["bias"]) == pytest.approx(4.5 / 5.045 - 1, abs=1e-3)
    assert float(rows["detector, us"]["bias"]) == pytest.approx(0, abs=1e-3)
    assert _run(*arguments, "--set", "us").exit_code == 0
    assert [row["of_images"] for row in _rows(tmp_path / "gsd.csv")] == ["1"]
    for extra, message in (
        (["--set-region", "eu"], "use SET=REGION"),
        (["--set-region", "eu=atlantis"], "this model knows europe, north_america"),
        (["--set", "asia"], "no image of set 'asia'"),
        (["--geotiff", tmp_path / "a.png"], "name the images by one of"),
    ):
        refused = _run(*arguments, *extra)
        assert refused.exit_code == 2
        assert message in refused.stderr


def test_labels_may_have_a_reference_length_of_their_own(dota: Path, detector: Path) -> None:
    out = dota.parent / "out"
    arguments = ["evaluate", "gsd", "--dota", dota, "--detector", detector, "--out", out]
    assert _run(*arguments, "--label-reference-length", 5.5495).exit_code == 0
    rows = {row["name"]: row for row in _rows(out / "gsd.csv")}
    assert float(rows["labels"]["median"]) == pytest.approx(0.01, abs=2e-3)  # 22 px at 10 % more: 0 %; -1 %; +10 %
    assert float(rows["detector"]["median"]) == pytest.approx(0.1, abs=1e-3)


def test_geotiffs_are_named_as_a_shell_spreads_them(tmp_path: Path, detector: Path) -> None:
    files = [_write_geotiff(tmp_path / f"{k}.tif", "EPSG:25832", REFERENCE_M / 20, 5e5, 5.5e6) for k in range(2)]
    result = _run(
        "evaluate", "gsd", "--geotiff", *files, "--detector", detector, "--out", tmp_path / "out", "--workers", 1
    )
    assert result.exit_code == 0, result.stderr
    (row,) = _rows(tmp_path / "out" / "gsd.csv")
    assert row["images"] == "2"
    assert float(row["median"]) == pytest.approx(0, abs=1e-3)


def test_data_without_a_known_scale_is_refused_with_its_reasons(tmp_path: Path, detector: Path) -> None:
    _paint(tmp_path / "plain.png", _cars(20))
    result = _run("evaluate", "gsd", "--geotiff", tmp_path, "--detector", detector, "--out", tmp_path / "out")
    assert result.exit_code == 2
    assert "warning[no_georeference]" in result.stderr
    assert "error[invalid_parameter]: no image of known scale" in result.stderr


def test_an_output_that_cannot_be_written_is_told(tmp_path: Path, detector: Path) -> None:
    (tmp_path / "file").write_text("")
    _paint(tmp_path / "a.png", _cars(20))
    (tmp_path / "t.csv").write_text("file,gsd_m_per_px\na.png,0.2\n")
    common = ["--table", tmp_path / "t.csv", "--detector", detector, "--out", tmp_path / "file"]
    for command in ("gsd", "figures"):
        result = _run("evaluate", command, *common, "--cache", tmp_path / "log.jsonl")
        assert result.exit_code == 2
        assert "error[output_unwritable]" in result.stderr


@pytest.mark.parametrize(
    ("errors", "expected"),
    [
        ([0.05, -0.15, float("nan")], (3, 2 / 3, 0.15, 0.4, 1 / 3, 2 / 3, -0.05)),
        ([float("nan")], (1, 0.0, 1.0, 1.0, 0.0, 0.0, float("nan"))),
    ],
)
def test_errors_are_summarised(errors: list[float], expected: tuple[float, ...]) -> None:
    assert summarise_errors(errors) == pytest.approx(expected, nan_ok=True)


@pytest.mark.data
@pytest.mark.slow
def test_the_shared_table_is_evaluated_with_its_labels(real_data: Path, tmp_path: Path) -> None:
    result = _run(
        "evaluate", "gsd", "--table", real_data / "gsd" / "table.csv", "--split", "val", "--set", "cannes",
        "--limit", 12, "--out", tmp_path,
    )  # fmt: skip
    assert result.exit_code == 0, result.stderr
    rows = {row["name"]: row for row in _rows(tmp_path / "gsd.csv")}
    assert rows["labels"]["of_images"] == "12"
    assert float(rows["labels"]["median"]) < 0.15
    assert re.search(r"KDE mode of these labels: [345]\.\d+ m", result.stdout)


def test_progress_ends_at_all_images(tmp_path: Path, detector: Path) -> None:
    _paint(tmp_path / "a.png", _cars(20))
    told: list[tuple[int, int]] = []
    tell: Callable[[int, int], None] = lambda done, total: told.append((done, total))  # noqa: E731
    dict(search_images([tmp_path / "a.png"], Detector(detector), ScaleOptions(), progress=tell))
    assert told == [(0, 1), (1, 1)]


@pytest.mark.slow
def test_an_image_larger_than_a_server_would_take_is_evaluated(tmp_path: Path, detector: Path) -> None:
    image = np.zeros((10_100, 10_000), np.uint8)
    cv2.imwrite(str(tmp_path / "huge.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    with pytest.raises(ImageTooLargeError):
        analyse_scale(tmp_path / "huge.png", detector=detector)
    (tmp_path / "t.csv").write_text("file,gsd_m_per_px\nhuge.png,0.2\n")
    result = _run("evaluate", "gsd", "--table", tmp_path / "t.csv", "--detector", detector, "--out", tmp_path / "out")
    assert result.exit_code == 0, result.stderr
    assert json.loads((tmp_path / "out" / "gsd.json").read_text())["skipped"] == {}
