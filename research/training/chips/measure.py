"""Measure a chip network on what it has not learned from: ``python -m research.training.chips.measure CHIPS.onnx R``.

``R`` has ``read.npz`` (``readings.py``) and the store ``held_out`` (``research.training.car_verifier.mine``). Edges,
kinds and scales are those of the places and groups that the readings keep back; ``--places`` chooses others, for a
network that was trained without them.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from research.training.car_verifier.store import STORED_LENGTH_PX, read_store
from research.training.chips.kinds import BODY_M, CARS, GROUP_OF_KIND, GROUPS, KINDS, UNKNOWN
from research.training.chips.network import Answers
from research.training.chips.readings import READ_LENGTH_PX, Read, load
from research.training.chips.stream import cut

_BATCH = 64
_MIRRORS = ((1, 1), (1, -1), (-1, 1), (-1, -1))  # along and across
_WITHIN_KIND = np.array([[0.075**2, 0.6 * 0.075 * 0.04], [0.6 * 0.075 * 0.04, 0.04**2]])  # of log length and width
_LEAST_LOG_SD = np.array([0.02, 0.03])
_LOOKS_LOG_SD = np.array([0.10, 0.05])


class Said(NamedTuple):
    """Means of the answers over mirrored views; see ``network.Answers``."""

    logit: NDArray[np.float64]
    kinds: NDArray[np.float64]  # chances
    edges: NDArray[np.float64]
    edge_sd: NDArray[np.float64]
    log_metres: NDArray[np.float64]

    @property
    def sizes(self) -> NDArray[np.float64]:
        """``[n, 2]`` length and width in candidate lengths."""
        return np.stack([self.edges[:, 1] - self.edges[:, 0], self.edges[:, 3] - self.edges[:, 2]], axis=1)

    @property
    def log_sd(self) -> NDArray[np.float64]:
        """``[n, 2]`` standard deviations of the logs of length and width."""
        return np.hypot(self.edge_sd[:, ::2], self.edge_sd[:, 1::2]) / self.sizes


def answers(session: onnxruntime.InferenceSession, chips: NDArray[np.uint8], views: int = 4) -> Said:
    """Answers of a network for chips ``[n, 64, 96, 3]``."""
    names = list(Answers._fields)
    total: list[NDArray[np.float64]] = []
    for along, across in _MIRRORS[:views]:
        parts = []
        for start in range(0, len(chips), _BATCH):
            planes = chips[start : start + _BATCH, ::across, ::along].transpose(0, 3, 1, 2)
            batch = np.ascontiguousarray(planes).astype(np.float32) / 255
            parts.append(session.run(names, {"chips": batch}))
        said = Answers(*(np.concatenate(each).astype(np.float64) for each in zip(*parts, strict=True)))
        odds = np.exp(said.kinds - said.kinds.max(axis=1, keepdims=True))
        ends, sides = said.edges[:, :2], said.edges[:, 2:]
        spread = np.exp(said.edge_log_sd)
        order = [1, 0] if along < 0 else [0, 1], [3, 2] if across < 0 else [2, 3]
        edges = np.concatenate([-ends[:, ::-1] if along < 0 else ends, -sides[:, ::-1] if across < 0 else sides], axis=1)
        kinds = odds / odds.sum(axis=1, keepdims=True)
        view = [said.logit, kinds, edges, spread[:, order[0] + order[1]], said.log_metres]
        total = [a + b for a, b in zip(total, view, strict=True)] if total else view
    return Said(*(each / views for each in total))


def robust(values: NDArray[np.float64]) -> float:
    """Standard deviation by the median absolute deviation."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def _line(name: str, logs: NDArray[np.float64]) -> str:
    return f"{name}: n {len(logs)}, bias {100 * np.median(logs):+.1f} %, sd {100 * logs.std(ddof=1):.1f} %, robust {100 * robust(logs):.1f} %"


def edge_report(read: Read, said: Said) -> list[str]:
    """Length and width against the eye, of the network and of the detector's box."""
    whole = np.isfinite(read.edges).all(axis=1)
    eye = np.log(np.stack([read.edges[whole, 1] - read.edges[whole, 0], read.edges[whole, 3] - read.edges[whole, 2]], 1))
    ours = np.log(said.sizes[whole])
    box = np.stack([np.zeros(whole.sum()), np.log(read.width_px[whole] / read.length_px[whole])], axis=1)
    out = []
    for name, seen in (("chips", ours), ("detector", box)):
        out += [_line(f"{name} {what}", seen[:, k] - eye[:, k]) for k, what in enumerate(("length", "width"))]
        ratio, wanted = seen[:, 1] - seen[:, 0], eye[:, 1] - eye[:, 0]
        out.append(f"{name} width over length: correlation {np.corrcoef(ratio, wanted)[0, 1]:.2f}, sd {ratio.std():.3f} of {wanted.std():.3f}")
        out.append(f"{name} slope of length {np.polyfit(eye[:, 0], seen[:, 0] - eye[:, 0], 1)[0]:+.2f}")
    known = np.isfinite(read.edges)
    off = ((said.edges - read.edges) / said.edge_sd)[known]
    out.append(f"edges: error over stated sd, robust {robust(off):.2f}, rms {np.sqrt(np.mean(off**2)):.2f}")
    return out


