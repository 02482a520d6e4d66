"""Estimates of files for ``vehanchor estimate``, in this process or in one of its own."""

from __future__ import annotations

import os
import traceback
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.cli.metadata import metadata_facts
from vehanchor.cli.outputs import write_outputs
from vehanchor.cli.terminal import DefectError
from vehanchor.errors import OutOfMemoryError, VehAnchorError, WorkerDiedError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from vehanchor.analysis.isolated_process import IsolatedProcess
    from vehanchor.cli.cli_options import ParsedOptions
    from vehanchor.engine import Engine
    from vehanchor.records import GsdEstimate


class PhotographFile(NamedTuple):
    """Photograph to estimate.

    Attributes:
        source: its path.
        outputs: files to write, by the names of their options.
        details: whether to list its camera metadata.
    """

    source: str
    outputs: Mapping[str, Path]
    details: bool


class EstimatedFile(NamedTuple):
    """Estimate of a photograph, or why it has none.

    Attributes:
        estimate: the record; None without one.
        metadata: camera metadata for people; empty unless asked for.
        written: files that were written.
        why_refused: why the files in metres were not written; None if they were.
        error: why the photograph, or one of the files, could not be used.
    """

    estimate: GsdEstimate | None = None
    metadata: Sequence[tuple[str, str]] = ()
    written: Sequence[Path] = ()
    why_refused: str | None = None
    error: VehAnchorError | None = None


class Estimator:
    """Estimates photographs one by one.

    A single photograph is estimated in this process. Of several, none may end the command:
    they are estimated in a process of its own, which is replaced after its end.

    Args:
        chosen: options of the method, models and runtime.
        isolated: whether to use a process of its own.

    Raises:
        ModelError: a model cannot be used.
        WorkerDiedError: the process could not start.
    """

    def __init__(self, chosen: ParsedOptions, *, isolated: bool) -> None:
        self._process: IsolatedProcess[PhotographFile, EstimatedFile] | None = None
        if not isolated:
            self._estimate = partial(_estimate, chosen.loaded_engine())
            return
        from vehanchor.analysis.isolated_process import IsolatedProcess

        self._process = IsolatedProcess(
            partial(_prepare_process, chosen), remedy="Close other programs and try again"
        )
        self._process.start()

    def estimate(
        self, photograph: PhotographFile, progress: Callable[[int, int], None]
    ) -> EstimatedFile:
        """Estimate a photograph and write its files; errors of it are part of the result."""
        if self._process is None:
            return self._estimate(photograph, progress)
        try:
            return self._process.run(photograph, progress)
        except WorkerDiedError as error:
            return EstimatedFile(error=error)

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.close()


def _prepare_process(
    chosen: ParsedOptions,
) -> Callable[[PhotographFile, Callable[..., None]], EstimatedFile]:
    """Load the models in a process of its own; return the function that estimates there."""
    engine = chosen.loaded_engine()

    def estimate(photograph: PhotographFile, progress: Callable[..., None]) -> EstimatedFile:
        try:
            return _estimate(engine, photograph, progress)
        except MemoryError:
            return EstimatedFile(error=OutOfMemoryError("too little memory was left"))
        except Exception as error:
            # A defect that one photograph triggers must not end the others.
            if os.environ.get("VEHANCHOR_TRACEBACK"):
                traceback.print_exc()
            return EstimatedFile(error=DefectError.of(error))

    return estimate


def _estimate(
    engine: Engine, photograph: PhotographFile, progress: Callable[..., None]
) -> EstimatedFile:
    """Estimate a photograph and write its files."""
    result = EstimatedFile()
    try:
        analysis = engine.analyse_scale(photograph.source, progress=progress)
        result = result._replace(estimate=analysis.estimate)
        written, why_refused = write_outputs(analysis, photograph.outputs)
        result = result._replace(written=written, why_refused=why_refused)
        if photograph.details:
            metadata = metadata_facts(photograph.source, engine.options)
            result = result._replace(metadata=metadata)
    except VehAnchorError as error:
        return result._replace(error=error)
    return result
