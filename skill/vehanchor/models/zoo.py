"""Bundled models and their files."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from vehanchor.errors import ModelNotFoundError

DEFAULT_DETECTOR = "vehicles"
_BUNDLED = Path(__file__).parent / "bundled"
SEGMENTER = _BUNDLED / "segmenter-encoder.onnx", _BUNDLED / "segmenter-decoder.onnx"
SCENE_SCALE = _BUNDLED / "scene-scale.onnx"
COURTS = _BUNDLED / "courts.onnx"
# Bundled files that are not detectors.
_OTHER_FILES = {
    "verifier.onnx",
    "chips.onnx",
    SCENE_SCALE.name,
    COURTS.name,
    *(path.name for path in SEGMENTER),
}


def bundled_models() -> dict[str, Path]:
    """List the bundled detectors: name to file."""
    files = sorted(_BUNDLED.glob("*.onnx"), key=lambda path: path.stem)
    return {path.stem: path for path in files if path.name not in _OTHER_FILES}


def auxiliary_model(detector: Path, kind: Literal["verifier", "chips"]) -> Path | None:
    """Find the verifier or the chip network of a detector; None without one.

    Args:
        detector: file of the detector. The default detector's models are bundled; any other's lie
            beside it, for example ``mine.verifier.onnx`` beside ``mine.onnx``.
        kind: which of them.
    """
    path = detector.with_name(f"{detector.stem}.{kind}.onnx")
    default_detector = _BUNDLED / f"{DEFAULT_DETECTOR}.onnx"
    if detector.resolve() == default_detector.resolve():
        path = _BUNDLED / f"{kind}.onnx"
    if not path.is_file():
        return None
    return path


def resolve_model(model: str | Path | None = None) -> Path:
    """Find the file of a detector by its bundled name or by its path.

    Args:
        model: name or path; None for the default detector.

    Raises:
        ModelNotFoundError: the model is neither a bundled name nor a file.
    """
    bundled = bundled_models()
    name = DEFAULT_DETECTOR
    if model is not None:
        name = str(model)
    if name in bundled:
        return bundled[name]
    path = Path(name)
    if not path.is_file():
        names = ", ".join(bundled) or "none"
        raise ModelNotFoundError(
            f"no model {name!r}: not a file, and not one of the bundled detectors ({names})"
        )
    return path


def resolve_segmenter(files: tuple[str | Path, str | Path] | None = None) -> tuple[Path, Path]:
    """Find encoder and decoder of a segmenter by their paths; None gives the bundled one.

    Raises:
        ModelNotFoundError: a path is not a file.
    """
    if files is None:
        return SEGMENTER
    encoder, decoder = (Path(file) for file in files)
    for path in (encoder, decoder):
        if not path.is_file():
            raise ModelNotFoundError(
                f"no segmenter file at {str(path)!r}; pass the paths of its encoder and decoder"
            )
    return encoder, decoder
