"""The engine, its methods as functions, and the types of their arguments."""

from vehanchor.engine.engine import Engine
from vehanchor.engine.keywords import AreaKeywords, EstimateKeywords, FlightKeywords, MeasureKeywords
from vehanchor.flight.inputs import InputPhotograph
from vehanchor.imagery.sources.opening import ImageSource
from vehanchor.options.coordinates import Place

__all__ = [
    "AreaKeywords",
    "Engine",
    "EstimateKeywords",
    "FlightKeywords",
    "ImageSource",
    "InputPhotograph",
    "MeasureKeywords",
    "Place",
]
