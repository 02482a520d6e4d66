"""Options of models and their runtime, for the command line and the server."""

from __future__ import annotations

from typing import Literal, TypeAlias

from vehanchor.options.option import Option

Precision: TypeAlias = Literal["float32", "int8", "auto"]
"""``auto`` is int8 if such a file exists and the processor is fast with it."""

DETECTOR = Option("ONNX oriented-box model, or the name of a bundled one. Default: the bundled one.", metavar="FILE")
PRECISION = Option(
    "Precision of a bundled detector: float32; int8, faster on processors with dot products of bytes (VNNI, Armv8.2); "
    "auto, int8 on those."
)
CLASSES = Option(
    "Class, by name or index, that counts as a vehicle; repeatable. Default: the model's.",
    metavar="NAME",
    flag="class",
    repeated=True,
)
THREADS = Option("CPU threads per model; the result is the same with any number. Default: all cores.", metavar="N")
PROVIDERS = Option(
    "Execution providers, best first: cpu, cuda, tensorrt, coreml, openvino, directml, or an ONNX Runtime provider; "
    "repeatable. Default: cpu.",
    metavar="NAME",
    flag="provider",
    repeated=True,
)
CALIBRATION = Option("Use the reference length measured by 'vehanchor calibrate'.", metavar="FILE", first=True)
SEGMENTER = Option(
    "ONNX files of a promptable segmenter: SAM, MobileSAM, SAM 2, SAM 3 tracker, EfficientSAM. Default: the bundled.",
    metavar="ENCODER DECODER",
)
