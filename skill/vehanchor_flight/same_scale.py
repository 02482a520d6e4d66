"""Test of the claim that photographs have one scale.

Photographs that state their own scales can contradict the claim: by their georeferences, by their
cameras' heights and lenses, by the ratios of their overlaps, or by what each of them measures by
itself. One scale is right for all of them only if they differ by less than the tolerance of a
usable scale.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, NoReturn

import numpy as np

from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.metadata.lens import lens_without_zoom
from vehanchor.records.notices import NoticeCode
from vehanchor.records.text import significant
from vehanchor.rulers.camera import coarsening
from vehanchor.rulers.vehicles import Vehicles
from vehanchor.scale.density import TOLERANCE
from vehanchor.scale.lengths import MIN_KDE_VEHICLES, Z95
from vehanchor.scale.reliability import GEOREFERENCE_LOG_SD, LEVEL_SD_M

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vehanchor_flight.components import Component
    from vehanchor_flight.photograph import Photograph

# Two scales contradict each other beyond this many standard deviations of their difference. With
# three, one of 370 pairs does by chance. A choice.
_CONTRADICTING_SDS = 3.0
# Two scales within a usable scale's tolerance are one.
_MAX_LOG_RATIO = math.log1p(TOLERANCE)
_MAX_NAMES = 3  # Of a group, in the message.


class Claim(NamedTuple):
    """Scale of one photograph by one source.

    Attributes:
        name: of the photograph.
        scale: metres per pixel, or a multiple of them that is unknown and common to a source.
        log_sd: standard deviation of its log, without errors that the photographs have in common.
    """

    name: str
    scale: float
    log_sd: float


def check_same_scale(members: Sequence[Photograph], grounds: Sequence[Component]) -> None:
    """Refuse the claim that photographs have one scale if they contradict it.

    Args:
        members: the photographs.
        grounds: components into which the overlaps link them, with indices of members.

    Raises:
        InvalidParameterError: two groups of photographs have different scales.
    """
    _check("their georeferences", _known(_by_georeference, members))
    by_height = _known(by_height_and_lens, members)
    by_lens = _known(_by_lens, members)
    _check("the heights and lenses in their metadata", by_height)
    # Without all heights, the claim is that all were taken from one.
    if len(by_height) < len(by_lens):
        _check("the lenses in their metadata", by_lens, is_relative=True)
    for ground in grounds:
        _check("their overlaps", _by_overlaps(ground, members), is_relative=True)
    _check("the rulers of each photograph alone", _known(_by_itself, members))


def _known(
    claim_of: Callable[[Photograph], Claim | None], members: Sequence[Photograph]
) -> list[Claim]:
    """List what a source claims of those photographs of which it knows the scale."""
    claims = [claim_of(member) for member in members]
    return [claim for claim in claims if claim is not None]


def _by_georeference(photograph: Photograph) -> Claim | None:
    gsd = photograph.view.image.georeference_gsd_m_per_px
    if gsd is None or gsd <= 0:
        return None
    return Claim(photograph.name, gsd, GEOREFERENCE_LOG_SD)


def _by_lens(photograph: Photograph) -> Claim | None:
    """Take the angle of a pixel, which is the scale from a height of one metre."""
    image = photograph.view.image
    rulers = photograph.view.options.rulers
    if image.camera is None or not rulers.metadata:
        return None
    optics = lens_without_zoom(image, image.camera, rulers.focal_35mm)
    if optics is None:
        return None
    # Pictures of one camera with different zooms have different scales, whether or not its maker
    # counts the zoom into the focal length.
    pixels = optics.pixels * max(image.camera.digital_zoom, 1.0)
    coarser = 1.0
    tilt_log_sd = 0.0
    plane = photograph.view.plane
    if plane is not None:
        coarser, tilt_log_sd = coarsening(plane.tilt_deg)
    log_sd = math.hypot(optics.log_sd, tilt_log_sd)
    return Claim(photograph.name, coarser / pixels, log_sd)


def by_height_and_lens(photograph: Photograph) -> Claim | None:
    """Compute the scale by height and lens; errors that photographs share do not count."""
    by_lens = _by_lens(photograph)
    if by_lens is None:
        return None
    stated_m = photograph.view.options.rulers.height_m
    if stated_m is not None:
        return by_lens._replace(scale=by_lens.scale * stated_m)
    camera = photograph.view.image.camera
    assert camera is not None  # It has a lens.
    if camera.height_m is None or camera.height_m <= 0:
        return None
    scale = by_lens.scale * camera.height_m
    log_sd = math.hypot(by_lens.log_sd, LEVEL_SD_M / camera.height_m)
    return Claim(photograph.name, scale, log_sd)


def _by_overlaps(ground: Component, members: Sequence[Photograph]) -> list[Claim]:
    claims = []
    for k, index in enumerate(ground.members.tolist()):
        scale = math.exp(ground.offsets[k])
        log_sd = float(ground.log_sds[k])
        claim = Claim(members[index].name, scale, log_sd)
        claims.append(claim)
    return claims


def _by_itself(photograph: Photograph) -> Claim | None:
    """Take a photograph's own scale, if it is usable and does not rest on a few vehicles."""
    own = photograph.analysis.estimate
    low = own.gsd_ci95_low_m_per_px
    high = own.gsd_ci95_high_m_per_px
    if own.status != "ok" or own.gsd_m_per_px is None or not low or not high:
        return None
    n_vehicles = own.n_vehicles or 0
    if own.leading_ruler == Vehicles.kind and n_vehicles < MIN_KDE_VEHICLES:
        return None
    log_sd = math.log(high / low) / (2 * Z95)
    return Claim(photograph.name, own.gsd_m_per_px, log_sd)


