"""Cars that two overlapping photographs show."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from research.training.readings.candidates import Candidate

_SIDE_PX = 1400  # of the copies that are compared
_RATIO = 0.75
_LEAST_INLIERS = 25
_SAME_CAR = 0.4  # of a length
_MAX_FEATURES = 4000

Features = tuple[NDArray[np.float32], NDArray[np.float32]]


def _features(path: Path) -> Features:
    image = np.asarray(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), np.uint8)
    scale = min(1.0, _SIDE_PX / max(image.shape))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    points, descriptors = cv2.SIFT_create(_MAX_FEATURES).detectAndCompute(small, None)  # type: ignore[attr-defined]
    return np.asarray([point.pt for point in points], np.float32) / scale, np.asarray(descriptors, np.float32)


def _homography(first: Features, second: Features) -> NDArray[np.float64] | None:
    pairs = cv2.BFMatcher().knnMatch(first[1], second[1], k=2)
    good = [best for best, next_best in pairs if best.distance < _RATIO * next_best.distance]
    if len(good) < _LEAST_INLIERS:
        return None
    source = first[0][[match.queryIdx for match in good]]
    target = second[0][[match.trainIdx for match in good]]
    found, inliers = cv2.findHomography(source, target, cv2.RANSAC, 6.0)
    return np.asarray(found, np.float64) if found is not None and int(inliers.sum()) >= _LEAST_INLIERS else None


def seen_once(cars: Sequence[Candidate], data: Path) -> list[Candidate]:
    """Leave out cars of one place that an earlier photograph shows; moving cars stay."""
    of_file: dict[str, list[Candidate]] = defaultdict(list)
    for car in cars:
        of_file[car.file].append(car)
    features = {file: _features(data / file) for file in of_file}
    kept: dict[str, list[Candidate]] = {}
    for file, here in of_file.items():
        left = list(here)
        for earlier in [other for other in kept if kept[other]]:
            mapped = _homography(features[file], features[earlier]) if left else None
            if mapped is None:
                continue
            points = np.asarray([[car.x, car.y] for car in left], np.float64)[:, None]
            at = cv2.perspectiveTransform(points, mapped)[:, 0]
            known = np.asarray([[car.x, car.y, car.length] for car in kept[earlier]])
            gap = np.linalg.norm(at[:, None] - known[None, :, :2], axis=2)
            left = [car for car, new in zip(left, (gap >= _SAME_CAR * known[:, 2]).all(axis=1), strict=True) if new]
        kept[file] = left
    return [car for here in kept.values() for car in here]
