"""Page data besides the record: the image and the shapes over it.

The data is in the result's ``_meta``, which hosts hide from the model (MCP Apps, 2026-01-26, "Data
Passing").
"""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import FailFast, Field

from vehanchor.records import AreaMeasurement, GsdEstimate
from vehanchor.records.advice import advice_for
from vehanchor.records.contradiction import contradiction_of
from vehanchor.records.text import by_hand_text, with_capital
from vehanchor_server.base_model import FrozenModel

if TYPE_CHECKING:
    from pydantic import BaseModel

    from vehanchor.pictures.evidence import ScaleEvidence

PANEL_KEY = "vehanchor/panel"

# Largest drawing: more shapes would delay the page.
MAX_VEHICLES = 2000
MAX_LINES = 500


class DrawnLine(FrozenModel):
    """A line that a ruler measured."""

    points: Annotated[tuple[tuple[float, float], ...], FailFast()]
    label: str
    closed: bool


class Drawing(FrozenModel):
    """Shapes over the image, in pixels of the full image.

    Attributes:
        vehicles: for each vehicle, x and y of the centre, length, width, angle in degrees, 1 for a
            measured one or 0 for an outlier, its number in ``drop``, and 1 for an added one or 0;
            best first.
        vehicles_left_out: number of vehicles beyond the limit.
        lines: lines of other rulers.
        length_over_width: proportions of the detector's boxes; None if vehicles are excluded.
    """

    vehicles: Annotated[
        tuple[tuple[float, float, float, float, float, int, int, int], ...], FailFast()
    ]
    vehicles_left_out: int
    lines: Annotated[tuple[DrawnLine, ...], FailFast()]
    length_over_width: Annotated[float, Field(gt=0)] | None


def panel_meta(
    picture: bytes | None = None,
    drawing: Drawing | None = None,
    record: dict[str, Any] | None = None,
    shown: BaseModel | None = None,
) -> dict[str, Any]:
    """Build the ``_meta`` of a result; all data is null if the host shows no pages.

    Args:
        picture: the reduced image as JPEG.
        drawing: shapes over the image; None for a stated scale.
        record: the whole record, if the result is compact.
        shown: the record that the page shows; a sentence for people states the basis of its scale,
            or what the scale lacks. ``reason`` is the problem of an estimate that is not usable,
            and ``contradiction`` the text of the batch table's column.
    """
    names = ("picture_jpeg", "drawing", "record", "sentence", "reason", "contradiction")
    data: dict[str, Any] = dict.fromkeys(names)
    data["record"] = record
    if picture is not None:
        data["picture_jpeg"] = base64.b64encode(picture).decode()
    if drawing is not None:
        data["drawing"] = drawing.model_dump(mode="json")
    if shown is not None:
        data["sentence"] = _sentence_for_people(shown)
        data["reason"] = _reason_for_people(shown)
        _add_contradiction(data, shown)
    return {PANEL_KEY: data}


def _add_contradiction(data: dict[str, Any], shown: BaseModel) -> None:
    """State both scales of a contradiction; of a usable result, in the sentence, too."""
    if not isinstance(shown, AreaMeasurement | GsdEstimate):
        return
    contradiction = contradiction_of(shown)
    if contradiction is None:
        return
    data["contradiction"] = contradiction.text
    if shown.status != "ok":
        return
    parts = [contradiction.text]
    if contradiction.premise:
        parts.append(f"Safe to use {contradiction.premise}")
    data["sentence"] = ". ".join([*parts, data["sentence"]])


def _sentence_for_people(record: BaseModel) -> str | None:
    """State the basis of a scale, or what it lacks; None for a record without a scale."""
    if isinstance(record, AreaMeasurement):
        estimate = record.estimate
        if not record.mask_area_px:
            return "No object found."
        if record.status != "ok" and (estimate is None or estimate.status == "ok"):
            return "The outline is doubtful: look at it, or draw a tight box around the object."
        if record.scale_source == "file":
            return "Measured with the file's own scale."
        advice = advice_for(estimate)
    elif isinstance(record, GsdEstimate):
        estimate = record
        advice = advice_for(record)
    else:
        return None
    if estimate is None:
        return "Measured with the given scale."
    if advice is None:
        words = f"measured from {', '.join(ruler.label for ruler in estimate.probable_rulers)}"
    else:
        helps = advice.in_words({"drop": "drop the boxes that are not cars"})
        words = f"{advice.why}; {helps}"
    sentence = f"{with_capital(words)}."
    corrections = by_hand_text(estimate)
    if corrections:
        sentence += f" Vehicles corrected {corrections}."
    return sentence


def _reason_for_people(record: BaseModel) -> str | None:
    """Name the problem of an estimate; None for a usable one, and for other records."""
    advice = advice_for(record) if isinstance(record, GsdEstimate) else None
    return None if advice is None else with_capital(advice.why)


def drawing_of(analysis: ScaleEvidence) -> Drawing:
    """Collect the shapes behind an estimate, rounded to a tenth of a pixel."""
    import numpy as np  # late, to start the server quickly

    detections = analysis.detections
    boxes = detections.boxes[:MAX_VEHICLES]
    angles_deg = np.rad2deg(boxes[:, 4])
    rows = np.round(np.column_stack([boxes[:, :4], angles_deg]), 1)
    vehicles = []
    for row, kept, number, added in zip(
        rows.tolist(), analysis.kept, detections.numbers, detections.stated, strict=False
    ):
        x, y, length, width, angle = row
        flags = (int(kept), int(number), int(added))
        vehicles.append((x, y, length, width, angle, *flags))
    lines = []
    for mark in analysis.marks[:MAX_LINES]:
        points = []
        for x, y in mark.points:
            points.append((round(float(x), 1), round(float(y), 1)))
        lines.append(DrawnLine(points=tuple(points), label=mark.label, closed=mark.closed))
    length_over_width = None
    if analysis.vehicles is not None:
        length_over_width = analysis.vehicles.card.errors.boxes.length_over_width
    return Drawing(
        vehicles=tuple(vehicles),
        vehicles_left_out=len(detections.boxes) - len(boxes),
        lines=tuple(lines),
        length_over_width=length_over_width,
    )
