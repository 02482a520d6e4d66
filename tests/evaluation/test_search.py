from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.analyses import made_card
from tests.known_scale_data import REFERENCE_M, cars, dota_lines, n_results, paint, write_geotiff
from vehanchor import analyse_scale
from vehanchor.analysis.pipeline import analyse_view
from vehanchor.cli import app as cli
from vehanchor.detection.detections import Detections
from vehanchor.detection.detector import Detector
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.facts import ImageFacts
from vehanchor.options import Lengths, Reference, ScaleOptions, Search
from vehanchor.rulers.ruler import View
from vehanchor.scale.density import Votes
from vehanchor_evaluation.dota import survey_dota
from vehanchor_evaluation.geotiff import survey_geotiffs
from vehanchor_evaluation.gsd import ScaleTrial
from vehanchor_evaluation.known_scale import FileIssue, KnownScaleImage, KnownScaleSet
from vehanchor_evaluation.reliability import confidence_threshold, report_reliability, upper_bound
from vehanchor_evaluation.report import reliability_markdown
from vehanchor_evaluation.search import (
    DetectionLog,
    open_detection_log,
    search_images,
    search_known_scale,
)
from vehanchor_evaluation.survey import survey_known_scale
from vehanchor_evaluation.table import survey_table


def _log(path: Path, model: Detector) -> DetectionLog:
    return open_detection_log(path, model, ScaleOptions())


