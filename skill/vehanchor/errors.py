"""Errors of VehAnchor.

* VehAnchorError
  x InvalidParameterError (ValueError)   ``invalid_parameter``  an invalid option: negative, NaN, unknown
    - PromptError                        ``invalid_prompt``     a box or point that cannot select an object
    - KnownLengthError                   ``invalid_known_length``  a line too short to use, or outside the image
  x FrameError (ValueError)              ``frame_mismatch``     the frame has another aspect ratio than the image
  x ScaleMismatchError (ValueError)      ``scale_mismatch``     an earlier scale belongs to another image
  x ImageError (ValueError)
    - ImageNotFoundError                 ``image_not_found``    no file there, or it is a directory
    - ImageDecodeError                   ``image_undecodable``  empty, truncated, or not an image at all
    - ImageTooLargeError                 ``image_too_large``    more bytes or declared pixels than the limits allow
    - ImageFormatError                   ``image_unsupported``  decodable, not measurable: 1 x 1 px, NaN, wrong dtype
    - TooObliqueError                    ``too_oblique``        the horizon is in the image or close: no scale holds
    - ImageListError                     ``images_unusable``    images of a list failed; it holds the others' results
  x ReconstructionError (ValueError)     ``reconstruction_unusable``  no reconstruction, damaged, or without ground
  x ModelError
    - ModelNotFoundError                 ``model_not_found``    no such file, and no model of that name
    - ModelContractError (ValueError)    ``model_contract``     not ONNX, or not a model this code can read
    - ProviderUnavailableError           ``provider_unavailable``  ONNX Runtime lacks the execution provider
  x CalibrationError
    - CalibrationFileError (ValueError)  ``calibration_unreadable``  no such file, or not a calibration
    - CalibrationMismatchError (ValueError)  ``calibration_mismatch``  made for another detector
    - CalibrationRefusedError            ``calibration_refused``  too few vehicles, or imagery too coarse
  x MissingExtraError (ImportError)      ``missing_extra``      an optional dependency is not installed
  x OutputError                          ``output_unwritable``  a result cannot be written: no folder, odd suffix
  x WorkerDiedError                      ``worker_died``        a process of a batch run was killed
  x OutOfMemoryError (MemoryError)       ``out_of_memory``      this machine has too little free memory now

``code`` is stable, so programs may match it. The message names the problem, the value and the remedy.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


class VehAnchorError(Exception):
    """Base of all errors of VehAnchor; ``code`` is a stable identifier."""

    code = "vehanchor_error"


class InvalidParameterError(VehAnchorError, ValueError):
    """An option is invalid: negative, NaN, out of range, or an unknown name."""

    code = "invalid_parameter"


class PromptError(InvalidParameterError):
    """The box or points cannot select an object: outside the image, reversed, empty, not finite, missing, or both."""

    code = "invalid_prompt"


class KnownLengthError(InvalidParameterError):
    """The line of known length cannot be used: under five pixels, outside the image, or without length."""

    code = "invalid_known_length"


class FrameError(VehAnchorError, ValueError):
    """The caller's frame has another aspect ratio than the image."""

    code = "frame_mismatch"


class ScaleMismatchError(VehAnchorError, ValueError):
    """The earlier scale belongs to another image."""

    code = "scale_mismatch"


class ImageError(VehAnchorError, ValueError):
    """The image cannot be used."""

    code = "image_error"


class ImageNotFoundError(ImageError):
    """There is no file at the path, or it is not a regular file."""

    code = "image_not_found"


class ImageDecodeError(ImageError):
    """The bytes are empty, truncated, or not an image."""

    code = "image_undecodable"


class ImageTooLargeError(ImageError):
    """The file or its declared size exceeds the limits; the check precedes decoding."""

    code = "image_too_large"


class ImageFormatError(ImageError):
    """The image decodes but cannot be measured: a single pixel, NaN values, an unsupported dtype or shape."""

    code = "image_unsupported"


class TooObliqueError(ImageError):
    """The image is too oblique for a scale: the horizon is visible, or a measured place is too close to it."""

    code = "too_oblique"


class ImageListError(ImageError):
    """Images of a list cannot be used; the message names them.

    Attributes:
        results: for each image in order, its ``GsdEstimate`` or its ``VehAnchorError``.
    """

    code = "images_unusable"

    def __init__(self, message: str, results: Sequence[object] = ()) -> None:
        super().__init__(message)
        self.results = tuple(results)


class ReconstructionError(VehAnchorError, ValueError):
    """The reconstruction cannot be read or measured: unknown format, damaged file, too few points, no photographs."""

    code = "reconstruction_unusable"


class ModelError(VehAnchorError):
    """The model cannot be used."""

    code = "model_error"


class ModelNotFoundError(ModelError):
    """There is no model file at the path, and no bundled model of that name."""

    code = "model_not_found"


class ModelContractError(ModelError, ValueError):
    """The file is not a supported model; the message gives its layout and the expected one."""

    code = "model_contract"


class ProviderUnavailableError(ModelError):
    """The installed ONNX Runtime lacks the requested execution provider."""

    code = "provider_unavailable"


class CalibrationError(VehAnchorError):
    """A reference length cannot be measured, or a calibration cannot be used."""

    code = "calibration_error"


class CalibrationFileError(CalibrationError, ValueError):
    """There is no file at the path, or it is not a calibration."""

    code = "calibration_unreadable"


class CalibrationMismatchError(CalibrationError, ValueError):
    """The calibration was made for another detector."""

    code = "calibration_mismatch"


class CalibrationRefusedError(CalibrationError):
    """The images do not support a reference length: too few vehicles, or imagery too coarse."""

    code = "calibration_refused"


class MissingExtraError(VehAnchorError, ImportError):
    """An optional dependency is missing; the message names the extra to install."""

    code = "missing_extra"


class OutputError(VehAnchorError):
    """A file cannot be written: its folder does not exist, its suffix is unknown, or the disk refuses."""

    code = "output_unwritable"


class WorkerDiedError(VehAnchorError):
    """A worker process of a batch run was killed, usually for lack of memory; finished rows are kept."""

    code = "worker_died"


class OutOfMemoryError(VehAnchorError, MemoryError):
    """The machine has too little free memory now; the same input may succeed later."""

    code = "out_of_memory"
