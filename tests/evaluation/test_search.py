from __future__ import annotations

from pathlib import Path

import pytest

from tests.journals import n_results
from tests.known_scale_data import cars, paint
from vehanchor import analyse_scale
from vehanchor.detection.detector import Detector
from vehanchor.errors import InvalidParameterError
from vehanchor.options import Lengths, Reference, ScaleOptions, Search
from vehanchor_evaluation.known_scale import FileIssue, KnownScaleImage, KnownScaleSet
from vehanchor_evaluation.search import (
    DetectionLog,
    open_detection_log,
    search_images,
    search_known_scale,
)


def _log(path: Path, model: Detector) -> DetectionLog:
    return open_detection_log(path, model, ScaleOptions())


def test_an_interrupted_search_goes_on_where_it_stopped(tmp_path: Path, detector: Path, counted: list[str]) -> None:
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
        found, fresh = cached[file], analyse_scale(file, detector=model)
        assert not isinstance(found, FileIssue)
        assert found.analysis(model.card, ScaleOptions()).estimate == fresh.estimate
        assert (found.detections.boxes == fresh.detections.boxes).all()


def test_a_search_is_repeated_for_other_settings_and_for_changed_files(
    tmp_path: Path, detector: Path, counted: list[str]
) -> None:
    file, log, model = tmp_path / "a.png", tmp_path / "log.sqlite", Detector(detector)
    paint(file, cars(20))
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
    paint(file, cars(20, 3))
    (result,) = dict(search_images([file], model, plain, log=_log(log, model))).values()
    assert not isinstance(result, FileIssue)
    assert len(result.detections.boxes) == 3


def test_an_unreadable_image_is_an_issue_and_is_tried_again(tmp_path: Path, detector: Path) -> None:
    good, bad = tmp_path / "good.png", tmp_path / "bad.png"
    paint(good, cars(20))
    bad.write_bytes(b"no image")
    model, log = Detector(detector), tmp_path / "log.sqlite"
    found = dict(search_images([bad, good, tmp_path / "none.png"], model, ScaleOptions(), log=_log(log, model)))
    assert [item.reason if isinstance(item, FileIssue) else "" for item in found.values()] == [
        "image_undecodable", "", "image_not_found"
    ]  # fmt: skip
    paint(bad, cars(20))
    found = dict(search_images([bad, good], model, ScaleOptions(), log=_log(log, model)))
    assert not any(isinstance(item, FileIssue) for item in found.values())


def test_the_detail_is_that_around_the_vehicles_which_each_alpha_keeps(
    tmp_path: Path, detector: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # detail depends on where they are, as it does
    for module in ("vehanchor.analysis.pipeline", "vehanchor_evaluation.search"):
        monkeypatch.setattr(f"{module}.resolved_share", lambda _raster, centres, _scale: centres[:, 0].mean() / 480)
    boxes = cars(20)
    boxes[[4, 5, 10, 11], 2] = 24, 33, 26, 60
    file, log, model = tmp_path / "a.png", tmp_path / "log.sqlite", Detector(detector)
    paint(file, boxes)
    seen = set()
    data = KnownScaleSet("", (KnownScaleImage(file, 0.2),))
    for alpha in (1.5, 1.0, None):
        options = ScaleOptions(lengths=Lengths(alpha=alpha))
        (found,) = search_known_scale(data, model, options, cache=log).values()
        assert not isinstance(found, FileIssue)
        fresh = analyse_scale(file, options, detector=model)
        assert found.analysis(model.card, options).resolved == fresh.resolved
        assert found.analysis(model.card, options).estimate == fresh.estimate
        seen.add(fresh.resolved)
    assert len(seen) == 3


def test_an_alpha_that_no_search_has_looked_at_is_looked_at(tmp_path: Path, detector: Path, counted: list[str]) -> None:
    file, log, model = tmp_path / "a.png", tmp_path / "log.sqlite", Detector(detector)
    paint(file, cars(20))
    plain, wide = ScaleOptions(), ScaleOptions(lengths=Lengths(alpha=2.5))
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
