"""Area benchmark modelled on the paper's RS-GSD: objects of iSAID with masks and known scale.

The paper's benchmark has 100 entries in 8 categories of iSAID, and oversamples irregular objects.
It names three of the categories; the other five are our choice of immobile objects. Vehicles (the
ruler itself), ships and aircraft are left out, and so are bridges and harbours, whose outline is a
convention.

A benchmark is a folder for ``vehanchor evaluate area --segments``: an ``index.csv``, and a mask for
each object.
"""

from __future__ import annotations

import csv
import os
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from research.paper import isaid
from vehanchor.errors import InvalidParameterError, OutputError
from vehanchor.storage.atomic import whole_file
from vehanchor_evaluation.areas import COLUMNS, INDEX, MIN_SIDE_PX
from vehanchor_evaluation.dota import survey_dota
from vehanchor_evaluation.known_scale import FileIssue

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray

    from research.paper.isaid import AnnotatedImage

DEFAULT_ENTRIES = 100
CATEGORIES = (
    "swimming-pool",  # the paper names these three
    "roundabout",
    "ground-track-field",
    "soccer-ball-field",
    "tennis-court",
    "basketball-court",
    "baseball-diamond",
    "storage-tank",
)
# The paper oversamples these by an unpublished factor.
IRREGULAR = ("swimming-pool", "roundabout")
IRREGULAR_WEIGHT = 2
_MASKS = "masks"


class Built(NamedTuple):
    """Summary of a written benchmark.

    Attributes:
        entries: entries by category.
        available: objects available for the choice, by category.
        too_small: objects left out because they are too small.
        issues: data that were left out.
    """

    entries: dict[str, int]
    available: dict[str, int]
    too_small: int
    issues: list[FileIssue]


@dataclass(frozen=True, eq=False)
class _Candidate:
    """Candidate for an entry; its mask is kept encoded."""

    image: AnnotatedImage
    category: str
    left_px: int
    top_px: int
    png: bytes


def build_benchmark(
    folders: Sequence[tuple[Path, Path]],
    out: Path,
    *,
    entries: int | None = DEFAULT_ENTRIES,
    seed: int = 0,
    categories: Sequence[str] = CATEGORIES,
    progress: Callable[[int, int], None] | None = None,
) -> Built:
    """Choose objects and write the benchmark.

    Images and objects are drawn in random order. Within a category, each image gives one object
    before any gives a second.

    Args:
        folders: folders of iSAID annotations, each with that of the same split of DOTA.
        out: folder to write; created if it does not exist.
        entries: number of entries; None for every object.
        seed: seed of the random choice.
        categories: categories to choose from.
        progress: called with (images read, total).

    Raises:
        InvalidParameterError: the data are missing, the folder has a benchmark, or there are no
            objects to choose from.
        OutputError: the folder cannot be written.
    """
    if (out / INDEX).exists():
        raise InvalidParameterError(f"{out} has a benchmark: choose another folder")
    images, issues = _annotated_images(folders)
    by_category: dict[str, list[_Candidate]] = {category: [] for category in categories}
    n_small = 0
    present = set[str]()
    for done, image in enumerate(images, start=1):
        reading = _read_candidates(image, categories)
        n_small += reading.n_small
        present |= reading.categories
        issues += reading.issues
        for candidate in reading.candidates:
            by_category[candidate.category].append(candidate)
        if progress is not None:
            progress(done, len(images))
    available = {category: len(by_category[category]) for category in sorted(by_category)}
    sample = _sample(by_category, quotas(available, entries), seed)
    if not sample:
        first = f"; the first problem: {issues[0].file}: {issues[0].message}" if issues else ""
        objects = ", ".join(sorted(present)) or "no objects"
        raise InvalidParameterError(
            f"no object of category {', '.join(available)} to choose from: the {len(images)} "
            f"images have {objects}; {n_small} are smaller than {MIN_SIDE_PX} px{first}"
        )
    _write(out, sample)
    return Built(
        dict(Counter(candidate.category for candidate in sample)),
        available,
        too_small=n_small,
        issues=issues,
    )


def _annotated_images(
    folders: Sequence[tuple[Path, Path]],
) -> tuple[list[AnnotatedImage], list[FileIssue]]:
    """Find the annotated images; a second one of a name becomes an issue."""
    first: dict[str, AnnotatedImage] = {}
    issues: list[FileIssue] = []
    for masks, split in folders:
        annotated, left_out = isaid.find_annotated_images(masks, survey_dota(split))
        issues += left_out
        for image in annotated:
            if image.name in first:
                message = f"{first[image.name].path} has the same name, and only that one is used"
                issues.append(FileIssue(image.path, "duplicate_name", message))
            first.setdefault(image.name, image)
    return list(first.values()), issues


