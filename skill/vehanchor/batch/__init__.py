"""Scales of many images in a table: images -> engine -> journal -> table.

An engine (``engines.local``: processes of this machine; ``engines.ray``: a Ray cluster) makes a
``BatchRow`` of each image, with one model per ``worker``. A journal keeps finished rows, so that
an interrupted run can resume. ``table`` writes the rows in the order of the images. ``run``
combines these modules.
"""

from vehanchor.batch.row import BatchRow
from vehanchor.batch.run import BatchSummary, run_batch
from vehanchor.batch.worker import BatchJob
from vehanchor.imagery.sources.files import find_images

__all__ = ["BatchJob", "BatchRow", "BatchSummary", "find_images", "run_batch"]