def check_straight_down(members: Sequence[Photograph]) -> None:
    """Refuse the claim that an oblique film has one scale, because no view of it has.

    Raises:
        InvalidParameterError: a frame of a video was taken with a tilted camera; or half of the
            frames with vehicles show by these that the camera was tilted.
    """
    frames = [member for member in members if member.is_frame]
    for frame in frames:
        tilt = frame.analysis.estimate.tilt
        if tilt is not None:
            _refuse_oblique(f"the camera was tilted by {tilt.tilt_deg:.0f} degrees in {frame.name}")
    with_vehicles = [frame for frame in frames if frame.analysis.estimate.n_vehicles]
    suspected = [frame for frame in with_vehicles if _seems_tilted(frame)]
    if suspected and 2 * len(suspected) >= len(with_vehicles):
        _refuse_oblique(
            f"the vehicles grow to one side in {suspected[0].name}, so the camera was tilted"
        )


def _seems_tilted(photograph: Photograph) -> bool:
    warnings = photograph.analysis.estimate.warnings
    return any(notice.code == NoticeCode.TILT_SUSPECTED for notice in warnings)


def _refuse_oblique(why: str) -> NoReturn:
    raise InvalidParameterError(
        f"same_scale: {why}, and an oblique picture has another scale at each place. Use a part of "
        "the film that looks straight down, or leave out same_scale"
    )


def _check(source: str, claims: Sequence[Claim], *, is_relative: bool = False) -> None:
    """Compare the photographs by one source.

    Args:
        source: what states the scales, in words.
        claims: of the photographs that it knows.
        is_relative: whether it knows the ratios of the scales only.

    Raises:
        InvalidParameterError: two of them contradict each other.
    """
    ordered = sorted(claims, key=_scale)
    log_scales = np.log([claim.scale for claim in ordered])
    log_sds = np.array([claim.log_sd for claim in ordered], dtype=np.float64)
    differences = np.abs(log_scales[:, None] - log_scales)
    sds = np.hypot(log_sds[:, None], log_sds)
    is_contradiction = (differences > _MAX_LOG_RATIO) & (differences > _CONTRADICTING_SDS * sds)
    if not is_contradiction.any():
        return
    groups = _groups(_under_one_folder(ordered))
    described = [_described(group, groups[0], is_relative=is_relative) for group in groups]
    raise InvalidParameterError(
        f"same_scale: by {source}, these photographs do not have one scale. "
        f"{'; '.join(described)}. Give each group alone, or leave out same_scale"
    )


def _scale(claim: Claim) -> float:
    return claim.scale


def _under_one_folder(claims: Sequence[Claim]) -> list[Claim]:
    """Leave out of the names the folder that all of them have."""
    folders = [claim.name.split("/")[:-1] for claim in claims]
    n_common = 0
    # Folders are compared level by level, up to the end of the shortest path.
    for names in zip(*folders, strict=False):
        if len(set(names)) > 1:
            break
        n_common += 1
    relative = []
    for claim in claims:
        parts = claim.name.split("/")[n_common:]
        relative.append(claim._replace(name="/".join(parts)))
    return relative


def _groups(ordered: Sequence[Claim]) -> list[list[Claim]]:
    """Divide claims into groups of nearly the same scale.

    Args:
        ordered: the claims, the finest first.
    """
    groups: list[list[Claim]] = []
    for claim in ordered:
        if groups and _is_of_group(claim, groups[-1]):
            groups[-1].append(claim)
        else:
            groups.append([claim])
    return groups


def _is_of_group(claim: Claim, group: Sequence[Claim]) -> bool:
    """Test whether a claim has about the scale of the finest one of a group."""
    finest = group[0]
    log_ratio = math.log(claim.scale / finest.scale)
    return log_ratio <= _MAX_LOG_RATIO


def _described(group: Sequence[Claim], finest: Sequence[Claim], *, is_relative: bool) -> str:
    """State the scale of a group, and name its first photographs."""
    scale = _middle(group)
    if is_relative:
        text = f"{significant(scale / _middle(finest))} times the finest scale"
    else:
        text = f"{significant(scale)} m/px"
    names = ", ".join(claim.name for claim in group[:_MAX_NAMES])
    n_more = len(group) - _MAX_NAMES
    if n_more > 0:
        names += f" and {n_more} more"
    return f"{text}: {names}"


def _middle(group: Sequence[Claim]) -> float:
    return group[len(group) // 2].scale
