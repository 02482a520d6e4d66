"""Bundled models and their files."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from vehanchor.errors import ModelNotFoundError

if TYPE_CHECKING:
    from vehanchor.models.runtime import Runtime

DEFAULT_DETECTOR = "vehicles"
_BUNDLED = Path(__file__).parent / "bundled"


@dataclass(frozen=True, kw_only=True)
class BundledModel:
    """Model that is part of the package.

    Attributes:
        name: name of the model.
        file: name of its file in the folder of bundled models.
        role: what loads it. A detector loads its ``auxiliary`` models, and a segmenter its two
            files; a network of a ``ruler`` is loaded by itself.
        loader: function that loads the network of a ruler for a ``Runtime``, as
            ``module:function``; None for the other roles.
    """

    name: str
    file: str
    role: Literal["detector", "auxiliary", "ruler", "segmenter"]
    loader: str | None = None

    @property
    def path(self) -> Path:
        """Path of the file."""
        return _BUNDLED / self.file

    def load(self, runtime: Runtime) -> None:
        """Load the network of a ruler; the module of its loader is imported only now."""
        assert self.loader is not None
        module, function = self.loader.split(":")
        load = getattr(importlib.import_module(module), function)
        load(runtime)


BUNDLED_MODELS = (
    BundledModel(name=DEFAULT_DETECTOR, file="vehicles.onnx", role="detector"),
    BundledModel(name="verifier", file="verifier.onnx", role="auxiliary"),
    BundledModel(name="chips", file="chips.onnx", role="auxiliary"),
    BundledModel(
        name="scene-scale",
        file="scene-scale.onnx",
        role="ruler",
        loader="vehanchor.detection.scene_scale:load_scene_scale",
    ),
    BundledModel(
        name="courts",
        file="courts.onnx",
        role="ruler",
        loader="vehanchor.courts.network:load_court_network",
    ),
    BundledModel(name="segmenter-encoder", file="segmenter-encoder.onnx", role="segmenter"),
    BundledModel(name="segmenter-decoder", file="segmenter-decoder.onnx", role="segmenter"),
)
"""All bundled models, in the order of ``vehanchor.detection.detector.networks_sha256``.

An engine loads them, journals depend on them, and a server's workers may read them.
"""


def load_ruler_networks(runtime: Runtime) -> None:
    """Load the networks of rulers before their first use.

    Raises:
        ModelError: a model cannot be used.
    """
    for model in BUNDLED_MODELS:
        if model.loader is not None:
            model.load(runtime)


def bundled_file(name: str) -> Path:
    """Return the file of a bundled model by the model's name."""
    files = {model.name: model.path for model in BUNDLED_MODELS}
    return files[name]


def bundled_models() -> dict[str, Path]:
    """List the bundled detectors: name to file; a file of no other role is a detector."""
    other_files = {model.file for model in BUNDLED_MODELS if model.role != "detector"}
    files = sorted(_BUNDLED.glob("*.onnx"), key=lambda path: path.stem)
    return {path.stem: path for path in files if path.name not in other_files}


def auxiliary_model(detector: Path, kind: str) -> Path | None:
    """Find the verifier or the chip network of a detector; None without one.

    Args:
        detector: file of the detector. The default detector's models are bundled; any other's lie
            beside it, for example ``mine.verifier.onnx`` beside ``mine.onnx``.
        kind: name of the bundled auxiliary model of this kind: ``verifier`` or ``chips``.
    """
    path = detector.with_name(f"{detector.stem}.{kind}.onnx")
    if _is_default(detector):
        path = bundled_file(kind)
    if not path.is_file():
        return None
    return path


def errors_file(detector: Path) -> Path | None:
    """Find the file of a detector's errors, ``<stem>.errors.toml`` beside it; None without one."""
    if _is_default(detector):
        # A link to the default detector has its errors, too.
        detector = bundled_file(DEFAULT_DETECTOR)
    path = detector.with_name(f"{detector.stem}.errors.toml")
    if not path.is_file():
        return None
    return path


def _is_default(detector: Path) -> bool:
    """Test whether a path leads to the default detector."""
    return detector.resolve() == bundled_file(DEFAULT_DETECTOR).resolve()


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
        return bundled_file("segmenter-encoder"), bundled_file("segmenter-decoder")
    encoder_file, decoder_file = files
    encoder = Path(encoder_file)
    decoder = Path(decoder_file)
    for path in (encoder, decoder):
        if not path.is_file():
            raise ModelNotFoundError(
                f"no segmenter file at {str(path)!r}; pass the paths of its encoder and decoder"
            )
    return encoder, decoder
