"""Many images, one row of a table each: files -> engine -> journal -> table.

``files`` names the images, an engine (``local_engine``: processes of this machine; ``ray_engine``: a Ray cluster)
makes a ``BatchRow`` of each with one model per worker, ``journal`` keeps rows as they come so that an interrupted run
goes on where it stopped, and ``table`` writes them in the order of the files. ``run`` puts these together. ``journal``
and ``pool`` serve the long runs of ``vehanchor_evaluation``, too.
"""

from vehanchor.batch.row import BatchRow
from vehanchor.batch.run import BatchEngine, BatchSummary, run_batch
from vehanchor.batch.worker import BatchJob
from vehanchor.imagery.sources.files import find_images

__all__ = ["BatchEngine", "BatchJob", "BatchRow", "BatchSummary", "find_images", "run_batch"]