def quotas(available: Mapping[str, int], n_entries: int | None) -> dict[str, int]:
    """Divide entries among categories: irregular ones get twice as many, none more than it has.

    Entries that a small category cannot fill go to the others by the same weights. Entries left by
    rounding go to the largest remainders.

    Args:
        available: objects by category.
        n_entries: total number of entries; None for every object.

    Returns:
        Entries by category, in the order of ``available``; they sum to ``n_entries`` or to the
        available number.
    """
    if n_entries is None:
        return dict(available)
    quota = dict.fromkeys(available, 0)
    n_total = min(n_entries, sum(available.values()))
    n_left = n_total
    while n_left:
        unfilled = [category for category in available if quota[category] < available[category]]
        total = sum(map(_weight, unfilled))
        shares = {category: n_left * _weight(category) / total for category in unfilled}
        additions = {category: int(share) for category, share in shares.items()}
        # The entries that rounding leaves go to the largest remainders.
        n_rest = n_left - sum(additions.values())
        by_remainder = sorted(unfilled, key=lambda name: additions[name] - shares[name])
        for category in by_remainder[:n_rest]:
            additions[category] += 1
        for category in unfilled:
            quota[category] += min(additions[category], available[category] - quota[category])
        n_left = n_total - sum(quota.values())
    return quota


def _weight(category: str) -> int:
    return IRREGULAR_WEIGHT if category in IRREGULAR else 1


class _ImageObjects(NamedTuple):
    """Candidates in an image, number of objects that are too small, all categories, and issues."""

    candidates: list[_Candidate]
    n_small: int
    categories: frozenset[str]
    issues: list[FileIssue]


def _read_candidates(image: AnnotatedImage, categories: Sequence[str]) -> _ImageObjects:
    try:
        masks = image.read_masks()
    except (OSError, ValueError) as error:
        return _ImageObjects(
            [],
            0,
            categories=frozenset(),
            issues=[FileIssue(image.path, "unreadable_masks", str(error))],
        )
    of_categories = [mask for mask in masks if mask.category in categories]
    large = [mask for mask in of_categories if min(mask.mask.shape) >= MIN_SIDE_PX]
    candidates = [
        _Candidate(
            image, mask.category, left_px=mask.left_px, top_px=mask.top_px, png=_png(mask.mask)
        )
        for mask in large
    ]
    return _ImageObjects(
        candidates,
        len(of_categories) - len(large),
        categories=frozenset(mask.category for mask in masks),
        issues=[],
    )


def _png(mask: NDArray[np.bool_]) -> bytes:
    grey = mask.astype(np.uint8) * 255
    _, encoded = cv2.imencode(".png", grey, [cv2.IMWRITE_PNG_BILEVEL, 1])
    return bytes(encoded.tobytes())


def _sample(
    candidates: Mapping[str, list[_Candidate]], quota: Mapping[str, int], seed: int
) -> list[_Candidate]:
    """Draw the entries of each category; categories alternate in the result."""
    by_category = []
    for index, category in enumerate(quota):
        generator = np.random.default_rng([seed, index])
        n_of_image: Counter[str] = Counter()
        queue: list[tuple[int, int, _Candidate]] = []
        for k in generator.permutation(len(candidates[category])):
            candidate = candidates[category][k]
            n_of_image[candidate.image.name] += 1
            queue.append((n_of_image[candidate.image.name], len(queue), candidate))
        # Each image gives one object before any gives a second one.
        queue.sort(key=lambda item: item[:2])
        by_category.append([candidate for _, _, candidate in queue[: quota[category]]])
    longest = max(map(len, by_category), default=0)
    return [queue[turn] for turn in range(longest) for queue in by_category if turn < len(queue)]


def _write(folder: Path, candidates: Sequence[_Candidate]) -> None:
    """Write the index and the masks, each from the image's corner to the end of its object."""
    try:
        (folder / _MASKS).mkdir(parents=True, exist_ok=True)
        rows = []
        for number, candidate in enumerate(candidates, start=1):
            mask = cv2.imdecode(np.frombuffer(candidate.png, np.uint8), cv2.IMREAD_GRAYSCALE)
            assert mask is not None
            whole = np.pad(mask, ((candidate.top_px, 0), (candidate.left_px, 0)))
            file = f"{_MASKS}/{number:04d}.png"
            (folder / file).write_bytes(_png(whole > 0))
            image = os.path.relpath(candidate.image.path.resolve(), folder.resolve())
            rows.append((image, file, candidate.category, candidate.image.gsd_m_per_px))
        with (
            whole_file(folder / INDEX) as partial,
            partial.open("w", newline="", encoding="utf-8") as handle,
        ):
            # The index is written last: it marks the folder as complete.
            csv.writer(handle, lineterminator="\n").writerows([COLUMNS, *rows])
    except OSError as error:
        raise OutputError(
            f"cannot write the benchmark to {str(folder)!r}: {error.strerror}"
        ) from None
