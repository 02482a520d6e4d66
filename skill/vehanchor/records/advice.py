"""Advice for a scale that is not usable: the problem, and what would help.

People and models read the same remedies, each in their own words: ``IN_WORDS`` is for people, and
the server has those for models.
"""

from __future__ import annotations

from itertools import combinations, zip_longest
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.records.text import count
from vehanchor.scale.defaults import USABLE_CHANCE

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from vehanchor.records import ExpectedGain, GsdEstimate, Reason, Remedy, RulerScale

IN_WORDS: Mapping[Remedy, str] = {
    "original": "send the original image",
    "aspect": "keep its aspect ratio",
    "sides": "correct the pixel sides in the file, by one measured line along each of them",
    "nadir": "take a picture straight down",
    "lower": "fly lower, or send the full-resolution image",
    "visible": "send a file that shows the picture in other programs",
    "perspective": "send a photograph taken straight down, or a perspective view made from this "
    "image",
    "apart": "send each picture alone",
    "photograph": "send a photograph from above",
    "vehicles": "also use the ruler vehicles",
    "facts": "check the facts that you gave",
    "drop": "check what was taken for cars",
    "add": "include one more car",
    "region": "give the region",
    "line": "draw a line over parking bays or another thing of known size",
    "things": "include the cars, or draw lines over two different things of known size, if they "
    "are in sight",
    "length": "measure one length, on the ground or on a map",
    "height": "give the camera's height and focal length",
    "images": "give other photographs of the same flight, with cars",
}
"""Remedies for people, as clauses in the imperative."""

_IN_SIGHT: frozenset[Remedy] = frozenset({"drop", "add", "region", "line", "things"})
"""Remedies that need nothing but a look at the photograph."""

_MIN_GAIN = 0.1
"""Least rise of the confidence by a remedy that does not make the scale usable. A choice."""

_MAX_REMEDIES = 3
# Without a scale, nobody knows which of them the caller has.
_MAX_REMEDIES_WITHOUT_SCALE = 4


class Advice(NamedTuple):
    """Advice for a scale that is not usable.

    Attributes:
        why: the problem, a clause without a full stop.
        remedies: what would help, the best first.
        also: further help in words; empty without any.
        vehicles: numbers of the vehicles to drop; empty for none, or for many.
    """

    why: str
    remedies: tuple[Remedy, ...] = ()
    also: str = ""
    vehicles: tuple[int, ...] = ()

    @property
    def helps(self) -> str:
        """The remedies for people."""
        return self.in_words({})

    def in_words(self, special: Mapping[Remedy, str]) -> str:
        """Join the remedies for people, a clause in the imperative.

        Args:
            special: words for remedies that the caller's surface has its own means for.
        """
        in_words = {**IN_WORDS, **special}
        if self.vehicles:
            in_words["drop"] = f"drop {self.dropped}"
        words = [in_words[remedy] for remedy in self.remedies]
        if self.also:
            words.append(self.also)
        return ", or ".join(words)

    @property
    def dropped(self) -> str:
        """The vehicles to drop, with the condition: an object of "drop"."""
        numbers = ", ".join(map(str, self.vehicles))
        if len(self.vehicles) == 1:
            return f"vehicle {numbers} if it is not a car"
        return f"vehicles {numbers} if they are not cars"


def advice_for(estimate: GsdEstimate | None) -> Advice | None:
    """Find the advice for a record by its reason and by what else the record shows.

    Args:
        estimate: the record; None gives no advice.

    Returns:
        The advice; None for a usable scale.
    """
    if estimate is None or estimate.reason is None:
        return None
    for code, advice in _ADVICE_ON_IMAGES.items():
        if _warns(estimate, code):
            return advice
    if _warns(estimate, "several_scales"):
        return _VARIES if _warns(estimate, "tilt_suspected") else _SEVERAL_PICTURES
    if estimate.reason == "no_photograph":
        return _DRAWN
    if estimate.reason == "oblique":
        return _OBLIQUE
    cause = _CAUSES[estimate.reason](estimate)
    if _has_doubtful_fact(estimate) and "facts" not in cause.remedies:
        cause = cause._replace(remedies=("facts", *cause.remedies))
    return _with_gains(cause, estimate)


