from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.flight.ground import write_flight
from tests.models import car_park, write_detector
from vehanchor.analysis.pipeline import search_raster
from vehanchor.detection.detector import Detector
from vehanchor.errors import ImageDecodeError, ImageError, InvalidParameterError, KnownLengthError
from vehanchor.imagery.sources.opening import ImageSource
from vehanchor_flight import estimate as flight_estimate
from vehanchor_flight.inputs import InputPhotograph
from vehanchor_flight.records import FlightEstimate
from vehanchor_flight.verbs import estimate_flight

FLEET = list(30.0 * (1 + 0.06 * np.linspace(-1, 1, 9) ** 3))
FLEETS = [FLEET[0::3], FLEET[1::3], [], FLEET[2::3]]


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Detector:
    return Detector(write_detector(tmp_path_factory.mktemp("model") / "painted.onnx"))


@pytest.fixture
def flight(tmp_path: Path) -> list[str]:
    return write_flight(tmp_path, FLEETS)


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """List what is searched, one entry for each photograph."""
    searched: list[object] = []

    def counted(*arguments: Any, **keywords: Any) -> Any:
        searched.append(arguments)
        return search_raster(*arguments, **keywords)

    monkeypatch.setattr(flight_estimate, "search_raster", counted)
    return searched


def _stop(done: int, _total: int) -> None:
    if done == 2:
        raise KeyboardInterrupt


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory, detector: Detector) -> FlightEstimate:
    """Estimate photographs of one scale, the third of them without cars."""
    folder = tmp_path_factory.mktemp("flight")
    flight = write_flight(folder, FLEETS)
    return estimate_flight(flight, same_scale=True, detector=detector, rulers=("vehicles",))


def test_photographs_of_one_scale_share_it(shared: FlightEstimate) -> None:
    assert shared.status == "ok"
    assert shared.gsd_m_per_px == pytest.approx(5.045 / 30, rel=0.01)
    scales = {photograph.gsd_m_per_px for photograph in shared.photographs}
    assert scales == {shared.gsd_m_per_px}


def test_photographs_of_one_scale_pool_their_cars(shared: FlightEstimate) -> None:
    assert shared.n_vehicles == 9
    (component,) = shared.components
    assert component.n_photographs == 4
    assert component.pooled.n_vehicles == 9
    own = [photograph.own for photograph in shared.photographs if photograph.own]
    assert shared.confidence > max(estimate.confidence for estimate in own)


def test_a_photograph_without_cars_has_no_scale_of_its_own(shared: FlightEstimate) -> None:
    own = shared.photographs[2].own
    assert own is not None
    assert own.status == "no_scale"


def test_each_photograph_names_the_ruler_behind_its_scale(shared: FlightEstimate) -> None:
    first = [photograph.supported_by[0] for photograph in shared.photographs]
    names = [photograph.photograph for photograph in shared.photographs]
    assert [ruler.ruler for ruler in first] == ["vehicles"] * 4
    assert [first[index].photograph for index in (0, 1, 3)] == [names[0], names[1], names[3]]
    assert first[2].photograph in (names[0], names[1], names[3])


def test_a_photograph_that_cannot_be_read_stops_nothing(
    flight: list[str], detector: Detector
) -> None:
    Path(flight[2]).write_bytes(b"no image")
    record = estimate_flight(flight, same_scale=True, detector=detector, rulers=("vehicles",))
    broken = record.photographs[2]
    assert broken.status == "error"
    assert broken.error_code == "image_undecodable"
    assert broken.gsd_m_per_px is None
    assert record.status == "ok"


def test_a_flight_of_nothing_readable_is_an_error(tmp_path: Path, detector: Detector) -> None:
    (tmp_path / "a.png").write_bytes(b"no image")
    with pytest.raises(ImageDecodeError):
        estimate_flight([str(tmp_path / "a.png")], detector=detector)


def test_a_flight_of_no_photograph_is_an_error(detector: Detector) -> None:
    with pytest.raises(ImageError, match="no photograph given"):
        estimate_flight([], detector=detector)


def test_arrays_have_numbers_unless_they_have_names(detector: Detector) -> None:
    images: list[ImageSource | InputPhotograph] = [
        car_park(FLEET[::2]),
        InputPhotograph("frame at 3 s", car_park(FLEET[1::2])),
    ]
    record = estimate_flight(images, same_scale=True, detector=detector)
    names = [photograph.photograph for photograph in record.photographs]
    assert names == ["#1", "frame at 3 s"]


def test_a_name_that_is_given_twice_is_refused(detector: Detector) -> None:
    named = InputPhotograph("frame at 3 s", car_park(FLEET[1::2]))
    with pytest.raises(InvalidParameterError, match="given twice"):
        estimate_flight([named, named], detector=detector)


