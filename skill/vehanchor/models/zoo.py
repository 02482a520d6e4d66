"""Bundled models and their files."""

from __future__ import annotations

from pathlib import Path

from vehanchor.errors import ModelNotFoundError

DEFAULT_DETECTOR = "vehicles"
_SEGMENTER = "segmenter-encoder.onnx", "segmenter-decoder.onnx"
_VERIFIER = "verifier.onnx"  # for the default detector
_CHIPS = "chips.onnx"  # for the default detector
_SCENE_SCALE = "scene-scale.onnx"
_COURTS = "courts.onnx"
_NO_DETECTORS = (*_SEGMENTER, _VERIFIER, _CHIPS, _SCENE_SCALE, _COURTS)
_BUNDLED = Path(__file__).parent / "bundled"


def bundled_models() -> dict[str, Path]:
    """List the bundled detectors: name to file."""
    files = sorted(_BUNDLED.glob("*.onnx"), key=lambda path: path.stem)
    return {path.stem: path for path in files if path.name not in _NO_DETECTORS}


def verifier_beside(detector: Path) -> Path | None:
    """Find the verifier of a detector; None without one.

    Args:
        detector: file of the detector. The default detector's verifier is bundled; any other's lies beside it, for
            example ``mine.verifier.onnx`` beside ``mine.onnx``.
    """
    return _beside(detector, _VERIFIER, "verifier")


def chips_beside(detector: Path) -> Path | None:
    """Find the chip network of a detector; None without one.

    Args:
        detector: file of the detector. The default detector's network is bundled; any other's lies beside it, for
            example ``mine.chips.onnx`` beside ``mine.onnx``.
    """
    return _beside(detector, _CHIPS, "chips")


def _beside(detector: Path, bundled: str, kind: str) -> Path | None:
    """Find a detector's auxiliary model; ``bundled`` names the default detector's."""
    path = detector.with_name(f"{detector.stem}.{kind}.onnx")
    if detector.resolve() == (_BUNDLED / f"{DEFAULT_DETECTOR}.onnx").resolve():
        path = _BUNDLED / bundled
    return path if path.is_file() else None


def bundled_scene_scale() -> Path | None:
    """Find the bundled scene-scale network; None if this installation has none."""
    path = _BUNDLED / _SCENE_SCALE
    return path if path.is_file() else None


def bundled_courts() -> Path | None:
    """Find the bundled court network; None if this installation has none."""
    path = _BUNDLED / _COURTS
    return path if path.is_file() else None


def bundled_segmenter() -> tuple[Path, Path] | None:
    """Find encoder and decoder of the bundled segmenter; None if this installation has none."""
    encoder, decoder = (_BUNDLED / name for name in _SEGMENTER)
    return (encoder, decoder) if encoder.is_file() and decoder.is_file() else None


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
            f"no model {name!r}: not a file, and not one of the bundled detectors ({', '.join(bundled) or 'none'})"
        )
    return path


def resolve_segmenter(files: tuple[str | Path, str | Path] | None = None) -> tuple[Path, Path]:
    """Find encoder and decoder of a segmenter by their paths; None gives the bundled one.

    Raises:
        ModelNotFoundError: a path is not a file, or no segmenter is bundled.
    """
    if files is None:
        bundled = bundled_segmenter()
        if bundled is None:
            raise ModelNotFoundError(
                f"this installation has no bundled segmenter in {_BUNDLED}; bring one, MobileSAM for example: export "
                "its encoder with samexporter ('python -m samexporter.export_encoder --checkpoint mobile_sam.pt "
                "--model-type mobile --use-preprocess --output encoder.onnx'), its decoder with MobileSAM's own script "
                "('python scripts/export_onnx_model.py --checkpoint mobile_sam.pt --model-type vit_t "
                "--output decoder.onnx'), "
                "and pass both: segmenter=('encoder.onnx', 'decoder.onnx') or --segmenter encoder.onnx decoder.onnx"
            )
        return bundled
    encoder, decoder = (Path(file) for file in files)
    for path in (encoder, decoder):
        if not path.is_file():
            raise ModelNotFoundError(f"no segmenter file at {str(path)!r}; pass the paths of its encoder and decoder")
    return encoder, decoder
