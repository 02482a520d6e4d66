"""Models as callers name them, and their loading on first use."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Generic, TypeAlias, TypeVar

from vehanchor.detection.detector import Detector, load_detector
from vehanchor.errors import InvalidParameterError
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import resolve_model, resolve_segmenter
from vehanchor.segmentation.segmenter import Segmenter, load_segmenter

T = TypeVar("T")
DetectorSource: TypeAlias = Detector | str | os.PathLike[str]
"""A bundled model's name, the path of an ONNX oriented-box model, or a loaded detector."""
SegmenterSource: TypeAlias = Segmenter | tuple[str | os.PathLike[str], str | os.PathLike[str]]
"""Paths of encoder and decoder, or a loaded segmenter."""


class OnDemand(Generic[T]):
    """Model that one thread loads on first use."""

    def __init__(self, load: Callable[[], T]) -> None:
        self._load, self._lock, self._model = load, threading.Lock(), None

    _model: T | None

    def get(self) -> T:
        """Load the model, or return the loaded one."""
        with self._lock:
            if self._model is None:
                self._model = self._load()
            return self._model


def open_detector(source: DetectorSource | None, classes: Sequence[str | int] | None, runtime: Runtime) -> Detector:
    """Open a detector.

    Raises:
        ModelError: it cannot be used.
    """
    if isinstance(source, Detector):
        return source
    path = resolve_model(None if source is None else str(source), runtime.precision)
    return Detector(path, classes=classes, runtime=runtime) if classes else load_detector(path, runtime)


def open_segmenter(source: SegmenterSource | None, runtime: Runtime) -> Segmenter:
    """Open a segmenter.

    Raises:
        ModelError: it cannot be used.
        InvalidParameterError: the source is neither a ``Segmenter`` nor two paths.
    """
    if isinstance(source, Segmenter):
        return source
    files = None
    if source is not None:
        if isinstance(source, str) or len(source) != 2:
            raise InvalidParameterError(f"segmenter is {source!r}: give two paths, of its encoder and its decoder")
        files = Path(source[0]), Path(source[1])
    return load_segmenter(*resolve_segmenter(files), runtime)