def _with_gains(cause: Advice, estimate: GsdEstimate) -> Advice:
    """Add to the remedies of a cause those that the posterior would gain from, the best first.

    What makes the scale usable comes before what only helps. Of both kinds, those in sight and
    those that the caller must know take turns, because a caller often has only one of them.
    """
    gains = [gain for gain in estimate.details.remedies if _helps(gain, estimate)]
    in_sight = [gain for gain in gains if gain.remedy in _IN_SIGHT]
    to_know = [gain for gain in gains if gain.remedy not in _IN_SIGHT]
    first, second = in_sight, to_know
    if not any(map(_leads, in_sight)):
        first, second = to_know, in_sight
    taking_turns = [
        gain for pair in zip_longest(first, second) for gain in pair if gain is not None
    ]
    remedies = (*cause.remedies, *(gain.remedy for gain in taking_turns))
    if not remedies:
        # More cars settle what the posterior cannot foresee, such as a stretch by few.
        remedies = ("add",) if estimate.n_vehicles else ("line",)
    limit = _MAX_REMEDIES
    if estimate.gsd_m_per_px is None:
        limit = _MAX_REMEDIES_WITHOUT_SCALE
    to_drop = [gain.vehicles for gain in gains if gain.remedy == "drop"]
    vehicles = to_drop[0] if to_drop else ()
    distinct = tuple(dict.fromkeys(remedies))
    return cause._replace(remedies=distinct[:limit], vehicles=vehicles)


def _helps(gain: ExpectedGain, estimate: GsdEstimate) -> bool:
    """Test whether a remedy is expected to make the scale usable, or much surer."""
    return _leads(gain) or gain.confidence >= estimate.confidence + _MIN_GAIN


def _leads(gain: ExpectedGain) -> bool:
    """Test whether a remedy is expected to make the scale usable."""
    return gain.confidence >= USABLE_CHANCE


# One function a reason that has several causes: it finds the cause in the record. The remedies of a
# cause come before those by the posterior's gain: nothing else helps as long as it is there.


def _too_few(estimate: GsdEstimate) -> Advice:
    why = "too little evidence"
    if estimate.n_vehicles is None:
        return Advice(why, ("vehicles",))
    if _warns(estimate, "detail_missing"):
        return _ENLARGED
    if estimate.n_vehicles == 0:
        return Advice("no car was found")
    if estimate.details.reference_source in ("model", "appearance"):
        why = f"{count(estimate.n_vehicles, 'vehicle')} alone: {why}"
    return Advice(why)


def _too_coarse(estimate: GsdEstimate) -> Advice:
    if _warns(estimate, "detail_missing"):
        return _ENLARGED
    if not estimate.n_vehicles:
        return Advice("no car was found, and the scene looks too coarse for cars", ("original",))
    if estimate.mode_length_px is None:
        return Advice("the vehicles have too little detail", ("lower",))
    return Advice(f"the vehicles are only {estimate.mode_length_px:.0f} px long", ("lower",))


def _not_cars(_: GsdEstimate) -> Advice:
    return Advice("the vehicles may not be cars", ("drop",))


def _assumed(estimate: GsdEstimate) -> Advice:
    why = "it rests on assumed facts alone"
    gains = estimate.details.remedies
    if any(gain.remedy in ("line", "things") and _helps(gain, estimate) for gain in gains):
        return Advice(why)
    return Advice(f"{why}, and a further one will not help")


