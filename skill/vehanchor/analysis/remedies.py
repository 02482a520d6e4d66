"""Expected gains of remedies: what the posterior would be with one further fact.

Each remedy is a hypothetical witness, or the removal of one. It agrees with the likeliest scale,
and has the errors that such a witness usually has. The posterior with it shows whether the remedy
would make the scale usable, and how narrow the interval would be.

Followed with the truth, in a third of 1,905 photographs of known scale: of 280 that a measured
length was expected to make usable, 257 became so, of 76 by a line over bays 72, all of them right;
of 17 that were not expected to become usable, none did.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.errors import VehAnchorError
from vehanchor.imagery.metadata.lens import lens
from vehanchor.options import KnownLength
from vehanchor.options.reading import CoordinateFrame
from vehanchor.records import ExpectedGain
from vehanchor.rulers.active import allowed_rulers
from vehanchor.rulers.camera import Camera
from vehanchor.rulers.height import GivenHeight
from vehanchor.rulers.known_length import KnownLengths
from vehanchor.rulers.reference import unmeasured_region
from vehanchor.rulers.vehicles import Vehicles, vehicle_witness
from vehanchor.scale.defaults import PROBABLY_RIGHT, USABLE_CHANCE
from vehanchor.scale.density import GRID, lognormal, product, shifted

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence
    from typing import TypeAlias

    from vehanchor.options import Rulers
    from vehanchor.options.rulers import Basis
    from vehanchor.records import Remedy
    from vehanchor.rulers.ruler import Ruler, View
    from vehanchor.rulers.vehicles import VehicleWitness
    from vehanchor.scale.posterior import Answer, Lack, Witness

    Witnesses: TypeAlias = Sequence[Witness]

    Decide: TypeAlias = Callable[[Witnesses], Answer | None]
    """Decision on the scale by witnesses without common doubts."""

# Likeliest scale of an image that shows none, metres per pixel. Without evidence, all scales have
# the same gain.
_USUAL_GSD_M_PER_PX = 0.1
# What a caller may recognise beside cars: a row of parking bays; elsewhere, two things of exact
# size that differ in kind. The names of the catalogue, and metres.
_BAYS = {"4 x parking_bay_width/DE": 10.0}
_THINGS = {"iso_container_40ft": 12.192, "tennis_court_length": 23.77}
# Assumed lines beyond which a further one hardly helps: they are wrong together.
_MAX_ASSUMED_LINES = 2
# Length of a line that the caller measures, pixels; the height and the lens of a usual drone.
# Choices, on which the gain hardly depends.
_LINE_PX = 300.0
_HEIGHT_M = 100.0
_FOCAL_35MM = 24.0
# Number of clear cars in other photographs of the flight. A choice.
_CARS_ELSEWHERE = 5
# Most vehicles that are named by their numbers.
_MAX_NAMED = 6


class _Remedied(NamedTuple):
    """Witnesses with one further fact, or without some vehicles.

    Attributes:
        remedy: what the caller would do.
        witnesses: those that there would be.
        vehicles: numbers of the vehicles that it is about.
    """

    remedy: Remedy
    witnesses: Witnesses
    vehicles: tuple[int, ...] = ()


def expected_gains(
    view: View, witnesses: Witnesses, decided: Answer | None, decide: Decide
) -> tuple[ExpectedGain, ...]:
    """Compute what each remedy would bring, the best first.

    Args:
        view: view of the image.
        witnesses: of all rulers, without the doubts that they have in common.
        decided: the answer; None if no ruler found anything.
        decide: adds the common doubts to witnesses, and decides.

    Returns:
        One entry for each remedy that this image and the caller's options allow.
    """
    gsd = _likeliest_scale(witnesses, decided)
    gains = []
    for remedied in _remedied(view, witnesses, gsd, decide):
        answer = decide(remedied.witnesses)
        if answer is None:
            continue
        gain = ExpectedGain(
            remedy=remedied.remedy,
            confidence=answer.chance,
            gsd_ci95_ratio=answer.interval.high / answer.interval.low,
            vehicles=remedied.vehicles,
        )
        gains.append(gain)
    return tuple(sorted(gains, key=_rank))


def _rank(gain: ExpectedGain) -> tuple[bool, float]:
    """Rank remedies: those that lead to a usable scale by its width, the others by confidence."""
    if gain.confidence >= USABLE_CHANCE:
        return False, gain.gsd_ci95_ratio
    return True, -gain.confidence


def _likeliest_scale(witnesses: Witnesses, decided: Answer | None) -> float:
    """Find the mode of the posterior; without a scale, that of the priors."""
    if decided is not None:
        density = decided.density
    else:
        priors = [witness.density for witness in witnesses if witness.found]
        if not priors:
            return _USUAL_GSD_M_PER_PX
        density = product(*priors)
    return float(np.exp(GRID[int(np.argmax(density))]))


def _remedied(view: View, witnesses: Witnesses, gsd: float, decide: Decide) -> Iterator[_Remedied]:
    """List the remedies with their hypothetical witnesses.

    Args:
        view: as in ``expected_gains``.
        witnesses: as in ``expected_gains``.
        gsd: scale with which they agree, metres per pixel.
        decide: as in ``expected_gains``.
    """
    allowed = {ruler.kind for ruler in allowed_rulers(view.options.rulers)}
    vehicles = vehicle_witness(witnesses)
    has_cars = vehicles is not None and vehicles.found
    if KnownLengths.kind in allowed:
        measured = _measured_line(view, gsd)
        yield from _with_lines("length", view, witnesses, [measured])
        lines = view.options.rulers.known_lengths
        n_assumed = sum(line.basis == "assumed" for line in lines)
        if n_assumed < _MAX_ASSUMED_LINES:
            things = _lines_over(_BAYS if has_cars else _THINGS, view, gsd)
            yield from _with_lines("line" if has_cars else "things", view, witnesses, things)
    if GivenHeight.kind in allowed:
        yield from _with_height(view, witnesses, gsd)
    if vehicles is not None:
        yield from _with_vehicles(view, vehicles, witnesses, gsd=gsd)
        yield from _without_vehicles(vehicles, witnesses, decide)


def _measured_line(view: View, gsd: float) -> KnownLength:
    """Draw a measured line of the right length."""
    return _line(view, _LINE_PX, metres=_LINE_PX * gsd, basis="measured")


def _lines_over(things: Mapping[str, float], view: View, gsd: float) -> list[KnownLength]:
    """Draw a line of the right length over each thing."""
    return [_line(view, metres / gsd, metres=name) for name, metres in things.items()]


def _line(
    view: View, length_px: float, *, metres: float | str, basis: Basis = "assumed"
) -> KnownLength:
    """Draw a line across the middle of the image, in pixels of the caller's copy.

    Args:
        view: view of the image.
        length_px: its length, pixels of the image.
        metres: its length on the ground, or the name of a thing.
        basis: how the length is known.
    """
    coordinates = CoordinateFrame(view.options.frame, view.image.grid)
    x_factor, y_factor = coordinates.unit_of_copy_px
    x = view.image.width_px / x_factor / 2
    y = view.image.height_px / y_factor / 2
    reach = length_px / x_factor / 2
    return KnownLength(x - reach, y, x + reach, y, metres=metres, basis=basis)


def _with_lines(
    remedy: Remedy, view: View, witnesses: Witnesses, lines: Sequence[KnownLength]
) -> Iterator[_Remedied]:
    """Add lines to those of the caller."""
    known_lengths = (*view.options.rulers.known_lengths, *lines)
    rulers = replace(view.options.rulers, known_lengths=known_lengths)
    yield from _measured_anew(remedy, view, witnesses, KnownLengths(), rulers)


def _with_height(view: View, witnesses: Witnesses, gsd: float) -> Iterator[_Remedied]:
    """State a measured height, unless the caller or the file states one."""
    options = view.options.rulers
    has_height = options.height_m is not None and options.height_basis == "measured"
    by_file = any(witness.kind == Camera.kind and witness.found for witness in witnesses)
    if has_height or by_file:
        return
    camera = view.image.camera if options.metadata else None
    focal_35mm = options.focal_35mm
    if lens(view.image, camera, focal_35mm) is None:
        focal_35mm = _FOCAL_35MM
    rulers = replace(
        options,
        height_m=_HEIGHT_M,
        height_basis="measured",
        height_tolerance_m=None,
        focal_35mm=focal_35mm,
    )
    for remedied in _measured_anew("height", view, witnesses, GivenHeight(), rulers):
        *others, height = remedied.witnesses
        yield remedied._replace(witnesses=[*others, _moved_to(gsd, height)])


def _moved_to(gsd: float, witness: Witness) -> Witness:
    """Move the scale of a witness that measured one."""
    assert witness.gsd_m_per_px is not None
    assert witness.right is not None
    offset = math.log(witness.gsd_m_per_px / gsd)
    return replace(witness, gsd_m_per_px=gsd, right=shifted(witness.right, offset))


def _measured_anew(
    remedy: Remedy, view: View, witnesses: Witnesses, ruler: Ruler, rulers: Rulers
) -> Iterator[_Remedied]:
    """Measure with a ruler and further facts, in place of its witness; the new one is the last."""
    options = replace(view.options, rulers=rulers)
    try:
        witness = ruler.measure(replace(view, options=options))
    except VehAnchorError:
        # In a tilted view the line would lie beyond the horizon.
        return
    if witness is None or not witness.found:
        return
    others = [other for other in witnesses if other.kind != ruler.kind]
    yield _Remedied(remedy, [*others, witness])


def _with_vehicles(
    view: View, vehicles: VehicleWitness, witnesses: Witnesses, *, gsd: float
) -> Iterator[_Remedied]:
    """Add a car, name the region, or add the cars of other photographs."""
    card = view.card
    clear_cars = replace(
        vehicles,
        gsd_m_per_px=gsd,
        right=lognormal(gsd, card.reference_length_sd_m / card.reference_length_m),
        chance_wrong=card.errors.vehicles.chance_wrong,
        guess=None,
        lacks=(),
        n=_CARS_ELSEWHERE,
    )
    yield _Remedied("images", _with(clear_cars, witnesses))
    if not vehicles.found:
        return
    for lack in vehicles.lacks:
        if lack.reason == "too_few":
            yield _Remedied("add", _with(_without_lack(vehicles, lack), witnesses))
    region_is_open = vehicles.reference.source in ("model", "appearance")
    if region_is_open and not unmeasured_region(card, view.options.reference):
        yield _Remedied("region", _with(vehicles.in_known_region(), witnesses))


def _without_vehicles(
    vehicles: VehicleWitness, witnesses: Witnesses, decide: Decide
) -> Iterator[_Remedied]:
    """Drop doubtful vehicles that another ruler contradicts, or those that may not be cars."""
    if not vehicles.found:
        return
    nothing = replace(
        vehicles,
        gsd_m_per_px=None,
        right=None,
        guess=None,
        lacks=(),
        notices=(),
    )
    others_set_scale = any(
        witness.found and witness.sets_scale for witness in witnesses if witness is not vehicles
    )
    if others_set_scale:
        seen = [witness for witness in witnesses if witness is vehicles or not witness.sets_scale]
        by_sight = decide(seen)
        if by_sight is not None and by_sight.chance < PROBABLY_RIGHT:
            numbers = tuple(vehicles.fleet.detections.numbers[vehicles.fleet.kept].tolist())
            if len(numbers) > _MAX_NAMED:
                numbers = ()
            yield _Remedied("drop", _with(nothing, witnesses), numbers)
        return
    for lack in vehicles.lacks:
        # A rival group of other lengths.
        if lack.reason == "disagree":
            yield _Remedied("drop", _with(_without_lack(vehicles, lack), witnesses))


def _without_lack(vehicles: VehicleWitness, lack: Lack) -> VehicleWitness:
    """Take a weakness from the vehicles."""
    without = lack.without
    return replace(
        vehicles,
        right=without.right,
        chance_wrong=without.chance_wrong,
        guess=without.guess,
    )


def _with(vehicles: VehicleWitness, witnesses: Witnesses) -> Witnesses:
    """Replace the witness of the vehicles."""
    return [vehicles if witness.kind == Vehicles.kind else witness for witness in witnesses]
