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
from vehanchor_evaluation.reliability import (
    ReliabilityReport,
    confidence_threshold,
    report_reliability,
    upper_bound,
)
from vehanchor_evaluation.report import reliability_markdown
from vehanchor_evaluation.search import (
    DetectionLog,
    SearchedImage,
    open_detection_log,
    search_images,
    search_known_scale,
)
from vehanchor_evaluation.survey import survey_known_scale
from vehanchor_evaluation.table import survey_table


def _log(path: Path, model: Detector) -> DetectionLog:
    return open_detection_log(path, model, ScaleOptions())


def test_an_interrupted_search_resumes(tmp_path: Path, detector: Path, counted: list[str]) -> None:
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
    n_stored = n_results(log)
    assert 2 <= n_stored <= 3
    counted.clear()
    resumed = dict(search_images(files, model, ScaleOptions(), log=_log(log, model), workers=2))
    assert len(counted) == 4 - n_stored
    counted.clear()
    cached = dict(search_images(files, model, ScaleOptions(), log=_log(log, model)))
    assert counted == []
    assert list(cached) == list(resumed) == files
    for file in files:
        searched = cached[file]
        fresh = analyse_scale(file, detector=model)
        assert not isinstance(searched, FileIssue)
        assert searched.analysis(model.card, ScaleOptions()).estimate == fresh.estimate
        assert (searched.detections.boxes == fresh.detections.boxes).all()


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


def _search_one(file: Path, model: Detector, options: ScaleOptions, log: Path) -> SearchedImage:
    """Search one image with the log of these options."""
    detection_log = open_detection_log(log, model, options)
    ((_, result),) = search_images([file], model, options, log=detection_log)
    assert not isinstance(result, FileIssue)
    return result


def test_a_search_is_repeated_for_other_settings_only(
    tmp_path: Path, detector: Path, counted: list[str]
) -> None:
    file = tmp_path / "a.png"
    log = tmp_path / "log.sqlite"
    model = Detector(detector)
    paint(file, cars(20))
    plain = ScaleOptions()
    strict = ScaleOptions(search=Search(min_score=0.95))
    other_estimate = ScaleOptions(lengths=Lengths("mean", None), reference=Reference(4.0))
    for options, n_searches in (
        (plain, 1),
        (plain, 1),
        (other_estimate, 1),
        (strict, 2),
        (plain, 2),
        (strict, 2),
    ):
        searched = _search_one(file, model, options=options, log=log)
        assert len(searched.detections.boxes) == (0 if options is strict else 12)
        assert len(counted) == n_searches


def test_a_log_belongs_to_the_vehicle_classes(tmp_path: Path, detector: Path) -> None:
    file = tmp_path / "a.png"
    log = tmp_path / "log.sqlite"
    model = Detector(detector)
    paint(file, cars(20))
    plain = ScaleOptions()
    _search_one(file, model, options=plain, log=log)
    assert len(open_detection_log(log, model, plain)) == 1
    assert len(open_detection_log(log, model.with_classes([0]), plain)) == 0


def test_a_changed_file_is_searched_again(tmp_path: Path, detector: Path) -> None:
    file = tmp_path / "a.png"
    log = tmp_path / "log.sqlite"
    model = Detector(detector)
    paint(file, cars(20))
    _search_one(file, model, options=ScaleOptions(), log=log)
    paint(file, cars(20, 3))
    searched = _search_one(file, model, options=ScaleOptions(), log=log)
    assert len(searched.detections.boxes) == 3


def test_an_unreadable_image_is_an_issue(tmp_path: Path, detector: Path) -> None:
    good = tmp_path / "good.png"
    bad = tmp_path / "bad.png"
    paint(good, cars(20))
    bad.write_bytes(b"no image")
    files = [bad, good, tmp_path / "none.png"]
    results = dict(search_images(files, Detector(detector), ScaleOptions()))
    reasons = [item.reason if isinstance(item, FileIssue) else "" for item in results.values()]
    assert reasons == ["image_undecodable", "", "image_not_found"]


