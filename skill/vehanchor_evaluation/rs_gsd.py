"""A benchmark of areas in the manner of the paper's RS-GSD: objects of known mask in images of known scale.

The paper's has 100 entries in 8 categories of iSAID, irregular objects oversampled. It names three of the categories;
the other five are our choice among those that stay where they are. Left out are vehicles (the ruler itself), ships and
aircraft, and bridges and harbours, where the object ends by convention only.

On disk it is a folder: ``benchmark.json``, and a white-on-black picture of each object's mask, as small as its box.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from vehanchor.errors import InvalidParameterError, OutputError
from vehanchor.records import BoundingBox
from vehanchor.storage.atomic import whole_file
from vehanchor_evaluation import isaid, segments
from vehanchor_evaluation.dota import survey_dota
from vehanchor_evaluation.instance_masks import read_pixels
from vehanchor_evaluation.known_scale import FileIssue

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from vehanchor_evaluation.instance_masks import AnnotatedImage

DEFAULT_ENTRIES = 100
CATEGORIES = (
    "swimming-pool",  # these three are the paper's
    "roundabout",
    "ground-track-field",
    "soccer-ball-field",
    "tennis-court",
    "basketball-court",
    "baseball-diamond",
    "storage-tank",
)
IRREGULAR = ("swimming-pool", "roundabout")  # oversampled in the paper; by how much is ours to choose
IRREGULAR_WEIGHT = 2
MIN_SIDE_PX = 15  # of the box: below it neither a mask nor a red rectangle says much
_FILE, _MASKS = "benchmark.json", "masks"


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class BenchmarkEntry(_Record):
    """One object whose area is asked for."""

    name: str = Field(description="Image and object.")
    image: str = Field(description="Path of the image.")
    category: str = Field(description="What it is.")
    box: BoundingBox = Field(description="The box around its mask.")
    gsd_m_per_px: float = Field(gt=0, description="True scale of the image.")
    mask_area_px: int = Field(gt=0, description="Pixels of its true mask.")
    mask: str = Field(description="Picture of its true mask, relative to the benchmark's folder.")

    @property
    def area_m2(self) -> float:
        """True area, ``mask_area_px * GSD^2``."""
        return self.mask_area_px * self.gsd_m_per_px**2

    @property
    def corners(self) -> tuple[float, float, float, float]:
        """The box as a prompt: x1, y1, x2, y2."""
        return self.box.x1_px, self.box.y1_px, self.box.x2_px, self.box.y2_px


class Recipe(_Record):
    """How a benchmark is made: from what data, and which objects. The same recipe gives the same entries."""

    isaid: tuple[str, ...] = Field(default=(), description="Folders of iSAID annotations.")
    dota: tuple[str, ...] = Field(
        default=(), description="For each of them, the folder of DOTA's split that it belongs to."
    )
    segments: str | None = Field(default=None, description="Folder of an index of numbered masks, instead.")
    split: str | None = Field(default=None, description="Split of that index.")
    entries: int | None = Field(default=DEFAULT_ENTRIES, gt=0, description="How many; null takes every object.")
    seed: int = Field(default=0, ge=0, description="Of the choice.")
    categories: tuple[str, ...] | None = Field(
        default=None, description="To choose from; null takes whatever there is."
    )
    min_side_px: int = Field(
        default=MIN_SIDE_PX, gt=0, description="Shorter side of the box from which an object counts."
    )

    def annotated_images(self) -> tuple[list[AnnotatedImage], list[FileIssue]]:
        """The data.

        Returns:
            The images, and what was left out.

        Raises:
            InvalidParameterError: a folder is not what it should be.
        """
        if self.segments is not None:
            return segments.find_annotated_images(Path(self.segments), self.split)
        images, issues = [], []
        for masks, split in zip(self.isaid, self.dota, strict=True):
            found, left_out = isaid.find_annotated_images(Path(masks), survey_dota(Path(split)))
            images += found
            issues += left_out
        return images, issues


class Benchmark(_Record):
    """All entries, in an order in which categories take turns: any number of the first ones is balanced."""

    recipe: Recipe
    entries: tuple[BenchmarkEntry, ...]
    available: dict[str, int] = Field(description="Objects that there were to choose from, by category.")
    too_small: int = Field(description="Objects left out for their size.")

    def mask(self, folder: Path, entry: BenchmarkEntry) -> NDArray[np.bool_]:
        """The true mask of an entry, ``[h, w]`` bool of its box.

        Raises:
            ImageError: the picture cannot be read.
            ValueError: it is not the one that belongs to the entry.
        """
        mask = np.asarray(read_pixels(folder / entry.mask, cv2.IMREAD_GRAYSCALE) > 0)
        if int(mask.sum()) != entry.mask_area_px:
            raise ValueError(f"{folder / entry.mask} has {mask.sum()} px, the entry says {entry.mask_area_px}")
        return mask


@dataclass(frozen=True, eq=False)
class _Candidate:
    """An object that could become an entry; its mask is kept encoded."""

    image: AnnotatedImage
    instance: int
    category: str
    box: tuple[float, float, float, float]
    n_px: int
    png: bytes


def build_benchmark(
    recipe: Recipe, folder: Path, *, workers: int = 1, progress: Callable[[int, int], None] | None = None
) -> tuple[Benchmark, list[FileIssue]]:
    """Choose objects and write the benchmark.

    Within a category one object of each image is taken before any second one; images and objects come in random order.

    Args:
        recipe: what to choose from, and how.
        folder: made; an older benchmark in it is replaced.
        workers: images read at once.
        progress: called with (images read, images in all).

    Returns:
        The benchmark, as written, and what of the data was left out.

    Raises:
        InvalidParameterError: the data are not there, or there is nothing to choose from.
        OutputError: the folder cannot be written.
    """
    images, issues = recipe.annotated_images()
    images = _named_once(images, issues)
    found: dict[str, list[_Candidate]] = {category: [] for category in recipe.categories or ()}
    n_small, known = 0, set[str]()
    with ThreadPoolExecutor(workers) as pool:
        try:
            readings = pool.map(lambda image: _read_candidates(image, recipe), images)
            for done, reading in enumerate(readings, start=1):
                n_small += reading.n_small
                known |= reading.categories
                if reading.issue is not None:
                    issues.append(reading.issue)
                for candidate in reading.candidates:
                    found.setdefault(candidate.category, []).append(candidate)
                if progress is not None:
                    progress(done, len(images))
        finally:
            pool.shutdown(cancel_futures=True)
    available = {category: len(found[category]) for category in sorted(found)}
    chosen = _choose(found, quotas(available, recipe.entries), recipe.seed)
    if not chosen:
        first = f"; the first problem: {issues[0].file}: {issues[0].message}" if issues else ""
        raise InvalidParameterError(
            f"no object of category {', '.join(available) or 'any'} to choose from: the {len(images)} images have "
            f"{', '.join(sorted(known)) or 'no objects'}; {n_small} are smaller than {recipe.min_side_px} px{first}"
        )
    entries = tuple(_entry(candidate, number) for number, candidate in enumerate(chosen, start=1))
    benchmark = Benchmark(recipe=recipe, entries=entries, available=available, too_small=n_small)
    try:
        (folder / _MASKS).mkdir(parents=True, exist_ok=True)
        for entry, candidate in zip(entries, chosen, strict=True):
            (folder / entry.mask).write_bytes(candidate.png)
        with whole_file(folder / _FILE) as partial:  # last: a folder with this file is complete
            partial.write_text(benchmark.model_dump_json(indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write the benchmark to {str(folder)!r}: {error.strerror}") from None
    return benchmark, issues


def open_benchmark(
    recipe: Recipe, folder: Path, *, workers: int = 1, progress: Callable[[int, int], None] | None = None
) -> list[FileIssue]:
    """Build a benchmark, unless the folder holds the one of this recipe already.

    Returns:
        What of the data was left out; nothing where there was nothing to build.

    Raises:
        InvalidParameterError: as ``build_benchmark``, or the folder holds one of another recipe.
        OutputError: the folder cannot be written.
    """
    if not (folder / _FILE).exists():
        return build_benchmark(recipe, folder, workers=workers, progress=progress)[1]
    built = load_benchmark(folder)[0].recipe
    differing = [name for name in Recipe.model_fields if getattr(built, name) != getattr(recipe, name)]
    if differing:
        raise InvalidParameterError(
            f"{folder} holds a benchmark of other choices (they differ in {', '.join(differing)}): choose another "
            f"folder, or take it as it is with --benchmark {folder}"
        )
    return []


def load_benchmark(folder: Path) -> tuple[Benchmark, str]:
    """Read a benchmark.

    Returns:
        The benchmark and the SHA-256 of its file, by which results are tied to it.

    Raises:
        InvalidParameterError: the folder holds none, or one that this version cannot read.
    """
    path = folder / _FILE
    try:
        text = path.read_bytes()
        return Benchmark.model_validate_json(text), hashlib.sha256(text).hexdigest()
    except OSError as error:
        raise InvalidParameterError(
            f"{path}: {error.strerror}; build a benchmark with 'vehanchor evaluate area'"
        ) from None
    except ValidationError as error:
        reason = error.errors()[0]
        raise InvalidParameterError(f"{path} is not a benchmark: {reason['loc']}: {reason['msg']}") from None


def quotas(available: Mapping[str, int], n_entries: int | None) -> dict[str, int]:
    """How many entries each category gets: irregular ones twice as many, none more than it has.

    What a small category cannot give goes to the others by the same weights; what is left over by rounding goes to the
    largest remainders.

    Args:
        available: objects by category.
        n_entries: in all; None for every object.

    Returns:
        Entries by category, in the order of ``available``; they sum to ``n_entries``, or to all there is.
    """
    if n_entries is None:
        return dict(available)
    given = dict.fromkeys(available, 0)
    left = min(n_entries, sum(available.values()))
    while left:
        open_ = [category for category in available if given[category] < available[category]]
        total = sum(map(_weight, open_))
        shares = {category: left * _weight(category) / total for category in open_}
        wanted = {category: int(share) for category, share in shares.items()}
        for category in sorted(open_, key=lambda name: wanted[name] - shares[name])[: left - sum(wanted.values())]:
            wanted[category] += 1
        for category in open_:
            given[category] += min(wanted[category], available[category] - given[category])
        left = min(n_entries, sum(available.values())) - sum(given.values())
    return given


def _weight(category: str) -> int:
    return IRREGULAR_WEIGHT if category in IRREGULAR else 1


def _named_once(images: list[AnnotatedImage], issues: list[FileIssue]) -> list[AnnotatedImage]:
    """Entries are told apart by their image's name: of two with the same name the second is an issue."""
    first: dict[str, AnnotatedImage] = {}
    for image in images:
        if image.name in first:
            message = f"{first[image.name].path} has the same name: only that one is used"
            issues.append(FileIssue(image.path, "duplicate_name", message))
        first.setdefault(image.name, image)
    return list(first.values())


