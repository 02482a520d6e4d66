"""An engine holds loaded models; the functions of the package are its methods."""

from __future__ import annotations

import inspect
import pydoc
import threading
from concurrent.futures import CancelledError, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import onnxruntime
import pytest

import vehanchor
from tests.models import car_park, write_detector
from tests.sam_models import write_sam
from tests.tiles import watched_tiles
from vehanchor import Cancellation, Engine, Runtime, ScaleOptions
from vehanchor.detection.detector import Detector
from vehanchor.errors import (
    ImageDecodeError,
    ImageFormatError,
    ImageListError,
    InvalidParameterError,
    KnownLengthError,
    VehAnchorError,
)
from vehanchor.options import declared_options
from vehanchor.segmentation.segmenter import Segmenter

BOX = (300.0, 150.0, 371.0, 190.0)
PATH = [(10.0, 20.0), (310.0, 420.0)]
# Without other rulers, no other network runs, which is quicker.
ALONE: dict[str, Any] = {"rulers": ("vehicles",)}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a detector, m.onnx, and a segmenter."""
    folder = tmp_path_factory.mktemp("models")
    write_detector(folder / "m.onnx")
    write_sam(folder)
    return folder


@pytest.fixture(scope="module")
def segmenter(files: Path) -> tuple[Path, Path]:
    encoder, decoder = write_sam(files)
    return encoder, decoder


@pytest.fixture
def engine(files: Path, segmenter: tuple[Path, Path]) -> Engine:
    return Engine(files / "m.onnx", segmenter, options=ScaleOptions.of(ALONE))


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    return car_park(30 + 0.1 * np.arange(30), 800, 600)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[type]:
    """The classes of models that are opened, in order."""
    classes: list[type] = []
    for kind in (Detector, Segmenter):
        original = kind.__init__

        def noted(
            self: Any, *args: Any, _original: Any = original, _kind: type = kind, **keywords: Any
        ) -> None:
            classes.append(_kind)
            _original(self, *args, **keywords)

        monkeypatch.setattr(kind, "__init__", noted)
    return classes


@pytest.fixture
def fresh(tmp_path: Path) -> Engine:
    """An engine whose models no other test has opened."""
    detector = write_detector(tmp_path / "fresh.onnx")
    encoder, decoder = write_sam(tmp_path)
    options = ScaleOptions.of(ALONE)
    runtime = Runtime(threads=3)
    return Engine(detector, (encoder, decoder), options=options, runtime=runtime)


def test_a_model_is_loaded_when_it_is_needed(
    fresh: Engine, image: np.ndarray, opened: list[type]
) -> None:
    assert opened == []
    fresh.estimate(image)
    assert opened == [Detector]
    fresh.measure_area(image, box=BOX)
    assert opened == [Detector, Segmenter]


def test_a_model_is_loaded_once_for_all_calls(
    fresh: Engine, image: np.ndarray, opened: list[type]
) -> None:
    estimate = fresh.estimate(image)
    fresh.measure_distance(image, PATH)
    fresh.measure_area(image, box=BOX, scale=estimate)
    assert opened == [Detector, Segmenter]


def test_an_engine_with_other_progress_shares_the_models(
    fresh: Engine, image: np.ndarray, opened: list[type]
) -> None:
    fresh.measure_area(image, box=BOX)
    runtime = Runtime(threads=3, progress=lambda _done, _total: None)
    fresh.replace(runtime=runtime).measure_area(image, box=BOX)
    assert opened.count(Detector) == opened.count(Segmenter) == 1


def test_many_threads_share_one_engine(
    tmp_path: Path, image: np.ndarray, opened: list[type]
) -> None:
    engine = Engine(
        write_detector(tmp_path / "shared.onnx"),
        options=ScaleOptions.of(ALONE),
        classes=["small vehicle"],
    )
    together = threading.Barrier(4)

    def estimate(_: int) -> str:
        together.wait()
        return engine.estimate(image).model_dump_json()

    with ThreadPoolExecutor(4) as pool:
        records = set(pool.map(estimate, range(4)))
    assert opened == [Detector]
    assert len(records) == 1


def test_a_cancellation_ends_a_search_between_tiles(engine: Engine, image: np.ndarray) -> None:
    cancellation = Cancellation()

    def cancel(done: int, _total: int) -> None:
        if done == 2:
            cancellation.cancel()

    options: dict[str, Any] = {"tile_px": 128, "stride_px": 96}
    with watched_tiles() as tiles, pytest.raises(CancelledError):
        engine.estimate(image, progress=cancel, cancellation=cancellation, **options)
    assert tiles.n_begun <= 3


def test_a_cancellation_ends_only_its_own_calls(engine: Engine, image: np.ndarray) -> None:
    cancellation = Cancellation()
    cancellation.cancel()
    with pytest.raises(CancelledError):
        engine.measure_area(image, box=BOX, gsd_m_per_px=0.1, cancellation=cancellation)
    assert engine.estimate(image, rulers=("vehicles",)).status == "ok"


# --- The functions of the package


@pytest.fixture
def keywords(files: Path) -> dict[str, Any]:
    """Keywords that give a function the detector and the options of the engine."""
    return {"detector": files / "m.onnx", **ALONE}


def test_a_function_gives_the_record_of_its_method(
    engine: Engine, image: np.ndarray, keywords: dict[str, Any]
) -> None:
    assert engine.estimate(image) == vehanchor.estimate_gsd(image, threads=1, **keywords)


def test_a_list_of_images_has_a_list_of_records(
    engine: Engine, image: np.ndarray, keywords: dict[str, Any]
) -> None:
    estimate = engine.estimate(image)
    assert vehanchor.estimate_gsd([image, image], **keywords) == [estimate, estimate]


def test_the_record_of_an_area_is_that_of_its_analysis(
    engine: Engine,
    image: np.ndarray,
    keywords: dict[str, Any],
    segmenter: tuple[Path, Path],
) -> None:
    area = vehanchor.measure_area(image, box=BOX, segmenter=segmenter, **keywords)
    assert engine.measure_area(image, box=BOX) == area
    assert engine.analyse_area(image, box=BOX).measurement == area


def test_the_record_of_a_distance_is_that_of_its_analysis(
    engine: Engine, image: np.ndarray, keywords: dict[str, Any]
) -> None:
    distance = vehanchor.measure_distance(image, PATH, **keywords)
    assert engine.measure_distance(image, PATH) == distance
    assert engine.analyse_distance(image, PATH).measurement == distance


# --- Errors in a list of images


class FailedList(NamedTuple):
    """Error of a list of images, with the path of an unreadable one."""

    error: ImageListError
    unreadable: Path


@pytest.fixture(scope="module")
def failed_list(
    files: Path, image: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> FailedList:
    """The second image of four is unreadable, the fourth is too small."""
    unreadable = tmp_path_factory.mktemp("list") / "bad.jpg"
    unreadable.write_bytes(b"no image")
    with pytest.raises(ImageListError) as caught:
        vehanchor.estimate_gsd(
            [image, unreadable, image, image[:8]], detector=files / "m.onnx", **ALONE
        )
    return FailedList(caught.value, unreadable)


def test_bad_images_of_a_list_are_named(failed_list: FailedList) -> None:
    message = str(failed_list.error)
    assert message.startswith("2 of 4 images cannot be used: image 2 (")
    assert str(failed_list.unreadable) in message
    assert "image 4 (ndarray): the image is 800 x 8 px" in message


def test_the_error_of_a_list_has_the_records_of_good_images(
    failed_list: FailedList, engine: Engine, image: np.ndarray
) -> None:
    first, _, third, _ = failed_list.error.results
    assert first == third == engine.estimate(image)


def test_the_error_of_a_list_has_the_errors_of_bad_images(failed_list: FailedList) -> None:
    _, second, _, fourth = failed_list.error.results
    assert isinstance(second, ImageDecodeError)
    assert isinstance(fourth, ImageFormatError)


# --- Options of a call


@pytest.fixture(scope="module")
def four_metres(files: Path) -> Engine:
    """An engine with a reference length of 4 m."""
    options = ScaleOptions.of({"reference_length_m": 4.0, "alpha": None, **ALONE})
    return Engine(files / "m.onnx", options=options)


@pytest.mark.parametrize(
    ("keywords", "length_m"),
    [({}, 4.0), ({"frame": (400, 300)}, 4.0), ({"reference_length_m": 5.0}, 5.0)],
)
def test_keywords_replace_single_options_of_the_engine(
    four_metres: Engine, image: np.ndarray, keywords: dict[str, Any], length_m: float
) -> None:
    assert four_metres.estimate(image, **keywords).details.reference_length_m == length_m


def test_options_of_a_call_replace_all_options_of_the_engine(
    four_metres: Engine, files: Path, image: np.ndarray
) -> None:
    alone = ScaleOptions.of(ALONE)
    default_engine = Engine(files / "m.onnx")
    assert four_metres.estimate(image, alone) == default_engine.estimate(image, alone)


def test_an_unknown_keyword_is_refused(four_metres: Engine, image: np.ndarray) -> None:
    with pytest.raises(InvalidParameterError, match="no option 'regoin'; the nearest is region"):
        four_metres.estimate(image, regoin="europe")


def test_a_shortened_keyword_is_answered_with_the_whole_one(
    four_metres: Engine, image: np.ndarray
) -> None:
    with pytest.raises(InvalidParameterError, match="the nearest is height_basis or height_m or"):
        four_metres.estimate(image, height=80)


def test_a_line_outside_a_list_is_answered_with_its_form(
    four_metres: Engine, image: np.ndarray
) -> None:
    with pytest.raises(KnownLengthError, match=r"a list of items, each \(x1, y1, x2, y2, metres"):
        four_metres.estimate(image, known_lengths=(100, 120, 400, 520, 60))


# --- Models


def test_a_segmenter_may_be_loaded_or_two_paths(segmenter: tuple[Path, Path]) -> None:
    loaded = Engine(segmenter=Segmenter(*segmenter))
    by_paths = Engine(segmenter=segmenter)
    assert loaded.segmenter.card == by_paths.segmenter.card


def test_one_path_is_not_a_segmenter() -> None:
    with pytest.raises(InvalidParameterError, match="give two paths"):
        _ = Engine(segmenter="encoder.onnx").segmenter  # type: ignore[arg-type]


def test_load_opens_all_models_of_an_estimate(
    image: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = onnxruntime.InferenceSession
    opened = []

    def noted(*args: Any, **keywords: Any) -> Any:
        opened.append(args)
        return real(*args, **keywords)

    monkeypatch.setattr(onnxruntime, "InferenceSession", noted)
    # No other test uses five threads, so this process has not opened these models yet.
    engine = Engine(runtime=Runtime(threads=5))
    engine.load()
    n_opened = len(opened)
    # Detector, chip network, verifier and scene-scale prior; another test may have opened courts.
    assert n_opened >= 4
    assert engine.estimate(image).model == engine.detector.card.name
    assert len(opened) == n_opened


def test_load_fails_for_a_missing_model(tmp_path: Path) -> None:
    with pytest.raises(VehAnchorError):
        Engine(tmp_path / "nowhere.onnx").load()


@pytest.mark.parametrize("threads", [0, -1, 257, 1.5, True, "two", float("nan"), float("inf")])
def test_an_invalid_number_of_threads_is_refused(image: np.ndarray, threads: Any) -> None:
    with pytest.raises(InvalidParameterError, match="whole number from 1 to 256"):
        vehanchor.estimate_gsd(image, threads=threads)


@pytest.fixture(scope="module")
def ships(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    """A loaded detector that finds painted cars under the name of another class."""
    path = tmp_path_factory.mktemp("ships") / "m.onnx"
    return Detector(write_detector(path, names={0: "small vehicle", 1: "ship"}))


def test_classes_hold_for_a_loaded_detector(ships: Detector, image: np.ndarray) -> None:
    options = ScaleOptions.of(ALONE)
    assert Engine(ships, options=options).estimate(image).status == "ok"
    assert Engine(ships, options=options, classes=["ship"]).estimate(image).n_vehicles == 0


def test_classes_hold_for_the_detector_of_a_call(
    ships: Detector, files: Path, image: np.ndarray
) -> None:
    engine = Engine(files / "m.onnx", options=ScaleOptions.of(ALONE), classes=[0])
    assert engine.replace(detector=ships).detector.classes == (0,)
    assert engine.estimate(image, detector=ships).status == "ok"


def test_a_loaded_detector_without_a_class_is_refused(ships: Detector, image: np.ndarray) -> None:
    with pytest.raises(InvalidParameterError, match="tank"):
        Engine(ships, classes=["tank"]).estimate(image)


def test_a_detector_with_other_classes_shares_the_model(
    ships: Detector, opened: list[type]
) -> None:
    ship = Engine(ships, classes=["ship"]).detector
    assert ship.classes == ("ship",)
    assert ships.classes is None
    assert opened == []


def test_a_detector_with_classes_is_loaded_once(
    tmp_path: Path, image: np.ndarray, opened: list[type]
) -> None:
    path = write_detector(tmp_path / "m.onnx")
    for _ in range(2):
        Engine(path, options=ScaleOptions.of(ALONE), classes=["small vehicle"]).estimate(image)
    assert opened == [Detector]


def test_a_box_without_its_name_is_answered_with_the_right_call() -> None:
    measure: Any = vehanchor.measure_area
    with pytest.raises(InvalidParameterError, match=r"measure_area\(image, box="):
        measure("photo.jpg", (1, 2, 3, 4))


@pytest.mark.parametrize("name", ["measure_area", "measure_areas", "measure_distance"])
def test_help_shows_the_keywords_of_the_analysis(name: str) -> None:
    analysis = inspect.signature(getattr(vehanchor.Engine, name.replace("measure", "analyse")))
    measurement = inspect.signature(getattr(vehanchor.Engine, name))
    assert list(measurement.parameters) == list(analysis.parameters)


@pytest.mark.parametrize("name", ["estimate_gsd", "measure_area", "measure_distance"])
def test_help_lists_the_options(name: str) -> None:
    text = pydoc.render_doc(getattr(vehanchor, name))
    missing = [option for option in declared_options() if option not in text]
    assert missing == []