def test_an_unreadable_image_is_tried_again(tmp_path: Path, detector: Path) -> None:
    good = tmp_path / "good.png"
    bad = tmp_path / "bad.png"
    paint(good, cars(20))
    bad.write_bytes(b"no image")
    model = Detector(detector)
    log = tmp_path / "log.sqlite"
    dict(search_images([bad, good], model, ScaleOptions(), log=_log(log, model)))
    paint(bad, cars(20))
    results = dict(search_images([bad, good], model, ScaleOptions(), log=_log(log, model)))
    assert not any(isinstance(item, FileIssue) for item in results.values())


def test_a_new_alpha_repeats_the_search(tmp_path: Path, detector: Path, counted: list[str]) -> None:
    file = tmp_path / "a.png"
    log = tmp_path / "log.sqlite"
    model = Detector(detector)
    paint(file, cars(20))
    plain = ScaleOptions()
    wide = ScaleOptions(lengths=Lengths(alpha=2.5))
    data = KnownScaleSet("", (KnownScaleImage(file, 0.2),))
    (searched,) = search_known_scale(data, model, plain, cache=log).values()
    assert not isinstance(searched, FileIssue)
    with pytest.raises(InvalidParameterError, match=r"searched without alpha 2\.5"):
        searched.analysis(model.card, wide)
    for _ in range(2):
        (searched,) = search_known_scale(data, model, wide, cache=log).values()
        assert not isinstance(searched, FileIssue)
        assert searched.analysis(model.card, wide).estimate.n_vehicles == 12
    assert len(counted) == 2


def test_a_split_of_dota_gives_its_images(dota: Path) -> None:
    data = survey_dota(dota)
    assert [image.path.name for image in data.images] == [
        "P0000.png", "P0001.png", "P0002.png", "P0003.png", "P0007.png"
    ]  # fmt: skip
    # The scale is neither that of version 1.0 nor that of the axis-aligned boxes.
    assert data.images[0].gsd_m_per_px == REFERENCE_M / 20
    assert [image.labelled_vehicles for image in data.images] == [12, 12, 12, 0, 0]


def test_a_split_of_dota_reports_unusable_files(dota: Path) -> None:
    issues = survey_dota(dota).issues
    assert {(issue.file.name, issue.reason, issue.skipped) for issue in issues} == {
        ("P0004.png", "no_gsd", True),
        ("P0005.png", "no_gsd", True),
        ("P0006.png", "no_label", True),
        ("P0000.png", "duplicate_name", True),
        ("P0001.txt", "malformed_labels", False),
        ("P0008.txt", "no_image", True),
        ("P0009.txt", "unreadable_labels", True),
    }


def test_a_malformed_label_is_quoted_with_its_line(dota: Path) -> None:
    issues = survey_dota(dota).issues
    malformed = next(issue for issue in issues if issue.reason == "malformed_labels")
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
    # Without a gsd: line in it, an image has no known scale.
    (dota / "meta" / "P0000.txt").write_text("imagesource:GoogleEarth\n")
    assert survey_dota(dota).images == ()


def test_a_folder_that_is_not_a_split_is_refused(dota: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidParameterError, match="name one of its splits: val"):
        survey_dota(tmp_path)
    (tmp_path / "bare" / "images").mkdir(parents=True)
    with pytest.raises(InvalidParameterError, match="--labels"):
        survey_dota(tmp_path / "bare")
    with pytest.raises(InvalidParameterError, match="no label folder"):
        survey_dota(dota, tmp_path / "nowhere")


@pytest.fixture
def table(tmp_path: Path) -> Path:
    """A table with good and bad lines; of its images, a and b have labels."""
    for name in ("a", "b", "c"):
        paint(tmp_path / "images" / f"{name}.png", cars(20))
    (tmp_path / "labels").mkdir()
    (tmp_path / "labels" / "a.txt").write_text("")
    (tmp_path / "images" / "b.txt").write_text("")
    lines = [
        "file,gsd_m_per_px,set",
        "images/a.png,0.2,x",
        "images/b.png,wide,x",
        "images/b.png,0.3,y",
        "images/a.png,0.2,x",
        "images/none.png,0.2,x",
        ",0.2,x",
        "images/c.png,0.2,y",
    ]
    path = tmp_path / "table.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_a_table_finds_labels_beside_its_images(table: Path) -> None:
    images = survey_table(table).images
    folders = [(image.path.stem, image.labels and image.labels.parent.name) for image in images]
    assert folders == [("a", "labels"), ("b", "images"), ("c", None)]


