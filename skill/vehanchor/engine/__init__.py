"""The engine, and the models, the runtime and the inputs that its methods take."""

from vehanchor.detection.detector import Detector
from vehanchor.engine.engine import Engine
from vehanchor.imagery.sources.opening import ImageSource
from vehanchor.models.runtime import Cancellation, Runtime
from vehanchor.segmentation.segmenter import Segmenter

__all__ = ["Cancellation", "Detector", "Engine", "ImageSource", "Runtime", "Segmenter"]
