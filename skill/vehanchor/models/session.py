"""ONNX Runtime sessions, with all failures as errors of this package.

The official builds of ONNX Runtime send telemetry unless an environment variable disables it before
the first import. This module disables it, unless the user has set the variable.
"""

from __future__ import annotations

import logging
import math
import os
import re
from concurrent.futures import CancelledError
from functools import cache
from typing import TYPE_CHECKING, Any, TypeAlias

os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

import onnxruntime

from vehanchor.errors import (
    ModelContractError,
    OutOfMemoryError,
    ProviderUnavailableError,
    VehAnchorError,
)
from vehanchor.models.files import external_locations
from vehanchor.models.runtime import Runtime

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

Session: TypeAlias = onnxruntime.InferenceSession
"""An open model; other modules name no runtime."""

_CPU = "CPUExecutionProvider"
_SHORT_NAMES = {
    "cpu": _CPU,
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
    "directml": "DmlExecutionProvider",
    "rocm": "ROCMExecutionProvider",
}
# Largest file of a small model: bundled models and YOLO11n have 10 MB, SAM's encoders hundreds.
_SMALL_BYTES = 32 << 20
# ONNX Runtime's ``ArenaExtendStrategy``: the arena grows by the requested size, not by powers of
# two.
_AS_REQUESTED = 1
# ONNX Runtime's level of messages at which it reports fatal errors only.
_FATAL_ONLY = 4
_logger = logging.getLogger(__name__)

_OUT_OF_MEMORY = re.compile("bad.?alloc|failed to allocate|out of memory", re.IGNORECASE)


def open_session(
    path: Path, *, content: bytes | None = None, runtime: Runtime | None = None
) -> Session:
    """Open a model.

    Args:
        path: path of the file.
        content: bytes of the file, which are run instead of the file. For a graph with external
            weights the path is used, because ONNX Runtime finds the weights by it.
        runtime: threads and execution providers; None for the defaults.

    Returns:
        The session.

    Raises:
        ModelContractError: ONNX Runtime cannot load the model.
        ProviderUnavailableError: an execution provider is not installed, and ``cpu`` is not among
            the providers.
        OutOfMemoryError: there is too little memory for it now.
    """
    runtime = runtime or Runtime()
    providers = _installed(runtime.providers)
    model: str | bytes = str(path)
    if content is not None and not external_locations(content):
        model = content
    options = _session_options(model, runtime)
    try:
        session = onnxruntime.InferenceSession(model, options, providers=providers)
    # ONNX Runtime's own exception types are private.
    except Exception as error:
        raise _converted(error, f"{path} is not an ONNX model that ONNX Runtime can load") from None
    # ONNX Runtime silently falls back to the CPU.
    if providers[0] not in session.get_providers():
        _warn_once(f"{providers[0]} cannot start here: models run on {session.get_providers()[0]}")
    if session.get_providers() == [_CPU]:
        _release_file(session)
    return session


def _release_file(session: Session) -> None:
    """Release the bytes of the file, which ONNX Runtime keeps to fall back on other providers.

    The attribute is private; ``tests/skill/models/test_session.py`` tells what to do when it
    changes.
    """
    session.disable_fallback()
    session._model_bytes = None


def check_tensors(session: Session, path: Path, *, input_name: str, output_name: str) -> None:
    """Check that a model has one input and one output of these names.

    Args:
        session: the open model.
        path: path of its file, for the error.
        input_name: name of the input.
        output_name: name of the output.

    Raises:
        ModelContractError: it has others.
    """
    names = [tensor.name for tensor in (*session.get_inputs(), *session.get_outputs())]
    if names != [input_name, output_name]:
        raise ModelContractError(
            f"{path} has {', '.join(names)}: expected the input {input_name} and the output "
            f"{output_name}"
        )


def _session_options(model: str | bytes, runtime: Runtime) -> onnxruntime.SessionOptions:
    """Choose the options of a session: threads, messages and memory.

    Args:
        model: path of the file, or its bytes.
        runtime: how to open it.
    """
    options = onnxruntime.SessionOptions()
    # A broken file raises an error of this package, so ONNX Runtime need not report it.
    options.log_severity_level = _FATAL_ONLY
    # Otherwise threads spin on after each run.
    options.add_session_config_entry("session.force_spinning_stop", "1")
    if runtime.threads is not None:
        options.intra_op_num_threads = runtime.threads
        options.inter_op_num_threads = 1
    if isinstance(model, bytes) and len(model) <= _SMALL_BYTES:
        _share_arena()
        options.add_session_config_entry("session.use_env_allocators", "1")
        # A pattern keeps a block for every shape of the input, and tiles have many shapes.
        options.enable_mem_pattern = False
    else:
        # An arena never releases the memory of the largest run.
        options.enable_cpu_mem_arena = False
    return options