def test_a_table_reports_bad_lines(table: Path) -> None:
    reasons = sorted(issue.reason for issue in survey_table(table).issues)
    assert reasons == ["duplicate_name", "malformed_row", "malformed_row", "no_image"]


def test_images_are_selected_by_set(table: Path) -> None:
    data = survey_table(table)
    assert [image.path.stem for image in data.select(set_name="y").images] == ["b", "c"]


def test_images_are_selected_up_to_a_number(table: Path) -> None:
    data = survey_table(table)
    assert [image.path.stem for image in data.select(limit=1).images] == ["a"]


def test_a_table_without_a_usable_line_is_refused(tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    table.write_text("name,gsd\na,0.1\n")
    with pytest.raises(InvalidParameterError, match=r"no line of the table can be used.*line 2"):
        survey_table(table)


def test_a_missing_table_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidParameterError, match="cannot read table"):
        survey_table(tmp_path / "none.csv")


@pytest.fixture
def geotiffs(tmp_path: Path) -> list[Path]:
    """Georeferenced images in metres, in Mercator's metres at 60 degrees north, and in degrees."""
    latitude_60_m = 8399737.89  # northing of 60 degrees in Web Mercator
    return [
        write_geotiff(tmp_path / "metres.tif", "EPSG:25832", pixel=0.25, x=500000, y=5500000),
        write_geotiff(
            tmp_path / "mercator.tif", "EPSG:3857", pixel=0.5, x=1000000, y=latitude_60_m
        ),
        write_geotiff(tmp_path / "degrees.tif", "EPSG:4326", pixel=2e-6, x=10, y=0),
    ]


def test_the_true_scale_of_a_geotiff_is_corrected_for_its_latitude(geotiffs: list[Path]) -> None:
    data = survey_geotiffs([*geotiffs, geotiffs[0]])
    # On the ellipsoid at 60 degrees, a metre of Web Mercator is half of sqrt(M N) / a = 1.00168 m.
    scales = [image.gsd_m_per_px for image in data.images]
    assert scales == pytest.approx([0.25, 0.25042, 0.2219], rel=1e-4)


def test_files_without_a_georeference_are_reported(tmp_path: Path, geotiffs: list[Path]) -> None:
    paint(tmp_path / "plain.png", cars(20))
    (tmp_path / "broken.tif").write_bytes(b"II*\0")
    data = survey_geotiffs([*geotiffs, tmp_path / "plain.png", tmp_path / "broken.tif"])
    assert [(issue.file.name, issue.reason) for issue in data.issues] == [
        ("plain.png", "no_georeference"),
        ("broken.tif", "image_undecodable"),
    ]


def test_a_folder_gives_its_geotiffs(tmp_path: Path, geotiffs: list[Path]) -> None:
    assert len(survey_geotiffs([tmp_path]).images) == len(geotiffs) == 3


def test_a_missing_folder_of_geotiffs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidParameterError, match="no file or folder"):
        survey_geotiffs([tmp_path / "none"])


def test_a_source_without_known_scales_gives_no_images(tmp_path: Path) -> None:
    paint(tmp_path / "plain.png", cars(20))
    assert survey_known_scale(geotiff=[tmp_path / "plain.png"]).images == ()


def test_a_survey_is_limited_to_a_number(dota: Path) -> None:
    assert len(survey_known_scale(dota=dota, limit=2).images) == 2


def test_a_survey_needs_one_source(dota: Path, tmp_path: Path) -> None:
    with pytest.raises(InvalidParameterError, match="give the images with one of"):
        survey_known_scale()
    with pytest.raises(InvalidParameterError, match="give the images with one of"):
        survey_known_scale(dota=dota, table=tmp_path / "t.csv")


