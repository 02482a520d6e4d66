"""Model cards: validated metadata of model files.

Detectors without our metadata get the paper's values.
"""

from __future__ import annotations

import ast
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic_core import from_json

from vehanchor.detection.detector_errors import DetectorErrors
from vehanchor.errors import ModelContractError
from vehanchor.scale.defaults import MAX_VEHICLE_M, MIN_VEHICLE_M, Aggregation
from vehanchor.scale.density import Votes

# Paper, section III-B.
MIN_SCORE = 0.1
# Paper, section III-F: KDE mode of the DOTA v1.5 training labels.
REFERENCE_LENGTH_M = 5.045
# The paper's sweep of +-0.5 m, taken as two standard deviations between regions.
REFERENCE_LENGTH_SD_M = 0.25
# Small vehicles in DOTA's training tiles of 1024 px.
LENGTH_RANGE_PX = (9.0, 120.0)
# Paper, section IV-D.
_REGION_RATIOS = {"europe": 4.5 / 5.045, "north_america": 5.5 / 5.045}
# Stride of the coarsest layer of every YOLO.
_STRIDE_PX = 32

# Side of a tile, which limits lengths, and strides: input sides are padded to whole strides.
_MAX_LENGTH_PX = 1024.0
_MAX_STRIDE_PX = 1024
# Largest number of characters of an entry; a thousand class names take a fiftieth of it.
_MAX_TEXT = 1 << 20
# Number of characters of a wrong entry that a message shows.
_SHOWN_TEXT = 80

_KEYS = {"class_names": "names", "licence": "license", "stride_px": "stride"}
"""Keys in the metadata that Ultralytics writes; any other field's key is ``vehanchor.<field>``."""


def _literal(text: Any) -> Any:
    """Read names by index from the repr of a Python dict or list, as Ultralytics writes it."""
    if not isinstance(text, str):
        return text
    try:
        value = ast.literal_eval(text or "{}")
    # Too many brackets raise the last two.
    except (SyntaxError, TypeError, MemoryError, RecursionError):
        raise ValueError("not a Python value") from None
    if isinstance(value, (list, tuple)):
        return dict(enumerate(value))
    return value


def _json(text: Any) -> Any:
    """Read a value from its JSON text."""
    if not isinstance(text, str):
        return text
    return from_json(text.encode(errors="replace"))


def _comma_separated(text: Any) -> Any:
    """Read a list from its text."""
    if not isinstance(text, str):
        return text
    return text.split(",")


def _rising(value: tuple[float, float]) -> tuple[float, float]:
    """Check that the first number is below the second."""
    if value[0] >= value[1]:
        raise ValueError("not rising")
    return value


_LENGTHS = f"{MIN_VEHICLE_M:g} to {MAX_VEHICLE_M:g} m"
_JSON = BeforeValidator(_json)
_LIST = BeforeValidator(_comma_separated)
_VehicleLength = Annotated[float, Field(ge=MIN_VEHICLE_M, le=MAX_VEHICLE_M)]
_VehicleSpread = Annotated[float, Field(ge=0, le=MAX_VEHICLE_M)]
_LengthPx = Annotated[float, Field(gt=0, le=_MAX_LENGTH_PX)]
_Share = Annotated[float, Field(ge=0, le=1, description="a number from 0 to 1")]
_Weight = Annotated[float, Field(ge=0, le=1000)]
_ClassIndex = Annotated[int, Field(ge=0)]


