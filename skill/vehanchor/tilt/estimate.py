"""Where the camera looked, by all that tells it together: metadata, courts in perspective, vehicles."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from vehanchor.rulers.camera import MAX_OFF_NADIR_DEG, TILT_SD_DEG, Camera
from vehanchor.rulers.courts import CourtsEvidence
from vehanchor.rulers.known_length import GivenHeight, KnownLengths
from vehanchor.rulers.lognormal import no_evidence
from vehanchor.rulers.scene_scale import SceneScale
from vehanchor.scale.fusion import product
from vehanchor.tilt.camera_tilt import CameraTilt, plane_with
from vehanchor.tilt.court_cue import court_cues
from vehanchor.tilt.posterior import GimbalCue, tilt_posterior
from vehanchor.tilt.vehicle_cue import SURE, focal_of, vehicle_cue

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.rulers.evidence import Evidence, View
    from vehanchor.tilt.posterior import TiltCue


def estimate_tilt(said: CameraTilt | None, view: View, others: Sequence[Evidence]) -> CameraTilt | None:
    """Where the camera looked by all that tells it: metadata, courts in perspective, vehicles.

    Args:
        said: what the metadata say; None where they say nothing of a tilt.
        view: of the image, with its vehicles as they are in it.
        others: evidence of the rulers beside vehicles, those of courts with the courts.

    Returns:
        None where it looked down, or where only vehicles say otherwise: they warn (``tilt_notice``).

    Raises:
        TooObliqueError: the horizon is in sight, or the tilt is too uncertain to say that it is not.
    """
    image, camera = view.image, view.image.camera if view.options.rulers.metadata else None
    level = image.georeference_gsd_m_per_px is not None or (camera is not None and camera.off_nadir_deg is not None)
    if said is None and level:
        return None
    found = [court for other in others if isinstance(other, CourtsEvidence) for court in other.courts]
    cues: list[TiltCue] = [*court_cues(found, image.width_px, image.height_px)]
    if said is None and not cues:
        return None
    if said is not None:
        cues.insert(0, GimbalCue(said.tilt_deg, said.roll_deg, TILT_SD_DEG))
    cars = vehicle_cue(view.detections, image.width_px, image.height_px)
    if cars is not None:
        cues.append(cars)
    if said is not None and len(cues) == 1:
        return said
    focal = focal_of(image, view.options)
    posterior = tilt_posterior(cues, focal)
    if posterior is None or (said is None and posterior.chance_above(MAX_OFF_NADIR_DEG) < SURE):
        return said
    source = ", ".join(dict.fromkeys(each.kind for each in cues)) + focal.doubt
    interval = posterior.low_deg, posterior.high_deg
    looked = CameraTilt(posterior.tilt_deg, posterior.roll_deg, posterior.focal_px, source, interval)
    plane_with(looked if said else looked._replace(tilt_deg=posterior.high_deg), image, 1.0).check()
    return looked


def on_the_plane(others: Sequence[Evidence], looked: CameraTilt, view: View) -> tuple[Evidence, ...]:
    """What rulers say of the scale at the image's centre, where the camera looked aside.

    Args:
        others: evidence of the rulers beside vehicles: courts, lines and heights, told or read from metadata, are
            measured again, and the ground's own look is left out, whose network was never shown such a view.
        looked: where the camera looked.
        view: of the image.
    """
    image, camera = view.image, view.image.camera
    plane = plane_with(looked, image, 1.0)
    found: list[Evidence] = []
    for each in others:
        if isinstance(each, CourtsEvidence):
            found.append(each.on(plane))
        elif each.kind == Camera.kind and camera is not None:
            aimed = image._replace(camera=replace(camera, off_nadir_deg=looked.tilt_deg))
            found.append(Camera().look(replace(view, image=aimed)))
        elif each.kind == GivenHeight.kind:
            found.append(GivenHeight().look(view, looked.tilt_deg))
        elif each.kind == KnownLengths.kind:
            found.append(KnownLengths().look(view, plane))
        else:
            found.append(no_evidence(each.kind) if each.kind == SceneScale.kind else each)
    return tuple(found)


def expected_scale(others: Sequence[Evidence]) -> NDArray[np.float64] | None:
    """What the other rulers say of the scale at the image's centre, where the camera looked aside.

    From aside roofs, bonnets and sides of cars are found as often as whole ones, and the ground's own look, which tells
    them apart in a view from above, is left out. The camera's height or a court does it as well.

    Args:
        others: evidence on the plane, as ``on_the_plane`` gives it.

    Returns:
        ``[g]`` probabilities on ``vehanchor.scale.fusion.GRID``; None where they say nothing.
    """
    said = [each.density for each in others if each.density is not None and each.gsd_m_per_px is not None]
    return product(*said) if said else None
