"""Worker of a batch run: a loaded model that makes rows from image files."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import cv2

from vehanchor.analysis.pipeline import analyse_raster, checked_detector
from vehanchor.batch.row import BatchRow
from vehanchor.detection.detector import networks_sha256
from vehanchor.engine import Engine
from vehanchor.errors import ModelContractError, OutOfMemoryError, VehAnchorError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.options import ScaleOptions
from vehanchor.pictures.overlays import Overlays
from vehanchor.rulers.known_length_table import with_lines_of
from vehanchor.storage.journal import Key, Source

if TYPE_CHECKING:
    from vehanchor.rulers.known_length_table import KnownLengthTable


@dataclass(frozen=True)
class BatchJob:
    """Settings common to all workers.

    Attributes:
        detector: name of a bundled model, or the absolute path of a file.
        networks_sha256: expected checksum of all networks; another machine of a cluster may have
            other files.
        classes: classes of the model that count as vehicles; None for the model's own.
        options: options of the method, without a frame.
        runtime: runtime of each worker's models; rows do not depend on the number of threads.
        known_lengths: lines by image, in pixels of the image; they replace the lines in the
            options.
        overlays: where each image is drawn; None for no pictures.
    """

    detector: str
    networks_sha256: str
    classes: tuple[str | int, ...] | None = None
    options: ScaleOptions = field(default_factory=ScaleOptions)
    runtime: Runtime = field(default_factory=lambda: Runtime(threads=1))
    known_lengths: KnownLengthTable = field(default_factory=dict)
    overlays: Overlays | None = None


@dataclass(frozen=True)
class Task:
    """One image of a run.

    Attributes:
        file: its name in the table.
        path: its absolute path.
    """

    file: str
    path: str

    @classmethod
    def of(cls, path: str) -> Task:
        """Make the task of an image; the table shows undecodable bytes of its name escaped."""
        printable_name = path.encode("utf-8", "backslashreplace").decode()
        absolute_path = Path(path).absolute()
        return cls(file=printable_name, path=str(absolute_path))

    def key(self) -> Key:
        """Make the journal key of the row: name, path, size and time of the image.

        The row of a file that has been replaced is not found under its new key. Two names that
        escape to the same text have different paths, whose undecodable bytes JSON keeps.
        """
        return (self.file, *Source.of(self.path))


class Worker:
    """Loaded model that makes rows.

    Args:
        job: settings of the run.

    Raises:
        ModelError: the model cannot be loaded, or is not the one that the job names.
        InvalidParameterError: the model does not know the region.
    """

    def __init__(self, job: BatchJob) -> None:
        self._options = job.options
        self._known_lengths = job.known_lengths
        self._overlays = job.overlays
        engine = Engine(job.detector, classes=job.classes, runtime=job.runtime)
        self._detector = checked_detector(engine.detector, job.options)
        # Rows of different networks must not get into one table.
        sha256 = networks_sha256(self._detector.card)
        if sha256 != job.networks_sha256:
            raise ModelContractError(
                f"{job.detector} and its auxiliary models on this machine (sha256 {sha256[:12]}) "
                f"differ from those where the run was started ({job.networks_sha256[:12]}): "
                "install one version of vehanchor everywhere"
            )

    @classmethod
    def for_this_process(cls, job: BatchJob) -> Worker:
        """Make the only worker of this process; it also limits the threads of OpenCV."""
        cv2.setNumThreads(job.runtime.threads or -1)
        return cls(job)

    def row(self, task: Task) -> BatchRow:
        """Make the row of one image; any error goes into the row."""
        try:
            options = with_lines_of(self._options, self._known_lengths, task.path)
            with open_raster(task.path, options.reading) as raster:
                analysis = analyse_raster(self._detector, raster, options)
                if self._overlays is not None:
                    drawn = analysis.drawn_over(task.path, raster, options.reading)
                    self._overlays.write(task.path, drawn.overlay())
        except VehAnchorError as error:
            return BatchRow.failed(task.file, error)
        except MemoryError:
            return BatchRow.failed(task.file, OutOfMemoryError("too little memory was left"))
        except Exception as error:
            # A defect that one image triggers must not end a run over a million images.
            message = f"{type(error).__name__}: {error}"
            return BatchRow(photograph=task.file, error_code="internal_error", error=message)
        return BatchRow(photograph=task.file, estimate=analysis.estimate)
