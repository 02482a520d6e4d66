"""The engine, the models and the runtime that it holds, and the types of its methods' arguments and results."""

from vehanchor.detection.detector import Detector
from vehanchor.engine.engine import Engine
from vehanchor.engine.keywords import AreaKeywords, EstimateKeywords, MeasureKeywords
from vehanchor.imagery.sources.opening import ImageSource
from vehanchor.models.runtime import Cancellation, Runtime
from vehanchor.options import ScaleOptions
from vehanchor.options.coordinates import Place
from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate
from vehanchor.segmentation.segmenter import Segmenter

__all__ = [
    "AreaKeywords",
    "AreaMeasurement",
    "Cancellation",
    "Detector",
    "DistanceMeasurement",
    "Engine",
    "EstimateKeywords",
    "GsdEstimate",
    "ImageSource",
    "MeasureKeywords",
    "Place",
    "Runtime",
    "ScaleOptions",
    "Segmenter",
]
