"""The engine Ray on a cluster of several nodes, which Ray simulates on this machine."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from tests.models import car_park
from tests.skill.batch.runs import check_names_that_look_alike, read_rows
from vehanchor.batch import run_batch
from vehanchor.batch.engines import ray as engine
from vehanchor.batch.run import journal_path
from vehanchor.models.runtime import Runtime

if TYPE_CHECKING:
    from collections.abc import Iterator

# Ray warns about itself.
pytestmark = [pytest.mark.ray, pytest.mark.filterwarnings("ignore::DeprecationWarning")]
N_IMAGES = 16
KILLED_AFTER = 4


@pytest.fixture(scope="module")
def cluster(_hasty_ray: None) -> Iterator[Any]:
    """Connect this process to a head that computes nothing."""
    ray = pytest.importorskip("ray")
    utils = pytest.importorskip("ray.cluster_utils")
    head: dict[str, Any] = {"num_cpus": 0, "include_dashboard": False, "no_monitor": True}
    nodes = utils.Cluster(initialize_head=True, head_node_args=head)
    ray.init(nodes.address, log_to_driver=False)
    yield nodes
    ray.shutdown()
    nodes.shutdown()


@pytest.fixture
def node(cluster: Any) -> Any:
    """The one node that computes."""
    if not cluster.worker_nodes:
        cluster.add_node(num_cpus=1)
    (node,) = cluster.worker_nodes
    return node


@pytest.mark.skipif(sys.platform != "linux", reason="other systems refuse such names")
@pytest.mark.usefixtures("node")
def test_images_whose_names_look_alike_have_their_own_rows(
    folder: Path, detector: Path, tmp_path: Path
) -> None:
    check_names_that_look_alike(folder, detector, tmp_path, engine="ray")


def test_a_killed_node_costs_no_row(
    cluster: Any, node: Any, detector: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All rows come from the node that dies, and then from the one that takes its place."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(engine, "_IMAGES_PER_BLOCK", 1)
    for k in range(N_IMAGES):
        image = car_park(np.full(20, 29 + k / 10), 800, 300)
        cv2.imwrite(str(tmp_path / f"{k:03}.png"), image[:, :, ::-1])
    expected = tmp_path / "local.jsonl"
    run_batch(["*.png"], expected, detector=detector, workers=1)
    progress: list[int] = []

    def kill_the_node(done: int, _total: int) -> None:
        progress.append(done)
        if done == KILLED_AFTER:
            cluster.remove_node(node, allow_graceful=False)
            cluster.add_node(num_cpus=1)

    table = tmp_path / "ray.jsonl"
    runtime = Runtime(progress=kill_the_node)
    summary = run_batch(
        ["*.png"], table, detector=detector, engine="ray", workers=1, runtime=runtime
    )
    assert summary.n_rows == N_IMAGES
    assert progress == list(range(N_IMAGES + 1)), "each row comes once"
    assert table.read_bytes() == expected.read_bytes()
    files = {row["photograph"] for row in read_rows(table)}
    assert len(files) == N_IMAGES
    assert not journal_path(table).exists()