class _Reading(NamedTuple):
    """Objects of an image that may become entries, how many are too small, all categories in it, what went wrong."""

    candidates: list[_Candidate]
    n_small: int = 0
    categories: frozenset[str] = frozenset()
    issue: FileIssue | None = None


def _read_candidates(image: AnnotatedImage, recipe: Recipe) -> _Reading:
    if not image.path.is_file():
        return _Reading([], issue=FileIssue(image.path, "no_image", "annotated, but there is no such file"))
    try:
        masks = image.read_masks()
    except (OSError, ValueError) as error:
        return _Reading([], issue=FileIssue(image.path, "unreadable_masks", str(error)))
    wanted = [mask for mask in masks if recipe.categories is None or mask.category in recipe.categories]
    large = [mask for mask in wanted if min(mask.mask.shape) >= recipe.min_side_px]
    candidates = [
        _Candidate(image, mask.instance, mask.category, mask.box, int(mask.mask.sum()), _png(mask.mask))
        for mask in large
    ]
    return _Reading(candidates, len(wanted) - len(large), frozenset(mask.category for mask in masks))


def _png(mask: NDArray[np.bool_]) -> bytes:
    return bytes(cv2.imencode(".png", mask.astype(np.uint8) * 255, [cv2.IMWRITE_PNG_BILEVEL, 1])[1].tobytes())


