"""The operator's models, loaded once and late: a server answers its first questions before they are there."""

from __future__ import annotations

import contextlib
import importlib
import logging
import threading
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast

from vehanchor.errors import VehAnchorError
from vehanchor.models.files import read_model
from vehanchor.models.runtime import DEFAULT_PROVIDERS, Runtime
from vehanchor.models.zoo import (
    bundled_segmenter,
    fleet_beside,
    resolve_model,
    resolve_segmenter,
    verifier_beside,
)
from vehanchor_server.errors import CallError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from vehanchor.detection.detector import Detector
    from vehanchor.engine import Engine
    from vehanchor.models.precision import Precision
    from vehanchor.scale.calibration import Calibration
    from vehanchor.segmentation.segmenter import Segmenter
    from vehanchor_server.settings import Settings

T = TypeVar("T")

SLOW_IMPORTS = (
    "vehanchor_server.tools.registry",
    "vehanchor_server.calls.overlay",
    "vehanchor.engine",
    "vehanchor.pictures.area",
)
"""What a first call would wait for."""

_logger = logging.getLogger(__name__)


class _OnDemand(Generic[T]):
    """A model that is loaded when it is first asked for.

    Args:
        name: of the model, and of the setting that names it.
        load: loads it.
    """

    def __init__(self, name: str, load: Callable[[], T]) -> None:
        self._name = name
        self._load = load
        self._lock = threading.Lock()
        self._value: T | None = None
        self.failure: str | None = None

    @property
    def ready(self) -> bool:
        """Whether it is loaded."""
        return self._value is not None

    def get(self) -> T:
        """The model; blocks while it is loaded.

        Raises:
            CallError: ``model_unavailable``; the operator's paths stay in the log.
        """
        with self._lock:
            if self._value is None:
                try:
                    self._value = self._load()
                except VehAnchorError as error:
                    self.failure = error.code
                    _logger.error("the %s cannot be loaded: %s: %s", self._name, error.code, error)
                    raise CallError(
                        "model_unavailable",
                        f"this server's {self._name} cannot be loaded ({error.code}). "
                        f"Its operator must look at --{self._name}.",
                    ) from error
                self.failure = None
            return self._value


class Models:
    """Loads what the settings name.

    Args:
        settings: the operator's options.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._engine: Engine | None = None
        self._lock = threading.Lock()
        self._detector = _OnDemand("detector", lambda: self.engine().detector)
        self._segmenter = _OnDemand("segmenter", lambda: self.engine().segmenter)
        self._calibration = _OnDemand("calibration", self._load_calibration)
        self._required: list[_OnDemand[Any]] = [self._detector]
        if settings.calibration is not None:
            self._required.append(self._calibration)
        if settings.segmenter is not None or bundled_segmenter() is not None:
            self._required.append(self._segmenter)  # else measure_area says that there is none, and the rest works

    @property
    def ready(self) -> bool:
        """Whether a call can start at once."""
        return all(model.ready for model in self._required)

    @property
    def failure(self) -> str | None:
        """The code of the error that loading ended with, None without one."""
        return next((model.failure for model in self._required if model.failure), None)

    def files(self) -> tuple[Path, ...]:
        """All files that loading reads, as far as they exist."""
        settings = self._settings
        found: list[Path] = []
        for resolve in (lambda: (self._detector_file(),), lambda: resolve_segmenter(settings.segmenter)):
            with contextlib.suppress(VehAnchorError):  # loading will say what is missing
                found += resolve()
        beside = [other for path in found[:1] for other in (fleet_beside(path), verifier_beside(path)) if other]
        found += [*beside, *([settings.calibration] if settings.calibration is not None else [])]
        for path in [path for path in found if path.suffix == ".onnx"]:
            with contextlib.suppress(VehAnchorError):
                found += read_model(path).weights
        return tuple(found)

    def preload(self, delay_s: float = 0.0) -> None:
        """Load in the background after a while; a failure is logged, and met again by the first call."""
        timer = threading.Timer(delay_s, self.load_all)
        timer.name, timer.daemon = "vehanchor-preload", True
        timer.start()

    def detector(self, call: Runtime | None = None) -> Detector:
        """The detector for a call; blocks while it is loaded.

        Raises:
            CallError: ``model_unavailable``.
        """
        return self._detector.get().under(call or Runtime())

    def calibration(self) -> Calibration | None:
        """The detector's reference length as the operator measured it; None without.

        Raises:
            CallError: ``model_unavailable``.
        """
        return None if self._settings.calibration is None else self._calibration.get()

    def segmenter(self, call: Runtime | None = None) -> Segmenter:
        """The segmenter for a call; blocks while it is loaded.

        Raises:
            CallError: ``model_unavailable``.
        """
        return self._segmenter.get().under(call or Runtime())

    def load_all(self) -> None:
        """Load what the settings name, and what else a first call would wait for; a failure is logged."""
        for load in (self.detector, self.calibration, self.segmenter, lambda: self.engine().load()):
            with contextlib.suppress(CallError, VehAnchorError):  # logged where it was raised
                load()
        for module in SLOW_IMPORTS:
            importlib.import_module(module)

    # OpenCV and ONNX Runtime are slow to load: not before they are needed.

    def _detector_file(self) -> Path:
        return resolve_model(self._settings.detector, cast("Precision", self._settings.precision))

    def engine(self) -> Engine:
        """The engine that the settings describe; nothing is loaded yet."""
        with self._lock:
            if self._engine is None:
                from vehanchor.engine import Engine

                settings = self._settings
                precision = cast("Precision", settings.precision)
                runtime = Runtime(settings.threads, settings.providers or DEFAULT_PROVIDERS, precision)
                self._engine = Engine(settings.detector, settings.segmenter, runtime=runtime)
            return self._engine

    def _load_calibration(self) -> Calibration:
        from vehanchor.scale.calibration import load_calibration

        assert self._settings.calibration is not None
        calibration = load_calibration(self._settings.calibration)
        card = self.detector().card
        calibration.check_detector(card.name, card.sha256)
        return calibration
