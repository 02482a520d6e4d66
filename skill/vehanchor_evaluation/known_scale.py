"""Images of known scale, and issues of files that could not be used."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import InvalidParameterError, VehAnchorError
from vehanchor.imagery.formats.header import SUFFIXES
from vehanchor.options import ImageLimits, Reading

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

DATASET_READING = Reading(limits=ImageLimits(max_bytes=2 << 30, max_pixels=500_000_000))
"""Limits for benchmark images, which users trust; the largest in DOTA have 20,000 x 20,000 px."""


class KnownScaleImage(NamedTuple):
    """Image and its true scale.

    Attributes:
        path: path of the image.
        gsd_m_per_px: its true ground sampling distance.
        set: name of its set, or an empty string.
        split: ``train``, ``val`` or an empty string.
        labelled_vehicles: number of labelled small vehicles; None if unknown.
        labels: its file of DOTA labels; None without one.
        gsd_log_sd: standard deviation of the log of the true GSD; 0 if it counts as exact.
    """

    path: Path
    gsd_m_per_px: float
    set: str = ""
    split: str = ""
    labelled_vehicles: int | None = None
    labels: Path | None = None
    gsd_log_sd: float = 0.0


class FileIssue(NamedTuple):
    """Problem with one file of the data.

    Attributes:
        file: the file.
        reason: stable code such as ``no_gsd``; for images the code of the error in
            ``vehanchor.errors``.
        message: description of the problem.
        skipped: whether the image is left out; otherwise it is used without the faulty part.
    """

    file: Path
    reason: str
    message: str
    skipped: bool = True


@dataclass(frozen=True)
class KnownScaleSet:
    """Images of known scale from a folder, a table or a list of files.

    Attributes:
        source: name of the folder, table or files.
        images: images of known scale, in a fixed order.
        issues: files that could not be used, or only in part.
    """

    source: str
    images: tuple[KnownScaleImage, ...]
    issues: tuple[FileIssue, ...] = ()

    def select(
        self,
        *,
        set_name: str | None = None,
        split: str | None = None,
        limit: int | None = None,
    ) -> KnownScaleSet:
        """Select images by set, split and number; None selects all."""
        images = list(self.images)
        if set_name is not None:
            images = [image for image in images if image.set == set_name]
        if split is not None:
            images = [image for image in images if image.split == split]
        return replace(self, images=tuple(images[:limit]))

    def without_duplicates(self) -> KnownScaleSet:
        """Keep each file once; repeated files become issues."""
        first: dict[Path, KnownScaleImage] = {}
        issues = list(self.issues)
        for image in self.images:
            if image.path in first:
                message = "listed more than once; only the first is used"
                issues.append(FileIssue(image.path, "duplicate_name", message))
            else:
                first[image.path] = image
        images = tuple(first.values())
        return replace(self, images=images, issues=tuple(issues))


def image_files(folder: Path) -> list[Path]:
    """List all files below a folder with an image suffix, sorted by path."""
    images = []
    for path in folder.rglob("*"):
        suffix = path.suffix.lower()
        # The suffix is checked first, so that other files cost no look at the disk.
        if suffix in SUFFIXES and path.is_file():
            images.append(path)
    return sorted(images)


def files_of(paths: Sequence[Path]) -> list[Path]:
    """List distinct images: the given files, and all images below the given folders.

    Raises:
        InvalidParameterError: a path does not exist.
    """
    files: list[Path] = []
    for path in paths:
        if not path.exists():
            raise InvalidParameterError(f"no file or folder at {str(path)!r}")
        if path.is_dir():
            files += image_files(path)
        else:
            files.append(path)
    # A file can also lie in a folder that is given.
    return list(dict.fromkeys(files))


def labels_beside(image: Path) -> Path | None:
    """Find the labels of an image in ``labels/`` or ``labelTxt*/`` beside its folder, or in it."""
    parent = image.parent.parent
    versions = sorted(parent.glob("labelTxt*"), reverse=True)
    for folder in (parent / "labels", *versions, image.parent):
        labels = folder / f"{image.stem}.txt"
        if labels.is_file():
            return labels
    return None


@contextmanager
def naming(file: Path) -> Iterator[None]:
    """Add the file's name to errors that end a run over many files.

    Raises:
        VehAnchorError: the original kind of error.
    """
    try:
        yield
    except VehAnchorError as error:
        raise type(error)(f"{file}: {error}") from error