def test_an_interrupted_search_goes_on_where_it_stopped(
    tmp_path: Path, detector: Path, counted: list[str]
) -> None:
    files = [tmp_path / f"{k}.png" for k in range(4)]
    for file in files:
        paint(file, cars(20))
    model = Detector(detector)

    def interrupt(done: int, _total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    log = tmp_path / "deep" / "log.sqlite"
    with pytest.raises(KeyboardInterrupt):
        list(search_images(files, model, ScaleOptions(), log=_log(log, model), progress=interrupt))
    kept = n_results(log)
    assert 2 <= kept <= 3
    counted.clear()
    again = dict(search_images(files, model, ScaleOptions(), log=_log(log, model), workers=2))
    assert len(counted) == 4 - kept
    counted.clear()
    cached = dict(search_images(files, model, ScaleOptions(), log=_log(log, model)))
    assert counted == []
    assert list(cached) == list(again) == files
    for file in files:
        found = cached[file]
        fresh = analyse_scale(file, detector=model)
        assert not isinstance(found, FileIssue)
        assert found.analysis(model.card, ScaleOptions()).estimate == fresh.estimate
        assert (found.detections.boxes == fresh.detections.boxes).all()


def test_a_search_is_repeated_for_other_errors_of_the_detector(
    tmp_path: Path, detector: Path
) -> None:
    file = tmp_path / "a.png"
    log = tmp_path / "log.sqlite"
    paint(file, cars(20))
    model = Detector(detector)
    assert len(dict(search_images([file], model, ScaleOptions(), log=_log(log, model)))) == 1
    assert len(_log(log, model)) == 1
    errors = tmp_path / "errors.toml"
    errors.write_text("[boxes]\nlog_sd = 0.2\n")
    assert len(_log(log, Detector(detector, errors=errors))) == 0


def test_a_search_is_repeated_for_other_settings_and_for_changed_files(
    tmp_path: Path, detector: Path, counted: list[str]
) -> None:
    file = tmp_path / "a.png"
    log = tmp_path / "log.sqlite"
    model = Detector(detector)
    paint(file, cars(20))
    plain = ScaleOptions()
    strict = ScaleOptions(search=Search(min_score=0.95))
    other_half = ScaleOptions(lengths=Lengths("mean", None), reference=Reference(4.0))
    for options, n_searches in (
        (plain, 1),
        (plain, 1),
        (other_half, 1),
        (strict, 2),
        (plain, 2),
        (strict, 2),
    ):
        found = search_images([file], model, options, log=open_detection_log(log, model, options))
        ((_, result),) = found
        assert not isinstance(result, FileIssue)
        assert len(result.detections.boxes) == (0 if options is strict else 12)
        assert len(counted) == n_searches
    assert len(open_detection_log(log, model, plain)) == 1
    assert len(open_detection_log(log, model, options=plain, classes=["car"])) == 0
    paint(file, cars(20, 3))
    (result,) = dict(search_images([file], model, plain, log=_log(log, model))).values()
    assert not isinstance(result, FileIssue)
    assert len(result.detections.boxes) == 3


def test_an_unreadable_image_is_an_issue_and_is_tried_again(tmp_path: Path, detector: Path) -> None:
    good = tmp_path / "good.png"
    bad = tmp_path / "bad.png"
    paint(good, cars(20))
    bad.write_bytes(b"no image")
    model = Detector(detector)
    log = tmp_path / "log.sqlite"
    found = dict(
        search_images(
            [bad, good, tmp_path / "none.png"], model, ScaleOptions(), log=_log(log, model)
        )
    )
    assert [item.reason if isinstance(item, FileIssue) else "" for item in found.values()] == [
        "image_undecodable", "", "image_not_found"
    ]  # fmt: skip
    paint(bad, cars(20))
    found = dict(search_images([bad, good], model, ScaleOptions(), log=_log(log, model)))
    assert not any(isinstance(item, FileIssue) for item in found.values())


def test_an_alpha_that_no_search_has_looked_at_is_looked_at(
    tmp_path: Path, detector: Path, counted: list[str]
) -> None:
    file = tmp_path / "a.png"
    log = tmp_path / "log.sqlite"
    model = Detector(detector)
    paint(file, cars(20))
    plain = ScaleOptions()
    wide = ScaleOptions(lengths=Lengths(alpha=2.5))
    data = KnownScaleSet("", (KnownScaleImage(file, 0.2),))
    (found,) = search_known_scale(data, model, plain, cache=log).values()
    assert not isinstance(found, FileIssue)
    with pytest.raises(InvalidParameterError, match=r"searched without alpha 2\.5"):
        found.analysis(model.card, wide)
    for _ in range(2):
        (found,) = search_known_scale(data, model, wide, cache=log).values()
        assert not isinstance(found, FileIssue)
        assert found.analysis(model.card, wide).estimate.n_vehicles == 12
    assert len(counted) == 2


def test_a_split_of_dota_is_read_as_downloaded(dota: Path) -> None:
    data = survey_dota(dota)
    assert [image.path.name for image in data.images] == [
        "P0000.png", "P0001.png", "P0002.png", "P0003.png", "P0007.png"
    ]  # fmt: skip
    # neither version 1.0's nor the upright boxes' header
    assert data.images[0].gsd_m_per_px == REFERENCE_M / 20
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
    (dota / "labelTxt-v2.0" / "P0000.txt").write_text(dota_lines(cars(22)))
    (dota / "meta" / "P0000.txt").write_text(
        "acquisition dates:2014\nimagesource:GoogleEarth\ngsd:0.31\n"
    )
    data = survey_dota(dota)
    assert [(image.path.name, image.gsd_m_per_px) for image in data.images] == [("P0000.png", 0.31)]
    assert len(survey_dota(dota, dota / "labelTxt-v1.5").images) == 5
    (dota / "meta" / "P0000.txt").write_text("imagesource:GoogleEarth\n")
    assert survey_dota(dota).images == ()


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
        paint(tmp_path / "images" / f"{name}.png", cars(20))
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "a.txt").write_text("")
    (tmp_path / "images" / "b.txt").write_text("")
    table = tmp_path / "table.csv"
    table.write_text(
        "file,gsd_m_per_px,set\nimages/a.png,0.2,x\nimages/b.png,wide,x\nimages/b.png,0.3,y\nimages/a.png,0.2,x\n"
        "images/none.png,0.2,x\n,0.2,x\nimages/c.png,0.2,y\n"
    )
    data = survey_table(table)
    assert [
        (image.path.stem, image.labels and image.labels.parent.name) for image in data.images
    ] == [
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


def test_the_true_scale_of_a_geotiff_is_corrected_for_its_latitude(tmp_path: Path) -> None:
    latitude_60_m = 8399737.89  # northing of 60 degrees in Web Mercator
    files = [
        write_geotiff(tmp_path / "metres.tif", "EPSG:25832", pixel=0.25, x=500000, y=5500000),
        write_geotiff(
            tmp_path / "mercator.tif", "EPSG:3857", pixel=0.5, x=1000000, y=latitude_60_m
        ),
        write_geotiff(tmp_path / "degrees.tif", "EPSG:4326", pixel=2e-6, x=10, y=0),
    ]
    paint(tmp_path / "plain.png", cars(20))
    (tmp_path / "broken.tif").write_bytes(b"II*\0")
    data = survey_geotiffs([*files, tmp_path / "plain.png", tmp_path / "broken.tif", files[0]])
    # on the ellipsoid Web Mercator's metre is at 60 degrees half of sqrt(M N) / a = 1.00168 long
    assert [image.gsd_m_per_px for image in data.images] == pytest.approx(
        [0.25, 0.25042, 0.2219], rel=1e-4
    )
    assert [(issue.file.name, issue.reason) for issue in data.issues] == [
        ("plain.png", "no_georeference"),
        ("broken.tif", "image_undecodable"),
    ]
    assert len(survey_geotiffs([tmp_path]).images) == 3
    with pytest.raises(InvalidParameterError, match="no file or folder"):
        survey_geotiffs([tmp_path / "none"])


def test_a_source_is_named_one_way_and_its_images_may_be_chosen(dota: Path, tmp_path: Path) -> None:
    paint(tmp_path / "plain.png", cars(20))
    assert survey_known_scale(geotiff=[tmp_path / "plain.png"]).images == ()
    assert len(survey_known_scale(dota=dota, limit=2).images) == 2
    with pytest.raises(InvalidParameterError, match="give the images with one of"):
        survey_known_scale()
    with pytest.raises(InvalidParameterError, match="give the images with one of"):
        survey_known_scale(dota=dota, table=tmp_path / "t.csv")
    with pytest.raises(InvalidParameterError, match="no image of set 'asia'"):
        survey_known_scale(dota=dota, set_name="asia")


VOTES = Votes(share_at_zero=-13.76, share_slope=17.4)


def _trial(true_gsd: float, cars: int) -> ScaleTrial:
    """Cars of 50 px and 5 m: 0.1 m/px."""
    boxes = np.array([[99.0 + 90 * k, 90, 50.0, 20.0, 0] for k in range(cars)]).reshape(-1, 5)
    card = made_card(5.0).model_copy(update={"votes": VOTES})
    found = Detections(boxes, np.full(cars, 0.9))
    view = View(
        ImageFacts(4000, 3000),
        found,
        card=card,
        options=ScaleOptions(),
        measure_detail_share=lambda *_: 1.0,
    )
    return ScaleTrial(KnownScaleImage(Path(f"{cars}.png"), true_gsd), analyse_view(view))


@pytest.mark.parametrize(
    ("wrong", "of", "bound"), [(0, 300, 0.00994), (0, 59, 0.0495), (1, 100, 0.0466), (5, 5, 1.0)]
)
def test_the_upper_bound_is_the_exact_one(wrong: int, of: int, bound: float) -> None:
    assert upper_bound(wrong, of) == pytest.approx(bound, abs=1e-4)


def test_the_threshold_leaves_one_per_cent_wrong() -> None:
    confidences = np.linspace(0.3, 0.99, 400)
    wrong = confidences < 0.5
    found = confidence_threshold(confidences.tolist(), wrong.tolist())
    assert found.confidence is not None
    assert found.wrong / found.images <= 0.01 < (found.wrong + 1) / (found.images + 1)
    assert 0.49 < found.confidence < 0.5


@pytest.mark.parametrize("n", [0, 99])
def test_too_few_images_have_no_threshold(n: int) -> None:
    assert confidence_threshold([0.9] * n, [False] * n).confidence is None


def test_groups_and_chances_count_what_happened() -> None:
    trials = [_trial(0.1, 30)] * 120 + [_trial(0.2, 30), _trial(0.1, 2), _trial(0.1, 0)]
    report = report_reliability("here", "made", trials)
    by_cars = {row.name: row for row in report.by_vehicles}
    assert [row.images for row in report.by_vehicles] == [1, 1, 0, 121]
    assert (by_cars["20 and more"].usable, by_cars["20 and more"].wrong) == (121, 1)
    assert by_cars["20 and more"].median == pytest.approx(0, abs=0.005)
    assert by_cars["0"].estimates == 0
    assert sum(row.images for row in report.by_resolution) == len(trials) == report.whole.images
    assert {row.name: row.images for row in report.by_resolution}["0.2 to 0.3"] == 1
    surest = next(row for row in report.chances if row.images > 100)
    assert surest.happened == pytest.approx(120 / 121)
    assert report.threshold is not None
    assert (report.threshold_images, report.threshold_wrong) == (122, 1)


def test_the_text_fits_a_terminal_and_names_the_missing_images() -> None:
    text = reliability_markdown(report_reliability("here", "made", [_trial(0.1, 30)] * 12))
    assert max(map(len, text.splitlines())) <= 80
    assert "No limit of the confidence leaves 1 % wrong and 100 estimates of 12" in text


def test_the_command_writes_the_report(dota: Path, detector: Path) -> None:
    out = dota.parent / "out"
    arguments = ["evaluate", "reliability", "--dota", dota, "--detector", detector, "--out", out]
    result = CliRunner().invoke(cli.app, [str(each) for each in arguments])
    assert result.exit_code == 0, result.stderr
    report = json.loads((out / "reliability.json").read_text())
    assert (report["whole"]["images"], report["whole"]["estimates"]) == (4, 3)
    assert (out / "reliability.md").read_text() in result.stdout
    with (out / "reliability.csv").open(newline="") as handle:
        assert {row["by"] for row in csv.DictReader(handle)} == {"vehicles", "true m/px"}