def kind_report(read: Read, said: Said) -> list[str]:
    """Agreement of kinds with the eye, in four groups of cars."""
    out = []
    cars = (read.kind != UNKNOWN) & (read.kind < len(CARS))
    best = said.kinds[:, : len(CARS)].argmax(axis=1)
    grouped = np.stack([said.kinds[:, GROUP_OF_KIND == k].sum(axis=1) for k in range(4)], axis=1).argmax(axis=1)
    for name in (*np.unique(read.place), "all"):
        chosen = cars & ((read.place == name) | (name == "all"))
        if chosen.sum() > 5:
            same = np.mean(best[chosen] == read.kind[chosen])
            same_group = np.mean(grouped[chosen] == GROUP_OF_KIND[read.kind[chosen]])
            most = np.bincount(GROUP_OF_KIND[read.kind[chosen]]).max() / chosen.sum()
            out.append(f"kinds {name}: n {chosen.sum()}, same {same:.2f}, same group {same_group:.2f}, always the commonest {most:.2f}")
    table = np.zeros((4, 4), int)
    np.add.at(table, (GROUP_OF_KIND[read.kind[cars]], grouped[cars]), 1)
    out += [f"read {GROUPS[k]}: said {dict(zip(GROUPS, row.tolist(), strict=False))}" for k, row in enumerate(table)]
    return out


def log_scale(said: Said, length_px: NDArray[np.float64], use: tuple[bool, bool] = (True, True), *, looks: bool = True) -> NDArray[np.float64]:
    """Log of metres per pixel from each car alone: a mean over kinds of what length and width say, and the looks."""
    logs = np.log(said.sizes * length_px[:, None])
    body = np.log([BODY_M[kind] for kind in CARS])
    chance = said.kinds[:, : len(CARS)] / said.kinds[:, : len(CARS)].sum(axis=1, keepdims=True)
    out = np.zeros(len(logs))
    chosen = np.flatnonzero(use)
    for row in range(len(logs)):
        noise = np.diag(np.hypot(said.log_sd[row], _LEAST_LOG_SD) ** 2)
        inner = np.linalg.inv((_WITHIN_KIND + noise)[np.ix_(chosen, chosen)])
        middle = chance[row] @ body
        if looks:
            precision = 1 / np.diag(_WITHIN_KIND), 1 / _LOOKS_LOG_SD**2
            middle = (middle * precision[0] + said.log_metres[row] * precision[1]) / (precision[0] + precision[1])
        weight = inner.sum(axis=0) / inner.sum()
        out[row] = weight @ (middle - logs[row])[chosen]
    return out


def scale_report(read: Read, said: Said) -> list[str]:
    """Spread of the log of the scale from one car after its photograph's place."""
    cars = np.isfinite(read.edges).any(axis=1) & (read.kind < len(CARS))
    whole = np.isfinite(read.edges).all(axis=1)
    eye = np.stack([read.edges[:, 1] - read.edges[:, 0], read.edges[:, 3] - read.edges[:, 2]], axis=1) * read.length_px[:, None]
    body = np.log([BODY_M.get(KINDS[max(kind, 0)], (4.4, 1.8)) for kind in read.kind])
    ways = {
        "detector's length": -np.log(read.length_px),
        "length": -np.log(said.sizes[:, 0] * read.length_px),
        "width": -np.log(said.sizes[:, 1] * read.length_px),
        "length and kind": log_scale(said, read.length_px, (True, False), looks=False),
        "width and kind": log_scale(said, read.length_px, (False, True), looks=False),
        "length, width and kind": log_scale(said, read.length_px, looks=False),
        "looks' metres over the length": said.log_metres[:, 0] - np.log(said.sizes[:, 0] * read.length_px),
        "looks' metres over the detector's": said.log_metres[:, 0] - np.log(read.length_px),
        "looks' metres over the width": said.log_metres[:, 1] - np.log(said.sizes[:, 1] * read.length_px),
        "all": log_scale(said, read.length_px),
        "eye: length": -np.log(eye[:, 0]),
        "eye: length and kind": body[:, 0] - np.log(eye[:, 0]),
        "eye: width and kind": body[:, 1] - np.log(eye[:, 1]),
    }
    chosen = cars & whole & (read.kind != UNKNOWN) & np.isfinite(read.gsd)
    out = []
    for name, way in ways.items():
        off, bias = [], []
        for place in np.unique(read.place[chosen]):
            here = chosen & (read.place == place)
            errors = way[here] - np.log(read.gsd[here])
            off.append(errors - np.median(errors))
            bias.append(f"{place} {100 * np.median(errors):+.1f}")
        joined = np.concatenate(off)
        bias_text = "" if name in ("detector's length", "length", "width", "eye: length") else f", bias {', '.join(bias)} %"
        out.append(f"one car's scale by {name}: n {len(joined)}, sd {100 * joined.std(ddof=len(off)):.1f} %, robust {100 * robust(joined):.1f} %{bias_text}")
    return out


