"""Images whose scale is known, and the files that could not be taken, each with the reason."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import InvalidParameterError, VehAnchorError
from vehanchor.options import ImageLimits

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

DATASET_LIMITS = ImageLimits(max_bytes=2 << 30, max_pixels=500_000_000)
"""Benchmark images are the user's own, not a stranger's: DOTA's largest have 20,000 x 20,000 px."""

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".avif")


class KnownScaleImage(NamedTuple):
    """An image and its true scale.

    Attributes:
        path: the image.
        gsd_m_per_px: its true ground sampling distance.
        set: the set it belongs to, or an empty string.
        split: ``train``, ``val`` or an empty string.
        labelled_vehicles: number of labelled small vehicles, None where unknown.
        labels: its file of DOTA labels, None where there is none.
        gsd_log_sd: standard deviation of the log of that scale; 0 for one that is taken to be exact.
    """

    path: Path
    gsd_m_per_px: float
    set: str = ""
    split: str = ""
    labelled_vehicles: int | None = None
    labels: Path | None = None
    gsd_log_sd: float = 0.0


class FileIssue(NamedTuple):
    """A fault of one file of the data.

    Attributes:
        file: the file.
        reason: stable word for the kind, as in ``no_gsd``; codes of ``vehanchor.errors`` for images.
        message: what was found.
        skipped: whether the image is left out; else it is used without what is wrong.
    """

    file: Path
    reason: str
    message: str
    skipped: bool = True


@dataclass(frozen=True)
class KnownScaleSet:
    """The contents of a folder, a table or a list of files.

    Attributes:
        source: the folder, table or files, in words.
        images: those of known scale, in a fixed order.
        issues: files that could not be taken, or not whole.
    """

    source: str
    images: tuple[KnownScaleImage, ...]
    issues: tuple[FileIssue, ...] = ()

    def chosen(
        self, *, set_name: str | None = None, split: str | None = None, limit: int | None = None
    ) -> KnownScaleSet:
        """The images of one set, of one split, and of those the first few; None takes all."""
        images = [
            image
            for image in self.images
            if (set_name is None or image.set == set_name) and (split is None or image.split == split)
        ]
        return replace(self, images=tuple(images[:limit]))

    def without_duplicates(self) -> KnownScaleSet:
        """Each file once; what is named again becomes an issue."""
        first: dict[Path, KnownScaleImage] = {}
        issues = list(self.issues)
        for image in self.images:
            if image.path in first:
                issues.append(FileIssue(image.path, "duplicate_name", "named more than once: only the first is used"))
            first.setdefault(image.path, image)
        return replace(self, images=tuple(first.values()), issues=tuple(issues))


def image_files(folder: Path) -> list[Path]:
    """All files below a folder with an image's suffix, sorted by their path."""
    return sorted(path for path in folder.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file())


def files_of(paths: Sequence[Path]) -> list[Path]:
    """Every image once: files as they are named, of folders all images below them.

    Raises:
        InvalidParameterError: a path does not exist.
    """
    files: list[Path] = []
    for path in paths:
        if not path.exists():
            raise InvalidParameterError(f"no file or folder at {str(path)!r}")
        files += image_files(path) if path.is_dir() else [path]
    return list(dict.fromkeys(files))


def labels_beside(image: Path) -> Path | None:
    """Labels of an image, where they usually are: in ``labels/`` or ``labelTxt*/`` beside its folder, or in its own."""
    name = f"{image.stem}.txt"
    around = image.parent.parent
    for folder in (around / "labels", *sorted(around.glob("labelTxt*"), reverse=True), image.parent):
        if (folder / name).is_file():
            return folder / name
    return None


@contextmanager
def naming(file: Path) -> Iterator[None]:
    """Name the file in errors that end a run over many.

    Raises:
        VehAnchorError: of the kind that was raised.
    """
    try:
        yield
    except VehAnchorError as error:
        raise type(error)(f"{file}: {error}") from error
