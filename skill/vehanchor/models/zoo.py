"""Which models ship with VehAnchor and where they are."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.errors import ModelNotFoundError
from vehanchor.models.precision import has_byte_dot_products

if TYPE_CHECKING:
    from vehanchor.models.precision import Precision

__all__ = [
    "DEFAULT_DETECTOR",
    "bundled_car_verifier",
    "bundled_courts",
    "bundled_models",
    "bundled_scene_scale",
    "bundled_segmenter",
    "fleet_beside",
    "resolve_model",
    "resolve_segmenter",
    "second_look_beside",
]

DEFAULT_DETECTOR = "vehicles"
_IN_EIGHT_BITS = "-int8"  # ends the name of a bundled detector's file of that precision
_SEGMENTER = "segmenter-encoder.onnx", "segmenter-decoder.onnx"
_FLEET = "fleet.onnx"  # of the default detector
_SECOND_LOOK = "second-look.onnx"  # of the default detector
_SECOND_LOOK_IN_EIGHT_BITS = "second-look-int8.onnx"  # of the same in eight bits
_SCENE_SCALE = "scene-scale.onnx"
_COURTS = "courts.onnx"
_CAR_VERIFIER = "car-verifier.onnx"
_NO_DETECTORS = (*_SEGMENTER, _FLEET, _SECOND_LOOK, _SECOND_LOOK_IN_EIGHT_BITS, _SCENE_SCALE, _COURTS, _CAR_VERIFIER)
_BUNDLED = Path(__file__).parent / "bundled"


def bundled_models() -> dict[str, Path]:
    """Names of the bundled detectors and their files."""
    files = sorted(_BUNDLED.glob("*.onnx"), key=lambda path: path.stem)
    return {path.stem: path for path in files if path.name not in _NO_DETECTORS}


def fleet_beside(detector: Path) -> Path | None:
    """The file of the network that tells fleets apart for a detector; None where it has none.

    Args:
        detector: its file. The default detector's network is bundled with it; any other's lies beside it, as
            ``mine.fleet.onnx`` beside ``mine.onnx``.
    """
    return _beside(detector, (_FLEET, _FLEET), "fleet")


def second_look_beside(detector: Path) -> Path | None:
    """The file of the network that judges a detector's candidates once more; None where it has none.

    Args:
        detector: its file. The default detector's network is bundled with it; any other's lies beside it, as
            ``mine.second-look.onnx`` beside ``mine.onnx``.
    """
    return _beside(detector, (_SECOND_LOOK, _SECOND_LOOK_IN_EIGHT_BITS), "second-look")


def _beside(detector: Path, bundled: tuple[str, str], kind: str) -> Path | None:
    """The file beside a detector; ``bundled`` are the default one's, and those of the same in eight bits."""
    path = detector.with_name(f"{detector.stem}.{kind}.onnx")
    for name, ending in zip(bundled, ("", _IN_EIGHT_BITS), strict=True):
        if detector.resolve() == (_BUNDLED / f"{DEFAULT_DETECTOR}{ending}.onnx").resolve():
            path = _BUNDLED / name
    return path if path.is_file() else None


def bundled_scene_scale() -> Path | None:
    """The file of the network that tells a scene's scale; None where this installation has none."""
    path = _BUNDLED / _SCENE_SCALE
    return path if path.is_file() else None


def bundled_car_verifier() -> Path | None:
    """The file of the network that verifies candidates where few were found; None where this installation has none."""
    path = _BUNDLED / _CAR_VERIFIER
    return path if path.is_file() else None


def bundled_courts() -> Path | None:
    """The file of the network that looks for sports courts; None where this installation has none."""
    path = _BUNDLED / _COURTS
    return path if path.is_file() else None


def bundled_segmenter() -> tuple[Path, Path] | None:
    """Encoder and decoder of the bundled segmenter, None where this installation has none."""
    encoder, decoder = (_BUNDLED / name for name in _SEGMENTER)
    return (encoder, decoder) if encoder.is_file() and decoder.is_file() else None


def resolve_model(model: str | Path | None = None, precision: Precision | None = None) -> Path:
    """The file of a model given by its bundled name or by its path; the default detector for None.

    Args:
        model: name or path.
        precision: of the numbers that it computes with: ``int8`` takes the file in eight bits that is bundled beside
            the one named, ``auto`` does where the processor is quick with it; else it is the one named.

    Raises:
        ModelNotFoundError: neither a bundled name nor a file; or none of that precision.
    """
    bundled = bundled_models()
    name = DEFAULT_DETECTOR if model is None else str(model)
    if precision == "int8" and not name.endswith(_IN_EIGHT_BITS) and name + _IN_EIGHT_BITS not in bundled:
        raise ModelNotFoundError(f"no file of {name!r} in int8 is bundled: leave the precision to the file")
    if precision == "int8" or (precision == "auto" and name + _IN_EIGHT_BITS in bundled and has_byte_dot_products()):
        name = name.removesuffix(_IN_EIGHT_BITS) + _IN_EIGHT_BITS
    if name in bundled:
        return bundled[name]
    path = Path(name)
    if not path.is_file():
        raise ModelNotFoundError(
            f"no model {name!r}: not a file, and not one of the bundled detectors ({', '.join(bundled) or 'none'})"
        )
    return path


def resolve_segmenter(files: tuple[str | Path, str | Path] | None = None) -> tuple[Path, Path]:
    """Encoder and decoder of a segmenter given by their paths; the bundled one for None.

    Raises:
        ModelNotFoundError: a path is no file, or no segmenter is bundled.
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
