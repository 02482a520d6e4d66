"""Errors of VehAnchor.

* VehAnchorError
  x InvalidParameterError (ValueError)   ``invalid_parameter``
    - PromptError                        ``invalid_prompt``
    - KnownLengthError                   ``invalid_known_length``
  x FrameError (ValueError)              ``frame_mismatch``
  x ScaleMismatchError (ValueError)      ``scale_mismatch``
  x ImageError (ValueError)
    - ImageNotFoundError                 ``image_not_found``
    - ImageDecodeError                   ``image_undecodable``
    - ImageTooLargeError                 ``image_too_large``
    - ImageFormatError                   ``image_unsupported``
    - TooObliqueError                    ``too_oblique``
    - ImageListError                     ``images_unusable``
  x ReconstructionError (ValueError)     ``reconstruction_unusable``
  x ModelError
    - ModelNotFoundError                 ``model_not_found``
    - ModelContractError (ValueError)    ``model_contract``
    - ProviderUnavailableError           ``provider_unavailable``
  x CalibrationError
    - CalibrationFileError (ValueError)  ``calibration_unreadable``
    - CalibrationMismatchError (ValueError)  ``calibration_mismatch``
    - CalibrationRefusedError            ``calibration_refused``
  x MissingExtraError (ImportError)      ``missing_extra``
  x OutputError                          ``output_unwritable``
  x WorkerDiedError                      ``worker_died``
  x OutOfMemoryError (MemoryError)       ``out_of_memory``

``code`` is stable, so programs may match it. The message names the problem, the value and the
remedy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


class VehAnchorError(Exception):
    """Base of all errors of VehAnchor; ``code`` is a stable identifier."""

    code = "vehanchor_error"

    def __init_subclass__(cls, *, code: str | None = None) -> None:
        """Give a class of errors its code; without one, it has the code of its base."""
        cls.code = code or cls.code


class InvalidParameterError(VehAnchorError, ValueError, code="invalid_parameter"):
    """An option is invalid: negative, NaN, out of range, or an unknown name."""


class PromptError(InvalidParameterError, code="invalid_prompt"):
    """The box or points cannot select an object.

    They are outside the image, reversed, empty, not finite, missing, or both are given.
    """


class KnownLengthError(InvalidParameterError, code="invalid_known_length"):
    """The line of known length cannot be used.

    It is shorter than five pixels, outside the image, or has no length in metres.
    """


class FrameError(VehAnchorError, ValueError, code="frame_mismatch"):
    """The caller's frame and the image have different aspect ratios."""


class ScaleMismatchError(VehAnchorError, ValueError, code="scale_mismatch"):
    """The earlier scale belongs to another image."""


class ImageError(VehAnchorError, ValueError, code="image_error"):
    """The image cannot be used."""


class ImageNotFoundError(ImageError, code="image_not_found"):
    """There is no file at the path, or it is a folder, pipe, device or socket."""


class ImageDecodeError(ImageError, code="image_undecodable"):
    """The bytes are empty, truncated, or not an image."""


class ImageTooLargeError(ImageError, code="image_too_large"):
    """The file or its declared size exceeds the limits; the check precedes decoding."""


class ImageFormatError(ImageError, code="image_unsupported"):
    """The image decodes but cannot be measured.

    It is too small, has NaN values, or has an unsupported dtype or shape.
    """


class TooObliqueError(ImageError, code="too_oblique"):
    """The image is too oblique for a scale.

    The horizon is visible, or a measured place is too close to it.
    """


class ImageListError(ImageError, code="images_unusable"):
    """Images of a list cannot be used; the message names them.

    Attributes:
        results: for each image in order, its ``GsdEstimate`` or its ``VehAnchorError``.
    """

    def __init__(self, message: str, results: Sequence[object] = ()) -> None:
        super().__init__(message)
        self.results = tuple(results)


class ReconstructionError(VehAnchorError, ValueError, code="reconstruction_unusable"):
    """The reconstruction cannot be read or measured.

    Its format is unknown, a file is damaged, or it has too few points or no photographs.
    """


class ModelError(VehAnchorError, code="model_error"):
    """The model cannot be used."""


class ModelNotFoundError(ModelError, code="model_not_found"):
    """There is no model file at the path and no bundled model of that name."""


class ModelContractError(ModelError, ValueError, code="model_contract"):
    """The file is not a supported model; the message gives its layout and the expected one."""


class ProviderUnavailableError(ModelError, code="provider_unavailable"):
    """The installed ONNX Runtime lacks the requested execution provider."""


class CalibrationError(VehAnchorError, code="calibration_error"):
    """A reference length cannot be measured, or a calibration cannot be used."""


class CalibrationFileError(CalibrationError, ValueError, code="calibration_unreadable"):
    """There is no file at the path, or the file is not a calibration."""


class CalibrationMismatchError(CalibrationError, ValueError, code="calibration_mismatch"):
    """The calibration was made for another detector."""


class CalibrationRefusedError(CalibrationError, code="calibration_refused"):
    """The images do not support a reference length: too few vehicles, or imagery too coarse."""


class MissingExtraError(VehAnchorError, ImportError, code="missing_extra"):
    """An optional dependency is missing; the message names the extra to install."""


def how_to_install(extra: str) -> str:
    """Return the command that installs an extra; no package index has VehAnchor yet."""
    return f"pip install '.[{extra}]' in a clone of the repository"


class OutputError(VehAnchorError, code="output_unwritable"):
    """A file cannot be written.

    Its folder does not exist, its suffix is unknown, or the system refuses to write it.
    """


class WorkerDiedError(VehAnchorError, code="worker_died"):
    """A worker process of a batch run died: a decoder crashed, or memory was short.

    An image that ends its process twice has a row with this error. Finished rows are kept.
    """


class OutOfMemoryError(VehAnchorError, MemoryError, code="out_of_memory"):
    """The machine has too little free memory at the moment; the same input may succeed later."""
