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
_NO_DETECTORS = {
    "verifier.onnx",
    "chips.onnx",
    *(path.name for path in (*SEGMENTER, SCENE_SCALE, COURTS)),
}


def bundled_models() -> dict[str, Path]:
    """List the bundled detectors: name to file."""
    files = sorted(_BUNDLED.glob("*.onnx"), key=lambda path: path.stem)
    return {path.stem: path for path in files if path.name not in _NO_DETECTORS}


def auxiliary_model(detector: Path, kind: Literal["verifier", "chips"]) -> Path | None:
    """Find the verifier or the chip network of a detector; None without one.

    Args:
        detector: file of the detector. The default detector's models are bundled; any other's lie
            beside it, for example ``mine.verifier.onnx`` beside ``mine.onnx``.
        kind: which of them.
    """
    path = detector.with_name(f"{detector.stem}.{kind}.onnx")
    if detector.resolve() == (_BUNDLED / f"{DEFAULT_DETECTOR}.onnx").resolve():
        path = _BUNDLED / f"{kind}.onnx"
    return path if path.is_file() else None


def resolve_model(model: str | Path | None = None) -> Path:
    """Find the file of a detector by its bundled name or by its path.

    Args:
        model: name or path; None for the default detector.

    Raises:
        ModelNotFoundError: the model is neither a bundled name nor a file.
    """
    bundled = bundled_models()
    name = DEFAULT_DETECTOR if model is None else str(model)
    if name in bundled:
        return bundled[name]
    path = Path(name)
    if not path.is_file():
        raise ModelNotFoundError(
            f"no model {name!r}: not a file, and not one of the bundled detectors "
            f"({', '.join(bundled) or 'none'})"
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
