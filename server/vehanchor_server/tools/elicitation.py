"""A question back to the person at the client, where a scale is not to be used and a word of theirs would help.

Protocol 2026-07-28 has it as a result that asks for input: the client asks its person, and sends the same call again
with the answer. Nothing is kept between the two: the second call does its own search, with the answer among its
arguments. Clients of older revisions, and those that cannot ask, get the low answer at once.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from mcp.server.elicitation import render_elicitation_schema
from mcp.types import ElicitRequest, ElicitRequestFormParams, ElicitResult, InputRequiredResult
from mcp_types.version import is_version_at_least
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from vehanchor.errors import KnownLengthError
from vehanchor.options import KnownLength
from vehanchor.scale.defaults import REGIONS
from vehanchor_server.errors import CallError
from vehanchor_server.tools.option_field import limits_field
from vehanchor_server.tools.scale_question import KnownLine

if TYPE_CHECKING:
    from mcp.server.mcpserver import Context

    from vehanchor.records import GsdEstimate
    from vehanchor_server.tools.scale_question import ScaleQuestion

_KEY = "scale"  # of the one question
_SINCE = "2026-07-28"
_PLACES = {
    "pixels": "pixels of the image of {} x {} px",
    "fraction": "fractions 0 to 1 of its width and height",
    "per_mille": "thousandths of its width and height",
}


class _Help(BaseModel):
    """All that can be answered; what the caller has said already is not asked."""

    model_config = ConfigDict(extra="forbid", str_strip_whitespace=True)

    region: Literal[REGIONS] | None = Field(None, title="Region", description="Where it was taken.")  # type: ignore[valid-type]
    height_m: Annotated[float | None, limits_field("height_m")] = Field(
        None,
        title="Height, m",
        description="Of the camera above the ground, if it looked down.",
    )
    focal_35mm: Annotated[float | None, limits_field("focal_35mm")] = Field(
        None,
        title="Focal length, mm",
        description="With the height: as on 35 mm film, if the file does not tell it.",
    )
    known_length: str | None = Field(
        None, max_length=200, title="Known length", description="A straight line on the ground: X1 Y1 X2 Y2 METRES"
    )


def ask_for_help(
    ctx: Context[Any, Any], question: ScaleQuestion, estimate: GsdEstimate, answer: str
) -> InputRequiredResult | None:
    """Ask for what would make a scale one to be used; None where it is one, or where nobody can be asked (again).

    Args:
        ctx: of the call.
        question: the caller's, without what has been answered.
        estimate: its answer.
        answer: that in words.
    """
    form = _form(question, estimate)
    if estimate.status == "ok" or not form["properties"] or ctx.input_responses is not None or not _can_ask(ctx):
        return None
    message = f"{answer} Do you know any of this? Leave empty what you do not know; without an answer, that one stands."
    request = ElicitRequest(params=ElicitRequestFormParams(message=message, requested_schema=form))
    return InputRequiredResult(input_requests={_KEY: request})


def with_the_persons_answer(ctx: Context[Any, Any], question: ScaleQuestion) -> ScaleQuestion:
    """The caller's question with what a person answered to ``ask_for_help``; unchanged without an answer.

    Raises:
        CallError: ``invalid_answer``, an answer has no meaning.
    """
    answered = (ctx.input_responses or {}).get(_KEY)
    if not isinstance(answered, ElicitResult) or answered.action != "accept":
        return question
    given = {name: value for name, value in (answered.content or {}).items() if value not in (None, "")}
    try:
        told = _Help.model_validate(given)
        lines = (_line(told.known_length),) if told.known_length else question.known_lengths
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        raise _without_meaning(f"{first['loc'][0]}: {first['msg']}") from error
    except KnownLengthError as error:
        raise _without_meaning(f"known_length: {error}") from error
    known = told.model_dump(exclude={"known_length"}, exclude_none=True)
    return replace(question, **known, known_lengths=lines)


def _without_meaning(complaint: str) -> CallError:
    return CallError("invalid_answer", f"{complaint}. Call again, and give it as an argument, or answer anew.")


def _form(question: ScaleQuestion, estimate: GsdEstimate) -> dict[str, Any]:
    """The JSON Schema of what the caller has not said, and what would help this image."""
    form = render_elicitation_schema(_Help)
    fields: dict[str, Any] = form["properties"]
    if question.region is not None or question.reference_length_m is not None or estimate.n_vehicles == 0:
        del fields["region"]
    if question.height_m is not None:
        del fields["height_m"]
    if question.height_m is not None or question.focal_35mm is not None:
        del fields["focal_35mm"]
    if question.known_lengths:
        del fields["known_length"]
    else:
        size = question.frame
        width_px, height_px = (
            (size.width_px, size.height_px) if size else (estimate.image_width_px, estimate.image_height_px)
        )
        places = _PLACES[question.coordinates].format(width_px, height_px)
        fields["known_length"]["description"] += f", its ends in {places}."
    return form


def _line(text: str) -> KnownLine:
    line = KnownLength.from_text(text)
    return KnownLine(x1=line.x1, y1=line.y1, x2=line.x2, y2=line.y2, metres=line.metres)


def _can_ask(ctx: Context[Any, Any]) -> bool:
    """Whether the client speaks a protocol in which it can be asked, and has said that it can show a form."""
    version, capabilities = ctx.protocol_version, ctx.client_capabilities
    asks = capabilities.elicitation if capabilities is not None else None
    if version is None or asks is None or not is_version_at_least(version, _SINCE):
        return False
    return asks.form is not None or asks.url is None  # a bare capability means forms, as before there were others
