"""Answers of an exported chip network, as means over mirrored views."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from research.training.chips.network import Answers

_BATCH = 64
_MIRRORS = ((1, 1), (1, -1), (-1, 1), (-1, -1))  # along and across


class Said(NamedTuple):
    """Means of the answers over the views; see ``network.Answers``.

    Attributes:
        logit: ``[n]``.
        kinds: ``[n, 10]`` chances.
        edges: ``[n, 4]`` candidate lengths.
        edge_sd: ``[n, 4]`` candidate lengths.
        log_metres: ``[n, 2]``.
        metres_sd: ``[n, 2]``.
    """

    logit: NDArray[np.float64]
    kinds: NDArray[np.float64]
    edges: NDArray[np.float64]
    edge_sd: NDArray[np.float64]
    log_metres: NDArray[np.float64]
    metres_sd: NDArray[np.float64]

    @property
    def sizes(self) -> NDArray[np.float64]:
        """``[n, 2]`` length and width in candidate lengths."""
        return sizes(self.edges)

    @property
    def log_sd(self) -> NDArray[np.float64]:
        """``[n, 2]`` standard deviations of the logs of length and width."""
        return np.asarray(np.hypot(self.edge_sd[:, ::2], self.edge_sd[:, 1::2]) / self.sizes)


def sizes(edges: NDArray[np.floating]) -> NDArray[np.float64]:
    """Lengths and widths ``[n, 2]`` of edges ``[n, 4]``."""
    return np.stack([edges[:, 1] - edges[:, 0], edges[:, 3] - edges[:, 2]], axis=1).astype(np.float64)


def opened(path: Path) -> onnxruntime.InferenceSession:
    """A session on one thread."""
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(path, settings)


def _raw(session: onnxruntime.InferenceSession, chips: NDArray[np.uint8]) -> Answers:
    names, parts = list(Answers._fields), []
    for start in range(0, len(chips), _BATCH):
        planes = np.ascontiguousarray(chips[start : start + _BATCH].transpose(0, 3, 1, 2))
        parts.append(session.run(names, {"chips": planes.astype(np.float32) / 255}))
    return Answers(*(np.concatenate(each).astype(np.float64) for each in zip(*parts, strict=True)))


def answers(session: onnxruntime.InferenceSession, chips: NDArray[np.uint8], views: int = 4) -> Said:
    """Answers for chips ``[n, 64, 96, 3]``; a mirrored view sees each end, or each side, on the other side."""
    total: list[NDArray[np.float64]] = []
    for along, across in _MIRRORS[:views]:
        said = _raw(session, chips[:, ::across, ::along])
        signs = np.array([along, along, across, across])
        order = [0, 1, 2, 3] if along == 1 else [1, 0, 2, 3]
        order = order if across == 1 else [*order[:2], 3, 2]
        odds = np.exp(said.kinds - said.kinds.max(axis=1, keepdims=True))
        view = [
            said.logit, odds / odds.sum(axis=1, keepdims=True), (signs * said.edges)[:, order],
            np.exp(said.edge_log_sd)[:, order], said.log_metres, np.exp(said.metres_log_sd),
        ]  # fmt: skip
        total = [a + b for a, b in zip(total, view, strict=True)] if total else view
    return Said(*(each / views for each in total))
