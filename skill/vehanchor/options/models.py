"""Options of models and of their runtime, for the command line and the server."""

from __future__ import annotations

from vehanchor.options.option import Option

DETECTOR = Option(
    "ONNX oriented-box model, or the name of a bundled one. Default: the bundled one.",
    metavar="FILE",
)
CLASSES = Option(
    "Class, by name or index, that counts as a vehicle; repeatable. Default: the model's.",
    metavar="NAME",
    flag="class",
    repeated=True,
)
THREADS = Option(
    "CPU threads per model; the result is the same with any number. Default: all cores.",
    metavar="N",
)
PROVIDERS = Option(
    "Execution providers, best first: cpu, cuda, tensorrt, coreml, openvino, directml, or an ONNX "
    "Runtime provider; repeatable. Default: cpu.",
    metavar="NAME",
    flag="provider",
    repeated=True,
)
CALIBRATION = Option(
    "Use the reference length measured by 'vehanchor calibrate'.", metavar="FILE", first=True
)
SEGMENTER = Option(
    "ONNX files of a promptable segmenter: SAM, MobileSAM, SAM 2, SAM 3 tracker, EfficientSAM. "
    "Default: the bundled one.",
    metavar="ENCODER DECODER",
)
