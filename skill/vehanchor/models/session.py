"""Opening an ONNX file with ONNX Runtime, every failure as an error of ours.

The official builds of ONNX Runtime report their use to its makers unless the environment says no before the first
import. What a planner looks at is nobody's business: this module says no, unless the user has decided otherwise.
"""

from __future__ import annotations

import logging
import math
import os
import re
from concurrent.futures import CancelledError
from functools import cache
from typing import TYPE_CHECKING, Any

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

import onnxruntime

from vehanchor.errors import ModelContractError, OutOfMemoryError, ProviderUnavailableError, VehAnchorError
from vehanchor.models.files import external_locations
from vehanchor.models.runtime import Runtime

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

_SHORT_NAMES = {  # what people say
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
    "directml": "DmlExecutionProvider",
    "rocm": "ROCMExecutionProvider",
}
_SMALL_BYTES = 32 << 20  # of a file: bundled ones and YOLO11n's have some 10 MB, encoders of SAM hundreds
_AS_REQUESTED = 1  # ONNX Runtime's ``ArenaExtendStrategy``: an arena grows by what is asked for, not by powers of two
_logger = logging.getLogger(__name__)

_WANT_OF_MEMORY = re.compile("bad.?alloc|failed to allocate|out of memory", re.IGNORECASE)


def open_session(
    path: Path, *, content: bytes | None = None, runtime: Runtime | None = None
) -> onnxruntime.InferenceSession:
    """Open a model.

    Args:
        path: of the file.
        content: the file's bytes where they are read already: then these are what is run, unless the graph keeps
            weights in files beside it, which ONNX Runtime finds by the path alone.
        runtime: threads and execution providers; None for the defaults.

    Returns:
        The session.

    Raises:
        ModelContractError: ONNX Runtime cannot load it.
        ProviderUnavailableError: an execution provider is not installed, and the CPU was not named beside it.
        OutOfMemoryError: there is too little memory for it now.
    """
    chosen = runtime or Runtime()
    wanted = _installed(chosen.providers)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # fatal only: a broken file is reported by our own error
    if chosen.threads is not None:
        options.intra_op_num_threads = chosen.threads
        options.inter_op_num_threads = 1
    model = str(path) if content is None or external_locations(content) else content
    if isinstance(model, bytes) and len(model) <= _SMALL_BYTES:
        _share_arena()
        options.add_session_config_entry("session.use_env_allocators", "1")
        options.enable_mem_pattern = False  # a block for each shape of input, and tiles have many
    else:
        options.enable_cpu_mem_arena = False  # it would keep what the largest run took, for good
    try:
        session = onnxruntime.InferenceSession(model, options, providers=wanted)
    except Exception as error:  # ONNX Runtime's own exception types are private
        raise _as_ours(error, f"{path} is not an ONNX model that ONNX Runtime can load") from None
    if wanted[0] not in session.get_providers():  # ONNX Runtime goes on with the CPU, and says nothing
        _tell_once(f"{wanted[0]} cannot start here: models run on {session.get_providers()[0]}")
    return session


@cache
def _share_arena() -> None:
    """Give the small models of this process one arena: each takes it in turn, and together they keep what one needs.

    Without any, runs ask the system for every layer's memory anew and leave twice as much behind; with one for each
    model, as ONNX Runtime has it by default, all keep their own (``research/results/server.json``, ``arena``).
    """
    memory = onnxruntime.OrtMemoryInfo(
        "Cpu", onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR, 0, onnxruntime.OrtMemType.DEFAULT
    )
    arena = onnxruntime.OrtArenaCfg({"arena_extend_strategy": _AS_REQUESTED})
    try:
        onnxruntime.create_and_register_allocator(memory, arena)
    except RuntimeError:  # somebody else in this process has: then that one is shared
        _logger.debug("ONNX Runtime has a shared arena already")


def _installed(providers: Sequence[str]) -> list[str]:
    """Full names of those that this build of ONNX Runtime has.

    Raises:
        ProviderUnavailableError: one is missing, and the CPU is not named beside it.
    """
    available = onnxruntime.get_available_providers()
    wanted = [_SHORT_NAMES.get(name.strip().lower(), name.strip()) for name in providers]
    missing = [name for name in wanted if name not in available]
    if missing and "CPUExecutionProvider" not in wanted:
        raise ProviderUnavailableError(
            f"ONNX Runtime has no {missing[0]} here; it has {', '.join(available)}. Install the matching onnxruntime "
            "build, or name cpu beside it to fall back"
        )
    if missing:
        _tell_once(f"ONNX Runtime has no {', '.join(missing)} here: models run without")
    return [name for name in wanted if name in available]


@cache
def _tell_once(text: str) -> None:
    """Warn in the log: there are several models, and one warning is enough."""
    _logger.warning(text)


def run_session(
    session: onnxruntime.InferenceSession,
    outputs: Sequence[str] | None,
    feeds: Mapping[str, NDArray[Any]],
    runtime: Runtime,
    described: str,
) -> list[Any]:
    """Run a model.

    Args:
        session: the model.
        outputs: names of the outputs wanted; None for all.
        feeds: inputs by name.
        runtime: its cancellation ends the run.
        described: subject and verb of the error message if the run fails.

    Returns:
        The outputs, in their order.

    Raises:
        ModelContractError: the model fails.
        OutOfMemoryError: there is too little memory for it now.
        CancelledError: the call was cancelled (``concurrent.futures``).
    """
    cancellation = runtime.cancellation
    try:
        results: list[Any] = session.run(outputs, feeds, None if cancellation is None else cancellation.run_options)
    except Exception as error:  # ONNX Runtime's own exception types are private
        if cancellation is not None and cancellation.requested:
            raise CancelledError("the call was cancelled") from error
        raise _as_ours(error, described) from None
    return results


def _as_ours(error: Exception, described: str) -> VehAnchorError:
    """What ONNX Runtime raises, as an error of ours."""
    if isinstance(error, MemoryError) or _WANT_OF_MEMORY.search(str(error)):
        return OutOfMemoryError(f"{described}: {error}. Try again when less is running, or with smaller tiles")
    return ModelContractError(f"{described}: {error}")


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
