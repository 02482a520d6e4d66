"""One engine holds what is loaded; the package's verbs are its methods."""

from __future__ import annotations

import threading
from concurrent.futures import CancelledError, ThreadPoolExecutor
from pathlib import Path
from typing import Any

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
    VehAnchorError,
)
from vehanchor.segmentation.segmenter import Segmenter

BOX = (300.0, 150.0, 371.0, 190.0)
PATH = [(10.0, 20.0), (310.0, 420.0)]
ALONE: dict[str, Any] = {"rulers": ("vehicles",)}  # quicker: no other network looks at the image


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a detector, m.onnx, and a segmenter."""
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


def _place() -> np.ndarray:
    return car_park(30 + 0.1 * np.arange(30), 800, 600)


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[type]:
    """The classes of models that are opened, in order."""
    found: list[type] = []
    for kind in (Detector, Segmenter):
        original = kind.__init__

        def noted(
            self: Any, *args: Any, _original: Any = original, _kind: type = kind, **keywords: Any
        ) -> None:
            found.append(_kind)
            _original(self, *args, **keywords)

        monkeypatch.setattr(kind, "__init__", noted)
    return found


def test_each_model_is_loaded_once_and_not_before_it_is_needed(
    tmp_path: Path, segmenter: tuple[Path, Path], opened: list[type]
) -> None:
    engine = Engine(
        write_detector(tmp_path / "once.onnx"),
        segmenter,
        runtime=Runtime(threads=3),
        options=ScaleOptions.of(ALONE),
    )
    assert opened == []
    image = _place()
    estimate = engine.estimate(image)
    assert opened == [Detector]
    engine.measure_distance(image, PATH)
    engine.measure_area(image, box=BOX, scale=estimate)
    engine.replace(runtime=Runtime(threads=3, progress=lambda _done, _total: None)).measure_area(
        image, box=BOX
    )
    assert opened == [Detector, Segmenter]


def test_many_threads_share_one_engine(tmp_path: Path, opened: list[type]) -> None:
    engine = Engine(
        write_detector(tmp_path / "shared.onnx"),
        options=ScaleOptions.of(ALONE),
        classes=["small vehicle"],
    )
    together = threading.Barrier(4)

    def estimate(_: int) -> str:
        together.wait()
        return engine.estimate(_place()).model_dump_json()

    with ThreadPoolExecutor(4) as pool:
        records = set(pool.map(estimate, range(4)))
    assert opened == [Detector]
    assert len(records) == 1


def test_a_cancellation_ends_the_call_that_it_belongs_to_and_no_other(engine: Engine) -> None:
    cancellation = Cancellation()
    image = _place()

    def cancel(done: int, _total: int) -> None:
        if done == 2:
            cancellation.cancel()

    with watched_tiles() as tiles, pytest.raises(CancelledError):
        engine.estimate(
            image, tile_px=128, stride_px=96, progress=cancel, cancellation=cancellation
        )
    assert tiles.n_begun <= 3
    with pytest.raises(CancelledError):
        engine.measure_area(image, box=BOX, gsd_m_per_px=0.1, cancellation=cancellation)
    assert engine.estimate(image, rulers=("vehicles",)).status == "ok"


def test_a_verb_gives_what_its_method_gives(
    engine: Engine, files: Path, segmenter: tuple[Path, Path]
) -> None:
    image = _place()
    detector = files / "m.onnx"
    estimate = engine.estimate(image)
    assert estimate == vehanchor.estimate_gsd(image, detector=detector, threads=1, **ALONE)
    assert [estimate, estimate] == vehanchor.estimate_gsd(
        [image, image], detector=detector, **ALONE
    )
    area = vehanchor.measure_area(image, box=BOX, detector=detector, segmenter=segmenter, **ALONE)
    assert (
        engine.measure_area(image, box=BOX)
        == area
        == engine.analyse_area(image, box=BOX).measurement
    )
    distance = vehanchor.measure_distance(image, PATH, detector=detector, **ALONE)
    assert (
        engine.measure_distance(image, PATH)
        == distance
        == engine.analyse_distance(image, PATH).measurement
    )


def test_a_bad_image_of_a_list_is_named_and_the_others_are_kept(
    engine: Engine, tmp_path: Path
) -> None:
    image = _place()
    bad = tmp_path / "bad.jpg"
    bad.write_bytes(b"no image")
    with pytest.raises(ImageListError) as caught:
        engine.estimate([image, bad, image, image[:8]])
    message = str(caught.value)
    assert message.startswith("2 of 4 images cannot be used: image 2 (")
    assert str(bad) in message
    assert "image 4 (ndarray): the image is 800 x 8 px" in message
    first, second, third, fourth = caught.value.results
    assert first == third == engine.estimate(image)
    assert isinstance(second, ImageDecodeError)
    assert isinstance(fourth, ImageFormatError)


def test_keywords_change_single_fields_of_the_engines_options(files: Path) -> None:
    image = _place()
    chosen = Engine(
        files / "m.onnx",
        options=ScaleOptions.of({"reference_length_m": 4.0, "alpha": None, **ALONE}),
    )
    assert chosen.estimate(image).details.reference_length_m == 4.0
    assert chosen.estimate(image, frame=(400, 300)).details.reference_length_m == 4.0
    assert chosen.estimate(image, reference_length_m=5.0).details.reference_length_m == 5.0
    alone = ScaleOptions.of(ALONE)
    assert chosen.estimate(image, alone) == Engine(files / "m.onnx").estimate(image, alone)
    with pytest.raises(InvalidParameterError, match="there is no option 'regoin'"):
        chosen.estimate(image, regoin="europe")


def test_a_segmenter_is_two_paths_or_one_that_is_loaded(
    files: Path, segmenter: tuple[Path, Path]
) -> None:
    assert (
        Engine(segmenter=Segmenter(*segmenter)).segmenter.card
        == Engine(segmenter=segmenter).segmenter.card
    )
    with pytest.raises(InvalidParameterError, match="give two paths"):
        _ = Engine(segmenter="encoder.onnx").segmenter  # type: ignore[arg-type]


def test_load_leaves_no_model_for_the_first_estimate_to_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real = onnxruntime.InferenceSession
    opened = []

    def noted(*args: Any, **keywords: Any) -> Any:
        opened.append(args)
        return real(*args, **keywords)

    monkeypatch.setattr(onnxruntime, "InferenceSession", noted)
    # of no other test: the process has none of these models yet
    engine = Engine(runtime=Runtime(threads=5))
    engine.load()
    n_opened = len(opened)
    assert n_opened >= 4, (
        "detector, chip network, verifier, scene-scale prior; courts, unless a test had them"
    )
    assert engine.estimate(_place()).model == engine.detector.card.name
    assert len(opened) == n_opened


def test_load_fails_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(VehAnchorError):
        Engine(tmp_path / "nowhere.onnx").load()


@pytest.mark.parametrize("threads", [0, -1, 257, 1.5, True, "two", float("nan"), float("inf")])
def test_a_runtime_without_meaning_is_refused_before_any_model_is_opened(threads: Any) -> None:
    with pytest.raises(InvalidParameterError, match="whole number from 1 to 256"):
        vehanchor.estimate_gsd(_place(), threads=threads)
