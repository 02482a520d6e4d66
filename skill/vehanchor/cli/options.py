"""Options that several commands share: the models, the reference length, how an image is read."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.detection.detector import Detector

__all__ = [
    "BandsOption",
    "CalibrationOption",
    "ClassOption",
    "DetectorOption",
    "MinScoreOption",
    "ProviderOption",
    "ReferenceLengthOption",
    "RegionOption",
    "ThreadsOption",
    "open_detector",
]

DetectorOption = Annotated[
    str | None,
    typer.Option(metavar="FILE", help="ONNX oriented-box model, or the name of a bundled one. Default: the bundled."),
]
ClassOption = Annotated[
    list[str] | None,
    typer.Option("--class", metavar="NAME", help="Class, by name or index, that counts as a vehicle; may be repeated."),
]
MinScoreOption = Annotated[
    float | None, typer.Option(metavar="P", help="Lowest detection score, 0 to 1. Default: the model's.")
]
ReferenceLengthOption = Annotated[
    float | None, typer.Option(metavar="M", help="Modal vehicle length, metres. Default: the model's.")
]
RegionOption = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="Take the model's reference length of a region: europe, north_america, ..."),
]
CalibrationOption = Annotated[
    str | None, typer.Option(metavar="FILE", help="Take the reference length that 'vehanchor calibrate' measured.")
]
BandsOption = Annotated[
    tuple[int, int, int] | None,
    typer.Option(metavar="R G B", help="Bands to take as red, green and blue, from 1. Default: the first three."),
]
ThreadsOption = Annotated[
    int | None, typer.Option(metavar="N", help="CPU threads; the result is the same with any. Default: all cores.")
]
ProviderOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="ONNX Runtime execution provider, in order of preference. Default: CPUExecutionProvider.",
    ),
]


def open_detector(
    model: str | None,
    classes: Sequence[str] | None,
    *,
    threads: int | None = None,
    providers: Sequence[str] | None = None,
) -> Detector:
    """The detector that ``DetectorOption`` and ``ClassOption`` name."""
    from vehanchor.detection.detector import Detector
    from vehanchor.models.session import DEFAULT_PROVIDERS
    from vehanchor.models.zoo import resolve_model

    wanted = [int(name) if name.isdecimal() else name for name in classes] if classes else None
    return Detector(resolve_model(model), classes=wanted, threads=threads, providers=providers or DEFAULT_PROVIDERS)
