"""Which models ship with VehAnchor and where they are."""

from __future__ import annotations

from pathlib import Path

from vehanchor.errors import ModelNotFoundError

__all__ = ["DEFAULT_DETECTOR", "bundled_models", "resolve_model"]

DEFAULT_DETECTOR = "vehicles"
_BUNDLED = Path(__file__).parent / "bundled"


def bundled_models() -> dict[str, Path]:
    """Names of the bundled models and their files."""
    return {path.stem: path for path in sorted(_BUNDLED.glob("*.onnx"))}


def resolve_model(model: str | Path | None = None) -> Path:
    """The file of a model given by its bundled name or by its path; the default detector for None.

    Raises:
        ModelNotFoundError: neither a bundled name nor a file.
    """
    bundled = bundled_models()
    name = DEFAULT_DETECTOR if model is None else str(model)
    if name in bundled:
        return bundled[name]
    path = Path(name)
    if not path.is_file():
        raise ModelNotFoundError(
            f"no model {name!r}: not a file, and not one of the bundled models ({', '.join(bundled) or 'none'})"
        )
    return path
