"""The engine, the models and the runtime that it holds, and the types of its methods' arguments and results."""

from vehanchor.detection.detector import Detector
from vehanchor.engine.engine import Engine
from vehanchor.engine.keywords import AreaKeywords, EstimateKeywords, FlightKeywords, MeasureKeywords
from vehanchor.flight.inputs import InputPhotograph
from vehanchor.imagery.sources.opening import ImageSource
from vehanchor.models.runtime import Cancellation, Runtime
from vehanchor.options import ScaleOptions
from vehanchor.options.coordinates import Place
from vehanchor.records import AreaMeasurement, DistanceMeasurement, FlightEstimate, GsdEstimate
from vehanchor.segmentation.segmenter import Segmenter

__all__ = [
    "AreaKeywords",
    "AreaMeasurement",
    "Cancellation",
    "Detector",
    "DistanceMeasurement",
    "Engine",
    "EstimateKeywords",
    "FlightEstimate",
    "FlightKeywords",
    "GsdEstimate",
    "ImageSource",
    "InputPhotograph",
    "MeasureKeywords",
    "Place",
    "Runtime",
    "ScaleOptions",
    "Segmenter",
]
