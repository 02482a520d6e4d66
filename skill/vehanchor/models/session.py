"""Opening an ONNX file with ONNX Runtime, every failure as an error of ours.

The official builds of ONNX Runtime report their use to its makers unless the environment says no before the first
import. What a planner looks at is nobody's business: this module says no, unless the user has decided otherwise.
"""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

import onnxruntime

from vehanchor.errors import InvalidParameterError, ModelContractError, ProviderUnavailableError
from vehanchor.models.files import external_locations

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

__all__ = ["DEFAULT_PROVIDERS", "metadata_number", "open_session", "stoppable"]

DEFAULT_PROVIDERS = ("CPUExecutionProvider",)


def stoppable() -> onnxruntime.RunOptions:
    """Options for runs that another thread can end: it sets their ``terminate``."""
    return onnxruntime.RunOptions()


def open_session(
    path: Path,
    *,
    content: bytes | None = None,
    threads: int | None = None,
    providers: Sequence[str] = DEFAULT_PROVIDERS,
) -> onnxruntime.InferenceSession:
    """Open a model.

    Args:
        path: of the file.
        content: the file's bytes where they are read already: then these are what is run, unless the graph keeps
            weights in files beside it, which ONNX Runtime finds by the path alone.
        threads: CPU threads; None leaves it to ONNX Runtime.
        providers: execution providers in order of preference.

    Returns:
        The session.

    Raises:
        ModelContractError: ONNX Runtime cannot load it.
        ProviderUnavailableError: an execution provider is not installed.
        InvalidParameterError: bad ``threads``.
    """
    available = onnxruntime.get_available_providers()
    missing = [name for name in providers if name not in available]
    if missing:
        raise ProviderUnavailableError(
            f"ONNX Runtime has no {missing[0]} here; it has {', '.join(available)}. Install the matching "
            "onnxruntime build"
        )
    if threads is not None and (threads < 1 or threads != int(threads)):
        raise InvalidParameterError(f"threads is {threads}: use a whole number >= 1, or None for all cores")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # fatal only: a broken file is reported by our own error
    if threads is not None:
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
    by_path = content is None or external_locations(content)
    try:
        return onnxruntime.InferenceSession(str(path) if by_path else content, options, providers=list(providers))
    except Exception as error:  # ONNX Runtime's own exception types are private
        raise ModelContractError(f"{path} is not an ONNX model that ONNX Runtime can load: {error}") from None


def metadata_number(metadata: Mapping[str, str], key: str, default: float) -> float:
    """A number that a model's file states under ``vehanchor.<key>``.

    Raises:
        ModelContractError: it is not a finite number >= 0.
    """
    text = metadata.get(f"vehanchor.{key}")
    if text is None:
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or value < 0:
        raise ModelContractError(f"metadata vehanchor.{key} is {text!r}: expected a finite number >= 0")
    return value