@pytest.mark.parametrize(
    "option", [{"frame": (4, 3)}, {"known_lengths": [(0, 0, 50, 0, 5.0)]}, {"drop": [1]}]
)
def test_an_option_of_one_image_is_refused(
    flight: list[str], detector: Detector, option: dict[str, Any]
) -> None:
    with pytest.raises(InvalidParameterError, match="one image"):
        estimate_flight(flight, detector=detector, **option)


@pytest.mark.parametrize("one", ["s.png", Path("s.png"), b"png", np.zeros((4, 4, 3), np.uint8), 5])
def test_one_photograph_is_not_a_flight(one: Any, tmp_path: Path) -> None:
    with pytest.raises(InvalidParameterError, match="give a list of photographs"):
        estimate_flight(one, detector=tmp_path / "nowhere.onnx")


def test_an_interrupted_flight_goes_on_where_it_stopped(
    flight: list[str], detector: Detector, tmp_path: Path, searched: list[object]
) -> None:
    whole = estimate_flight(flight, same_scale=True, detector=detector)
    journal = tmp_path / "flight.journal"
    with pytest.raises(KeyboardInterrupt):
        estimate_flight(flight, same_scale=True, detector=detector, journal=journal, progress=_stop)
    searched.clear()
    again = estimate_flight(flight, same_scale=True, detector=detector, journal=journal)
    assert len(searched) == 2
    assert again == whole
    assert not journal.exists()


def test_a_journal_of_other_options_is_refused(
    flight: list[str], detector: Detector, tmp_path: Path
) -> None:
    journal = tmp_path / "flight.journal"
    with pytest.raises(KeyboardInterrupt):
        estimate_flight(flight, same_scale=True, detector=detector, journal=journal, progress=_stop)
    with pytest.raises(InvalidParameterError, match="unfinished run"):
        estimate_flight(flight, same_scale=True, detector=detector, journal=journal, alpha=2.0)


def _journal_of_an_interrupted_run(flight: list[str], detector: Detector, journal: Path) -> Path:
    with pytest.raises(KeyboardInterrupt):
        estimate_flight(flight, same_scale=True, detector=detector, journal=journal, progress=_stop)
    return journal


def test_a_journal_of_other_errors_of_the_detector_is_refused(
    flight: list[str], detector: Detector, tmp_path: Path
) -> None:
    journal = _journal_of_an_interrupted_run(flight, detector, tmp_path / "flight.journal")
    errors = tmp_path / "errors.toml"
    errors.write_text("[boxes]\nlog_sd = 0.2\n")
    other = Detector(detector.path, errors=errors)
    with pytest.raises(InvalidParameterError, match="unfinished run"):
        estimate_flight(flight, same_scale=True, detector=other, journal=journal)


def test_a_journal_of_other_classes_is_refused(
    flight: list[str], detector: Detector, tmp_path: Path
) -> None:
    journal = _journal_of_an_interrupted_run(flight, detector, tmp_path / "flight.journal")
    other = detector.with_classes([0])
    with pytest.raises(InvalidParameterError, match="unfinished run"):
        estimate_flight(flight, same_scale=True, detector=other, journal=journal)


@pytest.fixture
def lines(flight: list[str]) -> Path:
    """Write a table with a line in the photograph without cars."""
    table = Path(flight[0]).with_name("lines.csv")
    table.write_text("file,x1,y1,x2,y2,metres,basis\n2.png,100,50,400,50,36,measured\n")
    return table


def test_lines_of_one_photograph_scale_all_of_one_scale(
    flight: list[str], detector: Detector, lines: Path
) -> None:
    record = estimate_flight(
        [flight[2], flight[0]], same_scale=True, detector=detector, known_lengths_table=lines
    )
    assert record.gsd_m_per_px == pytest.approx(0.12, rel=0.03)
    assert record.components[0].pooled.leading_ruler == "known_length"


def test_lines_of_a_stranger_are_refused(
    flight: list[str], detector: Detector, lines: Path
) -> None:
    for strangers in ([car_park(FLEET)], flight[:2]):
        with pytest.raises(KnownLengthError, match="not one of the images"):
            estimate_flight(strangers, detector=detector, known_lengths_table=lines)


def test_lines_of_several_strangers_are_counted(
    flight: list[str], detector: Detector, lines: Path
) -> None:
    lines.write_text(lines.read_text() + "9.png,1,1,9,9,1,measured\n")
    with pytest.raises(KnownLengthError, match="images, nor is 1 other: files"):
        estimate_flight(flight[:2], detector=detector, known_lengths_table=lines)
