"""The engine Ray on a cluster of several nodes, which Ray simulates on this machine."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from tests.models import car_park, write_detector
from vehanchor.batch import run_batch
from vehanchor.batch.run import journal_path
from vehanchor.models.runtime import Runtime

if TYPE_CHECKING:
    from collections.abc import Iterator

# Ray warns about itself.
pytestmark = [pytest.mark.ray, pytest.mark.filterwarnings("ignore::DeprecationWarning")]
N_IMAGES = 48
KILLED_AFTER = 12


@pytest.fixture
def cluster() -> Iterator[Any]:
    """Connect this process to a head that computes nothing; the test adds nodes."""
    ray = pytest.importorskip("ray")
    utils = pytest.importorskip("ray.cluster_utils")
    nodes = utils.Cluster(
        initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False}
    )
    ray.init(nodes.address, log_to_driver=False)
    yield nodes
    ray.shutdown()
    nodes.shutdown()


def test_a_killed_node_costs_no_row(
    cluster: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    detector = write_detector(tmp_path / "painted.onnx")
    for k in range(N_IMAGES):
        image = car_park(np.full(20, 29 + k / 40), 800, 300)
        cv2.imwrite(str(tmp_path / f"{k:03}.png"), image[:, :, ::-1])
    expected = tmp_path / "local.jsonl"
    run_batch(["*.png"], expected, detector=detector, workers=1)
    doomed_node = cluster.add_node(num_cpus=1)
    cluster.add_node(num_cpus=1)
    cluster.wait_for_nodes()
    progress: list[int] = []

    def kill_one_node(done: int, _total: int) -> None:
        progress.append(done)
        if done == KILLED_AFTER:
            cluster.remove_node(doomed_node, allow_graceful=False)

    table = tmp_path / "ray.jsonl"
    runtime = Runtime(progress=kill_one_node)
    summary = run_batch(
        ["*.png"], table, detector=detector, engine="ray", workers=2, runtime=runtime
    )
    assert summary.n_rows == N_IMAGES
    assert progress == list(range(N_IMAGES + 1)), "each row comes once"
    assert table.read_bytes() == expected.read_bytes()
    files = {json.loads(line)["photograph"] for line in table.read_text().splitlines()}
    assert len(files) == N_IMAGES
    assert not journal_path(table).exists()
