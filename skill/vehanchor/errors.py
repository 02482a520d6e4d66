"""Every error that VehAnchor raises on purpose.

* VehAnchorError
  x InvalidParameterError (ValueError)   ``invalid_parameter``  an option without meaning: negative, NaN, unknown
    - PromptError                        ``invalid_prompt``     a box or point that names nothing in the image
    - KnownLengthError                   ``invalid_known_length``  a line too short to measure by, or outside
  x FrameError (ValueError)              ``frame_mismatch``     the frame has another aspect ratio than the image
  x ScaleMismatchError (ValueError)      ``scale_mismatch``     the scale given back was measured on another image
  x ImageError (ValueError)
    - ImageNotFoundError                 ``image_not_found``    no file there, or it is a directory
    - ImageDecodeError                   ``image_undecodable``  empty, truncated, or not an image at all
    - ImageTooLargeError                 ``image_too_large``    more bytes or declared pixels than the limits allow
    - ImageFormatError                   ``image_unsupported``  decodable, not measurable: 1 x 1 px, NaN, odd dtype
    - TooObliqueError                    ``too_oblique``        the horizon is in sight, or nearly so: no scale holds
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
  x OutOfMemoryError (MemoryError)       ``out_of_memory``      this machine has too little memory left just now

``code`` is stable: programs may match on it. The message says what was wrong, with the value, and what to do.
"""

from __future__ import annotations


class VehAnchorError(Exception):
    """Base of all errors raised on purpose; ``code`` is a stable identifier."""

    code = "vehanchor_error"


class InvalidParameterError(VehAnchorError, ValueError):
    """An option has no meaning: negative, NaN, out of range, or an unknown name."""

    code = "invalid_parameter"


class PromptError(InvalidParameterError):
    """The box or points cannot name an object: outside the image, reversed, empty, not finite, none or both given."""

    code = "invalid_prompt"


class KnownLengthError(InvalidParameterError):
    """The line of known length cannot be measured by: under five pixels, outside the image, or of no length."""

    code = "invalid_known_length"


class FrameError(VehAnchorError, ValueError):
    """The caller's frame has another aspect ratio than the image."""

    code = "frame_mismatch"


class ScaleMismatchError(VehAnchorError, ValueError):
    """The scale that was given back was measured on another image."""

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
    """The file or its declared size is beyond the limits, found out before decoding."""

    code = "image_too_large"


class ImageFormatError(ImageError):
    """The image decodes but cannot be measured: a single pixel, NaN values, an unsupported dtype or shape."""

    code = "image_unsupported"


class TooObliqueError(ImageError):
    """The camera looked so far aside that no scale holds: the horizon is in sight, or a place is too near to it."""

    code = "too_oblique"


class ModelError(VehAnchorError):
    """The model cannot be used."""

    code = "model_error"


class ModelNotFoundError(ModelError):
    """There is no model file at the path, and no bundled model of that name."""

    code = "model_not_found"


class ModelContractError(ModelError, ValueError):
    """The file is not a model of a kind this code reads; the message says what was found and what is expected."""

    code = "model_contract"


class ProviderUnavailableError(ModelError):
    """The installed ONNX Runtime does not have the execution provider asked for."""

    code = "provider_unavailable"


class CalibrationError(VehAnchorError):
    """A reference length cannot be measured, or a measured one cannot be used."""

    code = "calibration_error"


class CalibrationFileError(CalibrationError, ValueError):
    """There is no calibration file at the path, or it is not one."""

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
    """A worker process of a batch run was killed, for want of memory as a rule; the rows so far are kept."""

    code = "worker_died"


class OutOfMemoryError(VehAnchorError, MemoryError):
    """There is too little memory left just now: nothing need be wrong with what was given, a later try may succeed."""

    code = "out_of_memory"