class _Card(BaseModel):
    """Frozen record of finite numbers; fields with a description are in the metadata, as text."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, coerce_numbers_to_str=True
    )


_CardT = TypeVar("_CardT", bound=_Card)


class BodyLengths(_Card):
    """Lengths of cars' bodies, bumper to bumper.

    Attributes:
        reference_length_m: usual modal length, metres.
        reference_length_sd_m: standard deviation between regions, metres.
        region_lengths_m: modal length by region, metres.
    """

    reference_length_m: _VehicleLength
    reference_length_sd_m: _VehicleSpread
    region_lengths_m: dict[str, _VehicleLength]


class DetectorCard(_Card):
    """Model card of a detector.

    Attributes:
        name: the model's name.
        sha256: checksum of the file.
        class_names: class index to name.
        reference_length_m: ``L_ref``, length in metres that corresponds to the model's modal box.
        reference_length_sd_m: standard deviation of the reference length between regions.
        region_lengths_m: reference length by region.
        length_range_px: shortest and longest vehicle in the training data, pixels.
        min_length_px: shortest length measured without bias; 0 if unknown.
        min_score: detections with a lower score are dropped.
        licence: licence of the weights, from the file.
        search_scales: whether the model should also run at reduced resolutions.
        aggregation: default rule for the modal length.
        stride_px: the sides of the input are multiples of it.
        bodies: lengths of cars' bodies; None without a chip network, when the lengths are those of
            boxes.
        verifier_sha256: checksum of the verifier's file; None without one. With a verifier,
            ``min_score`` is the verifier's.
        chips_sha256: checksum of the chip network's file; None without one.
        votes: calibration of the boxes' votes, from the errors or else from the metadata; None if
            it was never fitted, as for other people's models.
        errors: errors of the detector and of its auxiliary models.
    """

    name: Annotated[str, Field(description="a name")]
    sha256: str
    class_names: Annotated[
        dict[_ClassIndex, str],
        BeforeValidator(_literal),
        Field(description="a Python dict of class names"),
    ] = {}
    reference_length_m: Annotated[_VehicleLength, Field(description=_LENGTHS)] = REFERENCE_LENGTH_M
    reference_length_sd_m: Annotated[_VehicleSpread, Field(description="metres >= 0")] = (
        REFERENCE_LENGTH_SD_M
    )
    region_lengths_m: Annotated[
        dict[str, _VehicleLength], _JSON, Field(description=f"a JSON object of lengths, {_LENGTHS}")
    ] = {}
    length_range_px: Annotated[
        tuple[_LengthPx, _LengthPx],
        _LIST,
        AfterValidator(_rising),
        Field(description="pixels, 'shortest,longest'"),
    ] = LENGTH_RANGE_PX
    min_length_px: Annotated[float, Field(ge=0, le=_MAX_LENGTH_PX, description="pixels >= 0")] = 0.0
    min_score: _Share = MIN_SCORE
    licence: Annotated[str | None, Field(description="a name")] = None
    search_scales: Annotated[bool, Field(description="0 or 1")] = False
    aggregation: Annotated[
        Aggregation, Field(description=f"one of {', '.join(get_args(Aggregation))}")
    ] = "kde"
    stride_px: Annotated[int, Field(ge=1, le=_MAX_STRIDE_PX, description="a whole number >= 1")] = (
        _STRIDE_PX
    )
    bodies: BodyLengths | None = None
    verifier_sha256: str | None = None
    chips_sha256: str | None = None
    votes: Annotated[
        Votes | None, _JSON, Field(description="a JSON object of the fields of Votes")
    ] = None
    errors: DetectorErrors = DetectorErrors()


class AuxiliaryCard(_Card):
    """Model card of an auxiliary model.

    Attributes:
        sha256: checksum of the file.
        detector: name of the only detector for which the model is calibrated.
    """

    sha256: str
    detector: Annotated[str, Field(description="a detector's name")]


class VerifierCard(AuxiliaryCard):
    """Model card of a verifier.

    Attributes:
        weights: terms of the combined score's logit: weight of the detector's logit, weight of the
            verifier's logit, bias, and weight of the size odds (0 if it is missing).
        least_score: detections with at least this detector score are candidates.
        min_score: candidates with a lower combined score are dropped.
    """

    weights: Annotated[
        tuple[_Weight, _Weight, float] | tuple[_Weight, _Weight, float, _Weight],
        _LIST,
        Field(description="three or four numbers, 'detector,verifier,bias,size'"),
    ]
    least_score: _Share
    min_score: _Share


class ChipCard(AuxiliaryCard):
    """Model card of a chip network.

    Attributes:
        weights: terms of the combined score's logit: weight of the search's logit, weight of the
            chip network's logit, and bias. The search's logit includes the size odds.
        least_score: detections with at least this score of the search are candidates.
        bodies: lengths of cars' bodies.
    """

    weights: Annotated[
        tuple[_Weight, _Weight, float],
        _LIST,
        Field(description="three numbers, 'search,chips,bias'"),
    ]
    least_score: _Share
    bodies: Annotated[
        BodyLengths,
        _JSON,
        Field(
            description=f"a JSON object of {', '.join(BodyLengths.model_fields)}: lengths of "
            f"{_LENGTHS}"
        ),
    ]


def read_card(
    kind: type[_CardT], path: Path, sha256: str, metadata: Mapping[str, str], **defaults: str
) -> _CardT:
    """Read the model card of a file.

    Args:
        kind: type of the card.
        path: path of the file.
        sha256: checksum of the file.
        metadata: metadata of the file.
        **defaults: values of fields that the metadata may lack.

    Returns:
        The card.

    Raises:
        ModelContractError: an entry is missing or invalid.
    """
    # Fields without a description are not in the metadata.
    keys = {
        name: _KEYS.get(name, f"vehanchor.{name}")
        for name, field in kind.model_fields.items()
        if field.description
    }
    stated = {name: metadata[key] for name, key in keys.items() if key in metadata}
    wrong = next((name for name, text in stated.items() if len(text) > _MAX_TEXT), None)
    if wrong is None:
        try:
            return kind(**{**defaults, **stated, "sha256": sha256})
        except ValidationError as error:
            wrong = str(error.errors()[0]["loc"][0])
    problem = f"no metadata {keys[wrong]!r}"
    if wrong in stated:
        problem = f"metadata {keys[wrong]!r} is {stated[wrong][:_SHOWN_TEXT]!r}"
    raise ModelContractError(f"{path}: {problem}: expected {kind.model_fields[wrong].description}")


def read_detector_card(
    path: Path,
    sha256: str,
    metadata: Mapping[str, str],
    verifier: VerifierCard | None = None,
    chips: ChipCard | None = None,
    errors: DetectorErrors | None = None,
) -> DetectorCard:
    """Read the model card of a detector.

    Args:
        path: path of the file; its stem is the name of a model whose metadata have none.
        sha256: checksum of the file.
        metadata: metadata of the file.
        verifier: card of the verifier; None without one.
        chips: card of the chip network; None without one.
        errors: errors of the detector; None for the defaults.

    Returns:
        The card, with the paper's values for missing entries.

    Raises:
        ModelContractError: an entry is invalid, or an auxiliary model belongs to another detector.
    """
    card = read_card(DetectorCard, path, sha256=sha256, metadata=metadata, name=path.stem)
    values: dict[str, Any] = {
        "region_lengths_m": _paper_regions(card.reference_length_m) | card.region_lengths_m
    }
    if verifier is not None:
        _check_detector(verifier, "verifier", card=card, path=path)
        values["min_score"] = verifier.min_score
        values["verifier_sha256"] = verifier.sha256
    if chips is not None:
        _check_detector(chips, "chip network", card=card, path=path)
        values["bodies"] = chips.bodies
        values["chips_sha256"] = chips.sha256
    if errors is not None:
        values["errors"] = errors
        if errors.votes is not None:
            values["votes"] = Votes(errors.votes.at_zero, errors.votes.slope)
    return card.model_copy(update=values)


def _paper_regions(reference_length_m: float) -> dict[str, float]:
    """Compute the lengths of the paper's regions by their ratios, if they are valid."""
    lengths = {name: reference_length_m * ratio for name, ratio in _REGION_RATIOS.items()}
    return {
        name: length for name, length in lengths.items() if MIN_VEHICLE_M <= length <= MAX_VEHICLE_M
    }


def _check_detector(auxiliary: AuxiliaryCard, kind: str, card: DetectorCard, path: Path) -> None:
    """Check that an auxiliary model was calibrated for this detector.

    Raises:
        ModelContractError: it was calibrated for another one.
    """
    if auxiliary.detector != card.name:
        raise ModelContractError(
            f"the {kind} of {path} was made for the detector {auxiliary.detector!r}, but this is "
            f"{card.name!r}: remove its file, or state this name in its metadata "
            "'vehanchor.detector'"
        )
