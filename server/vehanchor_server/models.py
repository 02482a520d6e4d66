"""The operator's models, loaded once and on demand, so that the server answers its first requests at once."""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import threading
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from vehanchor.errors import VehAnchorError
from vehanchor.models.files import read_model
from vehanchor.models.runtime import DEFAULT_PROVIDERS, Runtime
from vehanchor.models.zoo import (
    bundled_segmenter,
    car_verifier_beside,
    fleet_beside,
    resolve_model,
    resolve_segmenter,
    verifier_beside,
)
from vehanchor_server.errors import CallError

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from vehanchor.analysis.memory import AnalysisMemory
    from vehanchor.detection.detector import Detector
    from vehanchor.engine import Engine
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
"""Modules that a first call would wait for."""

_logger = logging.getLogger(__name__)


class _OnDemand(Generic[T]):
    """A model that is loaded on first use.

    Args:
        name: name of the model and of its setting.
        load: loads the model.
    """

    def __init__(self, name: str, load: Callable[[], T]) -> None:
        self._name = name
        self._load = load
        self._lock = threading.Lock()
        self._value: T | None = None
        self.failure: str | None = None

    @property
    def ready(self) -> bool:
        """Whether the model is loaded."""
        return self._value is not None

    def get(self) -> T:
        """Return the model; block while it loads.

        Raises:
            CallError: ``model_unavailable``; only the log has the operator's paths.
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
                        f"Its operator must check --{self._name}.",
                    ) from error
                self.failure = None
            return self._value


class Models:
    """The models of the settings.

    Args:
        settings: the operator's options.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._engine: Engine | None = None
        self._memory: AnalysisMemory | None = None
        self._lock = threading.Lock()
        self._preloading: threading.Timer | None = None
        self._detector = _OnDemand("detector", lambda: self.engine().detector)
        self._segmenter = _OnDemand("segmenter", lambda: self.engine().segmenter)
        self._calibration = _OnDemand("calibration", self._load_calibration)
        self._required: list[_OnDemand[Any]] = [self._detector]
        if settings.calibration is not None:
            self._required.append(self._calibration)
        if settings.segmenter is not None or bundled_segmenter() is not None:
            self._required.append(self._segmenter)  # otherwise measure_area reports that there is none

    @property
    def ready(self) -> bool:
        """Whether a call can start at once."""
        return all(model.ready for model in self._required)

    @property
    def failure(self) -> str | None:
        """Error code of the last failed load, or None."""
        return next((model.failure for model in self._required if model.failure), None)

    def files(self) -> tuple[Path, ...]:
        """List all existing files that loading reads."""
        settings = self._settings
        found: list[Path] = []
        for resolve in (lambda: (self._detector_file(),), lambda: resolve_segmenter(settings.segmenter)):
            with contextlib.suppress(VehAnchorError):  # loading will report a missing file
                found += resolve()
        beside = (fleet_beside, verifier_beside, car_verifier_beside)
        auxiliary = [other for path in found[:1] for find in beside if (other := find(path))]
        found += [*auxiliary, *([settings.calibration] if settings.calibration is not None else [])]
        for path in [path for path in found if path.suffix == ".onnx"]:
            with contextlib.suppress(VehAnchorError):
                found += read_model(path).weights
        return tuple(found)

    def preload(self, delay_s: float = 0.0) -> None:
        """Load in the background after a delay; log failures, which the first call meets again."""
        timer = threading.Timer(delay_s, self.load_all)
        timer.name, timer.daemon = "vehanchor-preload", True
        self._preloading = timer
        timer.start()

    def end_preload(self) -> None:
        """Wait for the load in the background: ONNX Runtime aborts a process that ends while it opens a model."""
        if self._preloading is not None:
            self._preloading.cancel()
            self._preloading.join()

    def detector(self, call: Runtime | None = None) -> Detector:
        """Return the detector for a call; block while it loads.

        Raises:
            CallError: ``model_unavailable``.
        """
        return self._detector.get().under(call or Runtime())

    def calibration(self) -> Calibration | None:
        """Return the operator's calibration of the detector, or None.

        Raises:
            CallError: ``model_unavailable``.
        """
        return None if self._settings.calibration is None else self._calibration.get()

    def segmenter(self, call: Runtime | None = None) -> Segmenter:
        """Return the segmenter for a call; block while it loads.

        Raises:
            CallError: ``model_unavailable``.
        """
        return self._segmenter.get().under(call or Runtime())

    def load_all(self) -> None:
        """Load all models and the slow modules; log failures."""
        for load in (self.detector, self.calibration, self.segmenter, lambda: self.engine().load()):
            with contextlib.suppress(CallError, VehAnchorError):  # logged where it was raised
                load()
        for module in SLOW_IMPORTS:
            importlib.import_module(module)

    # Import OpenCV and ONNX Runtime late, because they load slowly.

    def _detector_file(self) -> Path:
        return resolve_model(self._settings.detector)

    def engine(self) -> Engine:
        """Return the engine of the settings, without loading models."""
        with self._lock:
            if self._engine is None:
                from vehanchor.engine import Engine

                settings = self._settings
                # an explicit number: ONNX Runtime's own default binds threads to processors, which workers may not
                threads = settings.threads or os.cpu_count()
                runtime = Runtime(threads, settings.providers or DEFAULT_PROVIDERS)
                self._engine = Engine(settings.detector, settings.segmenter, runtime=runtime)
            return self._engine

    @property
    def memory(self) -> AnalysisMemory:
        """Memory of the analyses of this process."""
        with self._lock:
            if self._memory is None:
                from vehanchor.analysis.memory import AnalysisMemory

                self._memory = AnalysisMemory()
            return self._memory

    def _load_calibration(self) -> Calibration:
        from vehanchor.scale.calibration import load_calibration

        assert self._settings.calibration is not None
        calibration = load_calibration(self._settings.calibration)
        card = self.detector().card
        calibration.check_detector(card.name, card.sha256)
        return calibration