def _area(hits: NDArray[np.float64], false: NDArray[np.float64]) -> float:
    order = np.argsort(np.concatenate([hits, false]), kind="stable")
    rank = np.empty(len(order))
    rank[order] = np.arange(len(order))
    return float((rank[: len(hits)].mean() - (len(hits) - 1) / 2) / len(false))


def car_report(folder: Path, session: onnxruntime.InferenceSession, name: str = "held_out") -> list[str]:
    """Car or not on the candidates of the held-out tenth: today's networks, the chip network, and both joined."""
    chips, rows = read_store(folder / name)
    chosen = np.flatnonzero(rows.score > 0)
    rows = rows.take(chosen)
    car = rows.car == 1
    ours = answers(session, np.stack([cut(np.asarray(chips[k]), STORED_LENGTH_PX) for k in chosen])).logit
    one = answers(session, np.stack([cut(np.asarray(chips[k]), STORED_LENGTH_PX) for k in chosen]), 1).logit
    detector, verified = (np.log(s / (1 - s)) for s in (np.clip(v.astype(float), 1e-4, 1 - 1e-4) for v in (rows.score, rows.combined)))
    today = car_verifier_logits(np.stack([np.asarray(chips[k]) for k in chosen]))
    scores = {
        "detector": [detector], "with verifier": [verified], "with both verifiers": [verified, today],
        "car verifier": [today], "chips, one view": [one], "chips": [ours], "detector and chips, one view": [detector, one],
        "detector and chips": [detector, ours], "with verifier, and chips": [verified, ours],
    }  # fmt: skip
    half = np.array([hash_of(file) % 2 for file in rows.files])
    out = [f"{name}: {car.sum()} cars, {(~car).sum()} others"]
    for what, parts in scores.items():
        joined = np.zeros(len(car))
        design = np.column_stack([*parts, np.ones(len(car))])
        for side in (0, 1):
            theta = _logistic(design[half != side], car[half != side])
            joined[half == side] = design[half == side] @ theta
        hits, false = joined[car], joined[~car]
        left = np.mean(false > np.percentile(hits, 5))
        order = np.argsort(-joined, kind="stable")
        precision = np.cumsum(car[order]) / np.arange(1, len(car) + 1)
        envelope = np.maximum.accumulate(precision[::-1])[::-1]
        ap = envelope[car[order]].mean()
        at = np.argmin(np.abs(np.cumsum(car[order]) - 0.9 * car.sum()))
        out.append(f"  {what}: AUC {_area(hits, false):.4f}, AP {ap:.4f}, precision at recall 0.9 {precision[at]:.3f}, false left at 95 % {left:.3f}")
    return out


def hash_of(text: str) -> int:
    """Stable checksum of a name."""
    import zlib

    return zlib.crc32(text.encode())


def _logistic(design: NDArray[np.float64], car: NDArray[np.bool_]) -> NDArray[np.float64]:
    theta = np.zeros(design.shape[1])
    for _ in range(30):
        chance = 1 / (1 + np.exp(-np.clip(design @ theta, -30, 30)))
        curve = (design * (chance * (1 - chance))[:, None]).T @ design + 1e-3 * np.eye(len(theta))
        theta = theta - np.linalg.solve(curve, design.T @ (chance - car) + 1e-3 * theta)
    return theta


def car_verifier_logits(stored: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Logits of today's car verifier for stored chips."""
    from research.training.car_verifier.stream import Move
    from research.training.car_verifier.stream import cut as car_verifier_cut
    from vehanchor.detection.car_verifier import CarVerifier
    from vehanchor.models.zoo import car_verifier_beside, resolve_model

    path = car_verifier_beside(resolve_model())
    assert path is not None
    still = Move(np.zeros(2), 1.0, 0.0, np.ones(2))
    return CarVerifier(path).verify(np.stack([car_verifier_cut(chip, still) for chip in stored])).logit


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--places", default="", help="whose readings are looked at; else all that are kept back")
    parser.add_argument("--no-cars", action="store_true", help="leave out car or not")
    options = parser.parse_args()
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(options.network, settings)
    read = load(options.folder / "read.npz")
    kept = np.isin(read.place, options.places.split(",")) if options.places else read.check
    read = read.take(kept)
    said = answers(session, np.stack([cut(chip, READ_LENGTH_PX) for chip in read.chips]))
    print("\n".join(edge_report(read, said) + kind_report(read, said) + scale_report(read, said)), flush=True)
    if not options.no_cars:
        print("\n".join(car_report(options.folder, session)))


if __name__ == "__main__":
    main()