def _disagreement(estimate: GsdEstimate) -> Advice:
    is_orthophoto = estimate.georeference_gsd_m_per_px is not None
    if _warns(estimate, "tilt_suspected"):
        why = "the camera was tilted by an unknown angle"
        # An orthophoto has no metadata of a camera, and nobody can take it again.
        return Advice(why, ("sides",) if is_orthophoto else ("original", "nadir"))
    if _warns(estimate, "stretched"):
        why = "the image is stretched in one direction"
        return Advice(why, ("sides",) if is_orthophoto else ("original", "aspect"))
    setting = [ruler for ruler in estimate.rulers if ruler.sets_scale]
    remedies: tuple[Remedy, ...] = ("drop",)
    if any(map(_is_fact, setting)):
        remedies = ("facts",)
    # The record of a photograph in a flight has the flight's rulers, without their warnings.
    disagree = _warns(estimate, "rulers_disagree") or _some_exclude_each_other(setting)
    if len(setting) > 1 and disagree:
        labels = " and ".join(ruler.label for ruler in setting)
        return Advice(f"{labels} contradict each other", remedies)
    # If the rulers that set the scale agree, the scene-scale prior is what contradicts them.
    scene = estimate.details.scene_scale
    if scene is None:
        return Advice("the evidence contradicts itself", remedies)
    return Advice(f"the scene suggests a scale of about {scene.gsd_m_per_px:.2g} m/px", remedies)


def _is_fact(ruler: RulerScale) -> bool:
    """Test whether a ruler rests on what the caller or the file states, or on a court."""
    return ruler.sets_scale and ruler.kind not in ("vehicles", "positions")


def _has_doubtful_fact(estimate: GsdEstimate) -> bool:
    """Test whether a fact is probably wrong, because other rulers contradict it."""
    if not _warns(estimate, "rulers_disagree"):
        return False
    return any(_is_fact(ruler) and not ruler.probably_right for ruler in estimate.rulers)


def _some_exclude_each_other(rulers: Sequence[RulerScale]) -> bool:
    """Test whether two rulers exist of which each lies outside the other's 95 % interval."""
    for first, second in combinations(rulers, 2):
        if not (_allows(first, second) or _allows(second, first)):
            return True
    return False


def _allows(ruler: RulerScale, other: RulerScale) -> bool:
    return ruler.gsd_ci95_low_m_per_px <= other.gsd_m_per_px <= ruler.gsd_ci95_high_m_per_px


def _imprecise(estimate: GsdEstimate) -> Advice:
    why = "the interval is too wide"
    if estimate.n_vehicles is None:
        return Advice(why, ("vehicles",))
    if estimate.leading_ruler == "camera":
        why = "the ground may lie higher or lower than the take-off"
        return Advice(why, also="give overlapping photographs of the flight together")
    return Advice(why)


def _warns(estimate: GsdEstimate, code: str) -> bool:
    return any(notice.code == code for notice in estimate.warnings)


_ENLARGED = Advice("the image is enlarged or blurred", ("original",))
_SEVERAL_PICTURES = Advice("the image seems to consist of several pictures", ("apart",))
# A strong tilt looks like a second scale, too.
_VARIES = Advice(
    "the scale varies over the image: it is tilted, or consists of several pictures",
    ("nadir", "apart", "original"),
)
_ADVICE_ON_IMAGES: Mapping[str, Advice] = {
    "nothing_visible": Advice("nothing can be seen in the image", ("visible",)),
    "not_perspective": Advice("the image is not one perspective view", ("perspective",)),
    "several_pictures": _SEVERAL_PICTURES,
}
"""Advice by notices about the whole image, before any other: no line there says anything about the
rest of it."""

_OBLIQUE = Advice("it is an oblique view with the horizon in it", ("nadir",))
_DRAWN = Advice("the image is drawn, not photographed", ("photograph", "line"))

_CAUSES: Mapping[Reason, Callable[[GsdEstimate], Advice]] = {
    "too_few": _too_few,
    "too_coarse": _too_coarse,
    "not_cars": _not_cars,
    "disagree": _disagreement,
    "assumed": _assumed,
    "imprecise": _imprecise,
}
