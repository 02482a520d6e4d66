"""Elicitation: ask the user for data that would make a scale usable.

Protocol revision 2026-07-28 has a result that requests input. The client asks its user and repeats
the call with the answer. The server keeps nothing between the two calls; the second call repeats
the search with the answer among its arguments. Clients of older revisions, and those without forms,
get the low-confidence result at once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from mcp.server.elicitation import render_elicitation_schema
from mcp.types import ElicitRequest, ElicitRequestFormParams, ElicitResult, InputRequiredResult
from mcp_types.version import is_version_at_least
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from vehanchor.errors import KnownLengthError
from vehanchor.options import Basis, Rulers
from vehanchor.options.rulers import FocalLength, Height
from vehanchor.scale.countries import REGIONS
from vehanchor_server.errors import CallError

if TYPE_CHECKING:
    from mcp.server.mcpserver import Context

    from vehanchor.options.rulers import KnownLength
    from vehanchor.records import GsdEstimate
    from vehanchor_server.tools.scale_arguments import CallerOptions

_KEY = "scale"  # of the only input request
_FIRST_REVISION = "2026-07-28"
_SECOND_LINE_HELPS = ("assumed", "disagree")
_LINE_COORDINATES = {
    "pixels": "pixels of the image of {} x {} px",
    "fraction": "fractions 0 to 1 of its width and height",
    "per_mille": "thousandths of its width and height",
}


class _ScaleInput(BaseModel):
    """Fields of the form; the form omits the values that the caller gave."""

    model_config = ConfigDict(extra="forbid", str_strip_whitespace=True)

    region: Literal[REGIONS] | None = Field(  # type: ignore[valid-type]
        None, title="Region", description="Where the image was taken."
    )
    height_m: Height | None = Field(
        None, title="Height, m", description="Camera height above ground, for a nadir view."
    )
    height_basis: Basis | None = Field(
        None, title="Height known by", description="measured: above this ground."
    )
    focal_35mm: FocalLength | None = Field(
        None,
        title="Focal length, mm",
        description="With the height: 35 mm equivalent, if missing in the file.",
    )
    known_length: str | None = Field(
        None,
        max_length=200,
        title="Known length",
        description="A line on the ground: X1 Y1 X2 Y2 METRES measured (or assumed)",
    )


def request_scale_input(
    ctx: Context[Any, Any], options: CallerOptions, *, estimate: GsdEstimate, answer: str
) -> InputRequiredResult | None:
    """Ask for data that would make the scale usable.

    Args:
        ctx: the call's context.
        options: the caller's options.
        estimate: the result.
        answer: the result in words.

    Returns:
        None if the scale is usable, if the user was asked before, or if the client has no forms.
    """
    if estimate.status == "ok" or ctx.input_responses is not None or not _supports_forms(ctx):
        return None
    form = _form(options, estimate)
    if not form["properties"]:
        return None
    message = (
        f"{answer} Do you know any of these values? Leave unknown fields empty. Without "
        "an answer, this result stands."
    )
    parameters = ElicitRequestFormParams(message=message, requested_schema=form)
    return InputRequiredResult(input_requests={_KEY: ElicitRequest(params=parameters)})


def with_user_input(ctx: Context[Any, Any], options: CallerOptions) -> CallerOptions:
    """Merge the user's answer to ``request_scale_input`` into the caller's options.

    Without an answer, return the options unchanged.

    Raises:
        CallError: ``invalid_answer``, an answer is invalid.
    """
    answer = (ctx.input_responses or {}).get(_KEY)
    if not isinstance(answer, ElicitResult) or answer.action != "accept":
        return options
    content = answer.content or {}
    fields = {name: value for name, value in content.items() if value not in (None, "")}
    try:
        inputs = _ScaleInput.model_validate(fields)
        lines = _read_line(inputs.known_length)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        raise _invalid_answer(f"{first['loc'][0]}: {first['msg']}") from error
    except KnownLengthError as error:
        raise _invalid_answer(f"known_length: {error}") from error
    merged = {**options, **inputs.model_dump(exclude={"known_length"}, exclude_none=True)}
    known_lengths = (*options.get("known_lengths", ()), *lines)
    if known_lengths:
        merged["known_lengths"] = known_lengths
    return merged


def _read_line(text: Any) -> tuple[KnownLength, ...]:
    """Read the line of the form; empty without one."""
    if not text:
        return ()
    return Rulers(known_lengths=(text,)).known_lengths


def _invalid_answer(complaint: str) -> CallError:
    return CallError(
        "invalid_answer",
        f"{complaint}. Repeat the call with it as an argument, or correct the answer.",
    )


def _form(options: CallerOptions, estimate: GsdEstimate) -> dict[str, Any]:
    """Return the JSON Schema of the missing values that would help for this image."""
    form = render_elicitation_schema(_ScaleInput)
    fields: dict[str, Any] = form["properties"]
    # A region describes vehicles.
    if "region" in options or "reference_length_m" in options or not estimate.n_vehicles:
        del fields["region"]
    if "height_m" in options:
        del fields["height_m"]
        del fields["height_basis"]
    if "height_m" in options or "focal_35mm" in options:
        del fields["focal_35mm"]
    if options.get("known_lengths") and estimate.reason not in _SECOND_LINE_HELPS:
        del fields["known_length"]
        return form
    # The user gives the line in the caller's own coordinates.
    width_px = estimate.image_width_px
    height_px = estimate.image_height_px
    frame = options.get("frame")
    if frame:
        width_px = frame.width_px
        height_px = frame.height_px
    units = _LINE_COORDINATES[options.get("coordinates", "pixels")].format(width_px, height_px)
    fields["known_length"]["description"] += f", its ends in {units}."
    return form


def _supports_forms(ctx: Context[Any, Any]) -> bool:
    """Return whether the client's protocol revision and capabilities allow a form."""
    version = ctx.protocol_version
    if version is None or not is_version_at_least(version, _FIRST_REVISION):
        return False
    capabilities = ctx.client_capabilities
    if capabilities is None or capabilities.elicitation is None:
        return False
    elicitation = capabilities.elicitation
    # An empty capability means forms, the first mode of the protocol.
    return elicitation.form is not None or elicitation.url is None
