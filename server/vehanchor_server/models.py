"""The operator's models, loaded once and late: a server answers its first questions before they are there."""

from __future__ import annotations

import contextlib
import importlib
import logging
import threading
from typing import TYPE_CHECKING

from vehanchor_server.errors import CallError

if TYPE_CHECKING:
    from vehanchor.detection import Detector
    from vehanchor_server.settings import Settings

__all__ = ["Models"]

_logger = logging.getLogger(__name__)


class Models:
    """Loads what the settings name.

    Args:
        settings: the operator's options.
    """

    def __init__(self, settings: Settings) -> None:
        self._name = settings.detector
        self._threads = settings.threads
        self._lock = threading.Lock()
        self._detector: Detector | None = None
        self._failure: str | None = None

    @property
    def ready(self) -> bool:
        """Whether a call can start at once."""
        return self._detector is not None

    @property
    def failure(self) -> str | None:
        """The code of the error that loading ended with, None without one."""
        return self._failure

    def preload(self, delay_s: float = 0.0) -> None:
        """Load in the background after a while; a failure is logged, and met again by the first call."""
        timer = threading.Timer(delay_s, self._load_quietly)
        timer.name, timer.daemon = "vehanchor-preload", True
        timer.start()

    def _load_quietly(self) -> None:
        with contextlib.suppress(CallError):  # logged where it was raised
            self.detector()
        importlib.import_module("vehanchor_server.overlay")  # and what else a first call would wait for
        importlib.import_module("vehanchor.perception")

    def detector(self) -> Detector:
        """The detector; blocks while it is loaded.

        Raises:
            CallError: ``model_unavailable``; the operator's paths stay in the log.
        """
        with self._lock:
            if self._detector is None:
                self._detector = self._loaded()
                self._failure = None
            return self._detector

    def _loaded(self) -> Detector:
        from vehanchor.detection import load_detector  # OpenCV and ONNX Runtime are slow to load: not before needed
        from vehanchor.errors import VehAnchorError
        from vehanchor.model_zoo import resolve_model

        try:
            return load_detector(resolve_model(self._name), threads=self._threads)
        except VehAnchorError as error:
            self._failure = error.code
            _logger.error("the detector cannot be loaded: %s: %s", error.code, error)
            raise CallError(
                "model_unavailable",
                f"this server's detector cannot be loaded ({error.code}). Its operator must look at --detector.",
            ) from error