def _choose(found: Mapping[str, list[_Candidate]], wanted: Mapping[str, int], seed: int) -> list[_Candidate]:
    by_category = []
    for index, category in enumerate(wanted):
        generator = np.random.default_rng([seed, index])
        turns: Counter[str] = Counter()
        queue: list[tuple[int, int, _Candidate]] = []
        for place in generator.permutation(len(found[category])):
            candidate = found[category][place]
            turns[candidate.image.name] += 1
            queue.append((turns[candidate.image.name], len(queue), candidate))
        queue.sort(key=lambda item: item[:2])
        by_category.append([candidate for _, _, candidate in queue[: wanted[category]]])
    longest = max(map(len, by_category), default=0)
    return [queue[turn] for turn in range(longest) for queue in by_category if turn < len(queue)]


def _entry(candidate: _Candidate, number: int) -> BenchmarkEntry:
    x1, y1, x2, y2 = candidate.box
    return BenchmarkEntry(
        name=f"{candidate.image.name}-{candidate.instance}",
        image=str(candidate.image.path.resolve()),
        category=candidate.category,
        box=BoundingBox(x1_px=x1, y1_px=y1, x2_px=x2, y2_px=y2),
        gsd_m_per_px=candidate.image.gsd_m_per_px,
        mask_area_px=candidate.n_px,
        mask=f"{_MASKS}/{number:04d}.png",
    )