@cache
def _share_arena() -> None:
    """Share one memory arena between the small models of this process.

    They then keep as much memory as the largest of them needs. Without an arena, runs allocate
    every layer's memory again and leave twice as much behind. With one arena per model, ONNX
    Runtime's default, each model keeps its own (``research/results/notes.md``).
    """
    memory = onnxruntime.OrtMemoryInfo(
        "Cpu",
        onnxruntime.OrtAllocatorType.ORT_ARENA_ALLOCATOR,
        0,
        onnxruntime.OrtMemType.DEFAULT,
    )
    arena = onnxruntime.OrtArenaCfg({"arena_extend_strategy": _AS_REQUESTED})
    try:
        onnxruntime.create_and_register_allocator(memory, arena)
    # Another library in this process has registered one, which is shared then.
    except RuntimeError:
        _logger.debug("ONNX Runtime has a shared arena already")


def _installed(providers: Sequence[str]) -> list[str]:
    """List the full names of the wanted providers that this build of ONNX Runtime has.

    Raises:
        ProviderUnavailableError: one is missing, and ``cpu`` is not among them.
    """
    available = onnxruntime.get_available_providers()
    names = [name.strip() for name in providers]
    wanted = [_SHORT_NAMES.get(name.lower(), name) for name in names]
    missing = [name for name in wanted if name not in available]
    if missing and _CPU not in wanted:
        raise ProviderUnavailableError(
            f"ONNX Runtime has no {missing[0]} here; it has {', '.join(available)}. Install the "
            "matching onnxruntime build, or add cpu to the providers as a fallback"
        )
    if missing:
        _warn_once(f"ONNX Runtime has no {', '.join(missing)} here: models run without")
    return [name for name in wanted if name in available]


@cache
def _warn_once(text: str) -> None:
    """Log a warning once, although several models cause it."""
    _logger.warning(text)


def run_session(
    session: Session,
    outputs: Sequence[str] | None,
    feeds: Mapping[str, NDArray[Any]],
    runtime: Runtime,
    described: str,
) -> list[Any]:
    """Run a model.

    Args:
        session: the model.
        outputs: names of the outputs; None for all.
        feeds: inputs by name.
        runtime: runtime of the call; its cancellation ends the run.
        described: subject and verb of the error message if the run fails.

    Returns:
        The outputs, in the order of ``outputs``.

    Raises:
        ModelContractError: the model fails.
        OutOfMemoryError: there is too little memory for it now.
        CancelledError: the call was cancelled (``concurrent.futures``).
    """
    cancellation = runtime.cancellation
    run_options = None
    if cancellation is not None:
        run_options = cancellation.run_options
    try:
        results: list[Any] = session.run(outputs, feeds, run_options)
    # ONNX Runtime's own exception types are private.
    except Exception as error:
        if cancellation is not None and cancellation.requested:
            raise CancelledError("the call was cancelled") from error
        raise _converted(error, described) from None
    return results


def _converted(error: Exception, described: str) -> VehAnchorError:
    """Convert an exception of ONNX Runtime to an error of this package."""
    if isinstance(error, MemoryError) or _OUT_OF_MEMORY.search(str(error)):
        return OutOfMemoryError(
            f"{described}: {error}. Try again when more memory is free, or use smaller tiles"
        )
    return ModelContractError(f"{described}: {error}")


def metadata_number(metadata: Mapping[str, str], key: str, default: float) -> float:
    """Read a number from a model's metadata, key ``vehanchor.<key>``.

    Raises:
        ModelContractError: the entry is not a finite number >= 0.
    """
    text = metadata.get(f"vehanchor.{key}")
    if text is None:
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or value < 0:
        raise ModelContractError(
            f"metadata vehanchor.{key} is {text!r}: expected a finite number >= 0"
        )
    return value
