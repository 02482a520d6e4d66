"""Declarations of which models run, and how; the command line and the server take them."""

from __future__ import annotations

from vehanchor.options.option import Option

DETECTOR = Option("ONNX oriented-box model, or the name of a bundled one. Default: the bundled one.", metavar="FILE")
PRECISION = Option(
    "Precision of a bundled detector: float32; int8, faster on processors with dot products of bytes (VNNI, Armv8.2); "
    "auto, int8 on those."
)
CLASSES = Option(
    "Class, by name or index, that counts as a vehicle; repeatable. Default: the model's.", metavar="NAME", flag="class"
)
THREADS = Option("CPU threads per model; the result is the same with any number. Default: all cores.", metavar="N")
PROVIDERS = Option(
    "Where models run: cpu, cuda, tensorrt, coreml, openvino, directml, or another provider of ONNX Runtime; "
    "repeatable, in order of preference. Default: cpu.",
    metavar="NAME",
    flag="provider",
)
CALIBRATION = Option("Take the reference length that 'vehanchor calibrate' measured.", metavar="FILE")
SEGMENTER = Option(
    "ONNX files of a promptable segmenter: SAM, MobileSAM, SAM 2, SAM 3 tracker, EfficientSAM. Default: the bundled.",
    metavar="ENCODER DECODER",
)
