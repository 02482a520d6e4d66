"""The operator's models.

They are loaded once and on demand, so that the server answers its first requests at once.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import threading
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

from vehanchor.errors import VehAnchorError
from vehanchor.models.files import read_model
from vehanchor.models.runtime import DEFAULT_PROVIDERS, Runtime
from vehanchor.models.zoo import (
    BUNDLED_MODELS,
    auxiliary_model,
    errors_file,
    resolve_model,
    resolve_segmenter,
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
    "vehanchor_server.calls.jpeg",
    "vehanchor.engine",
    "vehanchor.pictures.measurement",
)
"""Modules that a first call would wait for; by name, because some of them import this one."""

_logger = logging.getLogger(__name__)


class Models:
    """The models of the settings.

    Args:
        settings: the operator's options.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._lock = threading.Lock()
        self._created_engine: Engine | None = None
        self._calibration: Calibration | None = None
        self._failures: dict[str, str | None] = {}  # error code of each last load; None for success
        self._required = ["detector", "segmenter"]
        if settings.calibration is not None:
            self._required.append("calibration")

    @property
    def ready(self) -> bool:
        """Whether a call can start at once."""
        return all(self._failures.get(name, "not loaded") is None for name in self._required)

    @property
    def failure(self) -> str | None:
        """Error code of the last failed load, or None."""
        return next(filter(None, map(self._failures.get, self._required)), None)

    def files(self) -> tuple[Path, ...]:
        """List all existing files that loading reads."""
        settings = self._settings
        paths: list[Path] = []
        # Loading will report a missing file.
        with contextlib.suppress(VehAnchorError):
            paths += _detector_files(resolve_model(settings.detector))
        with contextlib.suppress(VehAnchorError):
            paths += resolve_segmenter(settings.segmenter)
        paths += [model.path for model in BUNDLED_MODELS if model.role == "ruler"]
        if settings.calibration is not None:
            paths.append(settings.calibration)
        # Large models keep their weights in files of their own.
        for path in tuple(paths):
            if path.suffix == ".onnx":
                with contextlib.suppress(VehAnchorError):
                    paths += read_model(path).weights
        return tuple(paths)

    def detector(self, call: Runtime | None = None) -> Detector:
        """Return the detector for a call; block while it loads.

        Raises:
            CallError: ``model_unavailable``.
        """
        detector = self._load("detector", lambda: self._engine.detector)
        return detector.under(call or Runtime())

    def segmenter(self, call: Runtime | None = None) -> Segmenter:
        """Return the segmenter for a call; block while it loads.

        Raises:
            CallError: ``model_unavailable``.
        """
        segmenter = self._load("segmenter", lambda: self._engine.segmenter)
        return segmenter.under(call or Runtime())

    def calibration(self) -> Calibration | None:
        """Return the operator's calibration of the detector, or None.

        Raises:
            CallError: ``model_unavailable``.
        """
        if self._settings.calibration is not None and self._calibration is None:
            self._calibration = self._load("calibration", self._read_calibration)
        return self._calibration

    def load_all(self) -> None:
        """Load all models and the slow modules; log failures."""
        for load in (self.detector, self.calibration, self.segmenter, self._engine.load):
            with contextlib.suppress(CallError, VehAnchorError):  # ``_load`` has logged it
                load()
        for module in SLOW_IMPORTS:
            importlib.import_module(module)

    @cached_property
    def memory(self) -> AnalysisMemory:
        """Memory of the analyses of this process."""
        from vehanchor.analysis.memory import AnalysisMemory

        return AnalysisMemory()

    @property
    def _engine(self) -> Engine:
        """The engine of the settings, which loads its models on demand."""
        from vehanchor.engine import Engine  # late, because OpenCV and ONNX Runtime load slowly

        settings = self._settings
        with self._lock:
            if self._created_engine is None:
                # An explicit number: ONNX Runtime's own default binds threads to processors, which
                # workers may not do.
                threads = settings.threads or os.cpu_count()
                runtime = Runtime(threads, settings.providers or DEFAULT_PROVIDERS)
                self._created_engine = Engine(
                    settings.detector, settings.segmenter, runtime=runtime
                )
            return self._created_engine

    def _load(self, name: str, load: Callable[[], T]) -> T:
        """Load one of the operator's models, and note its failure.

        Only the log has the paths; the caller gets the code.
        """
        try:
            model = load()
        except VehAnchorError as error:
            self._failures[name] = error.code
            _logger.error("the %s cannot be loaded: %s: %s", name, error.code, error)
            raise CallError(
                "model_unavailable",
                f"this server's {name} cannot be loaded ({error.code}). Its operator must check "
                f"--{name}.",
            ) from error
        self._failures[name] = None
        return model

    def _read_calibration(self) -> Calibration:
        from vehanchor.scale.calibration import load_calibration

        assert self._settings.calibration is not None
        calibration = load_calibration(self._settings.calibration)
        card = self.detector().card
        calibration.check_detector(card.name, card.sha256)
        return calibration


def _detector_files(detector: Path) -> list[Path]:
    """List the files of a detector, of its errors and of its auxiliary models."""
    paths = [detector]
    errors = errors_file(detector)
    if errors is not None:
        paths.append(errors)
    for model in BUNDLED_MODELS:
        if model.role != "auxiliary":
            continue
        auxiliary = auxiliary_model(detector, model.name)
        if auxiliary is not None:
            paths.append(auxiliary)
    return paths
