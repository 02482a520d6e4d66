"""Distil the mean over four mirror images into one pass.

``python -m research.training.segmenter.distil ENCODER DECODER --steps N``.

The mean of a network's answers to an image and its three mirror images is better than any of them, and costs four
passes. Here the exported files ENCODER and DECODER become teacher and pupil: the pupil sees one turned or mirrored form
of a crop, and is drawn to the truth and, three times as much, to the teacher's mean. The statistics of the
normalisations stay as they are. Resumes like ``train.py``.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from research.training.loop import Recipe, Schedule, train
from research.training.segmenter.data import CROP_SIZES, Batch, BatchStream, is_dev, load_scenes, load_segments
from research.training.segmenter.loss import segmentation_loss
from research.training.segmenter.network import STRIDE_PX, Prompt, Segmentation, Segmenter
from research.training.warm_start import load_exported

if TYPE_CHECKING:
    from collections.abc import Mapping

_PEAK_RATE = 1e-4  # 4e-4 was measured to be worse than the start after 100 steps
_TIMES = 4  # a batch is seen, each time in another form: the teacher answers once
_TEACHER_SHARE = 0.75
_STATISTICS_FROM = 4  # batches


class Form(NamedTuple):
    """One of the eight ways to lay a square: transposed first, then mirrored left to right and top to bottom."""

    transposed: bool
    across: bool
    down: bool

    def of(self, images: Tensor) -> Tensor:
        """Lay ``[b, c, s, s]``."""
        laid = images.transpose(2, 3) if self.transposed else images
        dims = [dim for dim, mirrored in ((3, self.across), (2, self.down)) if mirrored]
        return laid.flip(dims) if dims else laid

    def back(self, images: Tensor) -> Tensor:
        """Undo ``of``."""
        dims = [dim for dim, mirrored in ((3, self.across), (2, self.down)) if mirrored]
        laid = images.flip(dims) if dims else images
        return laid.transpose(2, 3) if self.transposed else laid

    def of_prompt(self, prompt: Prompt) -> Prompt:
        """Lay a prompt; its image's side is that of its earlier mask."""
        side_px = STRIDE_PX * prompt.prior.shape[3]
        points = prompt.points.flip(2) if self.transposed else prompt.points
        mirrored = torch.tensor([self.across, self.down], device=points.device)
        return prompt._replace(points=torch.where(mirrored, side_px - points, points), prior=self.of(prompt.prior))


MIRRORS = tuple(Form(False, across, down) for across in (False, True) for down in (False, True))


def mirrored_mean(network: nn.Module, image: Tensor, prompt: Prompt) -> Tensor:
    """Mean logits ``[b, 1, h, w]`` of a network over the four mirror images."""
    return torch.stack([form.back(network(form.of(image), form.of_prompt(prompt)).mask) for form in MIRRORS]).mean(
        dim=0
    )


class Lesson(NamedTuple):
    """A batch, its number in the stream, and the form that the pupil sees."""

    number: int
    batch: Batch
    form: Form


@dataclass
class Lessons:
    """A stream whose batches come ``times`` times each, every time in another form."""

    stream: BatchStream
    times: int

    def __post_init__(self) -> None:
        """Start with no batch kept."""
        self._kept: tuple[int, Batch] | None = None

    def __getitem__(self, index: int) -> Lesson:
        """The same lesson whenever it is asked for."""
        number, turn = divmod(index, self.times)
        if self._kept is None or self._kept[0] != number:
            self._kept = number, self.stream[number]
        rng = np.random.default_rng([self.stream.seed, number, 1])
        code = int(rng.permutation(8)[turn % 8])
        return Lesson(number, self._kept[1], Form(bool(code & 1), bool(code & 2), bool(code & 4)))


class Teaching:
    """The loss of a pupil beside a teacher, which answers once for each batch."""

    def __init__(self, teacher: Segmenter) -> None:
        self._teacher = teacher.eval()
        self._answer: tuple[int, Tensor] | None = None

    def __call__(self, network: nn.Module, lesson: Lesson, device: torch.device) -> Mapping[str, Tensor]:
        """Loss of the masks, against the truth and against the teacher, and of the predicted IoU."""
        image = lesson.batch.image.to(device).float().div(255.0).contiguous(memory_format=torch.channels_last)
        prompt = Prompt(*(part.to(device) for part in lesson.batch.prompt))
        if self._answer is None or self._answer[0] != lesson.number:
            with torch.no_grad():
                self._answer = lesson.number, mirrored_mean(self._teacher.to(device), image, prompt).float().sigmoid()
        form = lesson.form
        found = network(form.of(image), form.of_prompt(prompt))
        found = Segmentation(found.mask.float(), found.iou.float())
        truth = segmentation_loss(found, form.of(lesson.batch.target.to(device)))
        taught = segmentation_loss(found, form.of(self._answer[1]))
        return {
            "truth": (1 - _TEACHER_SHARE) * truth.mask,
            "teacher": _TEACHER_SHARE * taught.mask,
            "iou": truth.iou,
        }


class FrozenSegmenter(Segmenter):
    """A segmenter whose normalisations keep their statistics while it learns."""

    def train(self, mode: bool = True) -> FrozenSegmenter:
        """Stay in evaluation mode, whatever is asked for: nothing else here knows the difference."""
        del mode
        super().train(False)
        return self


def load_files(network: Segmenter, encoder: Path, decoder: Path, batches: list[Batch]) -> None:
    """Put exported files back into ``network``, the normalisations' statistics from ``batches`` of one size."""
    image = torch.cat([batch.image for batch in batches]).float().div(255.0)
    prompt = Prompt(*(torch.cat(parts) for parts in zip(*(batch.prompt for batch in batches), strict=True)))
    load_exported(network.encoder, encoder, image)
    with torch.no_grad():
        load_exported(network.decoder, decoder, network.encoder(image), prompt)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("encoder", type=Path)
    parser.add_argument("decoder", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data/segments"))
    parser.add_argument(
        "--scenes", type=Path, help="folder of rendered scenes (research/training/detector/render_scenes.py)"
    )
    parser.add_argument("--run", type=Path, default=Path("runs/segmenter-distilled"))
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, help="of the processor; PyTorch's choice when left out")
    options = parser.parse_args()

    if options.threads:
        torch.set_num_threads(options.threads)
    torch.manual_seed(options.seed)
    images = [image for image in load_segments(options.data, "train") if not is_dev(image.group)]
    if options.scenes:
        images += load_scenes(options.scenes)
    stream = BatchStream(images, seed=options.seed)
    print(f"{len(images)} masks, objects: {stream.counts()}", flush=True)
    start = [stream.batch(np.random.default_rng([options.seed, k, 2]), CROP_SIZES[0]) for k in range(_STATISTICS_FROM)]
    pupil, teacher = FrozenSegmenter(), Segmenter()
    for network in (pupil, teacher):
        load_files(network, options.encoder, options.decoder, start)
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stub
    schedule = Schedule(options.steps, _PEAK_RATE, warm_up=10, last=0.02)
    recipe = Recipe(schedule, batch=None, average=0.97, weight_decay=0.0, log_every=20, checkpoint_every=20, workers=0)
    train(pupil, Lessons(stream, _TIMES), Teaching(teacher), recipe, options.run)


if __name__ == "__main__":
    main()