def test_an_unknown_set_is_refused(dota: Path) -> None:
    with pytest.raises(InvalidParameterError, match="no image of set 'asia'"):
        survey_known_scale(dota=dota, set_name="asia")


VOTES = Votes(share_at_zero=-13.76, share_slope=17.4)


def _trial(true_gsd: float, cars: int) -> ScaleTrial:
    """Estimate 0.1 m/px from cars of 50 px and 5 m."""
    boxes = np.array([[99.0 + 90 * k, 90, 50.0, 20.0, 0] for k in range(cars)]).reshape(-1, 5)
    card = made_card(5.0).model_copy(update={"votes": VOTES})
    view = View(
        ImageFacts(4000, 3000),
        Detections(boxes, np.full(cars, 0.9)),
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
    threshold = confidence_threshold(confidences.tolist(), wrong.tolist())
    assert threshold.confidence is not None
    share = threshold.wrong / threshold.images
    assert share <= 0.01 < (threshold.wrong + 1) / (threshold.images + 1)
    assert 0.49 < threshold.confidence < 0.5


@pytest.mark.parametrize("n", [0, 99])
def test_too_few_images_have_no_threshold(n: int) -> None:
    assert confidence_threshold([0.9] * n, [False] * n).confidence is None


@pytest.fixture
def reliability() -> ReliabilityReport:
    """Reliability of 120 correct trials, a wrong one, one with two cars, and one without cars."""
    trials = [_trial(0.1, 30)] * 120 + [_trial(0.2, 30), _trial(0.1, 2), _trial(0.1, 0)]
    return report_reliability("here", "made", trials)


def test_trials_are_grouped_by_vehicles(reliability: ReliabilityReport) -> None:
    by_cars = {row.name: row for row in reliability.by_vehicles}
    assert [row.images for row in reliability.by_vehicles] == [1, 1, 0, 121]
    assert (by_cars["20 and more"].usable, by_cars["20 and more"].wrong) == (121, 1)
    assert by_cars["20 and more"].median == pytest.approx(0, abs=0.005)
    assert by_cars["0"].estimates == 0


def test_trials_are_grouped_by_resolution(reliability: ReliabilityReport) -> None:
    images = {row.name: row.images for row in reliability.by_resolution}
    assert sum(images.values()) == reliability.whole.images == 123
    assert images["0.2 to 0.3"] == 1


def test_a_chance_is_compared_with_its_outcome(reliability: ReliabilityReport) -> None:
    most_frequent = next(row for row in reliability.chances if row.images > 100)
    assert most_frequent.happened == pytest.approx(120 / 121)


def test_the_report_states_the_threshold(reliability: ReliabilityReport) -> None:
    assert reliability.threshold is not None
    assert (reliability.threshold_images, reliability.threshold_wrong) == (122, 1)


@pytest.fixture
def short_reliability_text() -> str:
    return reliability_markdown(report_reliability("here", "made", [_trial(0.1, 30)] * 12))


def test_the_text_fits_a_terminal(short_reliability_text: str) -> None:
    assert max(map(len, short_reliability_text.splitlines())) <= 80


def test_the_text_states_that_there_are_too_few_images(short_reliability_text: str) -> None:
    message = "No limit of the confidence leaves 1 % wrong and 100 estimates of 12"
    assert message in short_reliability_text


def test_the_command_writes_the_report(dota: Path, detector: Path) -> None:
    out = dota.parent / "out"
    arguments = ["evaluate", "reliability", "--dota", dota, "--detector", detector, "--out", out]
    result = CliRunner().invoke(cli.app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.stderr
    report = json.loads((out / "reliability.json").read_text())
    assert (report["whole"]["images"], report["whole"]["estimates"]) == (4, 3)
    assert (out / "reliability.md").read_text() in result.stdout
    with (out / "reliability.csv").open(newline="") as handle:
        assert {row["by"] for row in csv.DictReader(handle)} == {"vehicles", "true m/px"}
