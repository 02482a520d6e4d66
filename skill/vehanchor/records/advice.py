"""Advice for a scale that is not usable: the problem, and what would help.

People and models read the same remedies, each in their own words: ``IN_WORDS`` is for people, and
the server has those for models.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

from vehanchor.records.text import count

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from vehanchor.records import GsdEstimate, Reason, RulerScale

Remedy: TypeAlias = Literal[
    "original",
    "aspect",
    "nadir",
    "lower",
    "drop",
    "add",
    "region",
    "line",
    "thing",
    "measured",
    "facts",
    "second",
    "elsewhere",
    "vehicles",
    "visible",
    "perspective",
    "apart",
    "photograph",
]

IN_WORDS: Mapping[Remedy, str] = {
    "original": "send the original image",
    "aspect": "keep its aspect ratio",
    "nadir": "take a picture straight down",
    "lower": "fly lower, or send the full-resolution image",
    "drop": "check what was taken for cars",
    "add": "include one more car",
    "region": "give the region",
    "line": "draw a line over something of known size",
    "thing": "draw a line over something of known size, if any is in sight",
    "measured": "measure one length or the height: no further assumed fact will help",
    "facts": "check the facts that you gave, or draw a measured line",
    "second": "if they are right, measure a second length, or the height",
    "elsewhere": "give the camera's height and focal length, or another photograph of the same "
    "flight with cars",
    "vehicles": "also use the ruler vehicles",
    "visible": "send a file that shows the picture in other programs",
    "perspective": "send a photograph taken straight down, or a perspective view made from this "
    "image",
    "apart": "send each picture alone",
    "photograph": "send a photograph from above",
}
"""Remedies for people, as clauses in the imperative."""


class Advice(NamedTuple):
    """Advice for a scale that is not usable.

    Attributes:
        why: the problem, a clause without a full stop.
        remedies: what would help, the best first.
        also: further help in words; empty without any.
    """

    why: str
    remedies: tuple[Remedy, ...]
    also: str = ""

    @property
    def helps(self) -> str:
        """The remedies for people."""
        return self.in_words({})

    def in_words(self, special: Mapping[Remedy, str]) -> str:
        """Join the remedies for people, a clause in the imperative.

        Args:
            special: words for remedies that the caller's surface has its own means for.
        """
        words = [special.get(remedy, IN_WORDS[remedy]) for remedy in self.remedies]
        if self.also:
            words.append(self.also)
        return ", or ".join(words)


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
    find_cause = _CAUSES.get(estimate.reason)
    if find_cause is None:
        return _ADVICE[estimate.reason]
    return find_cause(estimate)


def region_would_help(estimate: GsdEstimate) -> bool:
    """Test whether the caller may know a measured region, which makes the scale more precise."""
    if not estimate.n_vehicles or _warns(estimate, "region_unmeasured"):
        return False
    return estimate.details.reference_source in ("model", "appearance")


# One function a reason that has several causes: it finds the cause in the record.


def _too_few(estimate: GsdEstimate) -> Advice:
    why = "too little evidence"
    if estimate.n_vehicles is None:
        return Advice(why, ("vehicles", "line"))
    # More cars do not help before the original image does.
    if _warns(estimate, "detail_missing"):
        return _ENLARGED
    if estimate.n_vehicles == 0:
        return Advice("no car was found", _without_cars(estimate))
    vehicles = count(estimate.n_vehicles, "vehicle")
    if region_would_help(estimate):
        return Advice(f"{vehicles} alone: too little evidence", ("region", "add"))
    return Advice(why, ("add", "line"))


def _without_cars(estimate: GsdEstimate) -> tuple[Remedy, ...]:
    """Choose remedies for a picture without cars, which may show nothing of known size either."""
    has_height = any(ruler.kind in ("camera", "height") for ruler in estimate.rulers)
    if has_height:
        return ("thing",)
    return ("thing", "elsewhere")


def _too_coarse(estimate: GsdEstimate) -> Advice:
    if _warns(estimate, "detail_missing"):
        return _ENLARGED
    if not estimate.n_vehicles:
        return Advice(
            "no car was found, and the scene looks too coarse for cars", ("original", "thing")
        )
    if estimate.mode_length_px is None:
        return Advice("the vehicles have too little detail", ("lower", "line"))
    return Advice(f"the vehicles are only {estimate.mode_length_px:.0f} px long", ("lower", "line"))


def _not_cars(estimate: GsdEstimate) -> Advice:
    why = "the vehicles may not be cars"
    others = [ruler for ruler in estimate.probable_rulers if ruler.kind != "vehicles"]
    # Another ruler that is not sure enough is a guess.
    return Advice(why, ("drop", "measured") if others else ("drop", "line"))


def _disagreement(estimate: GsdEstimate) -> Advice:
    is_orthophoto = estimate.georeference_gsd_m_per_px is not None
    if _warns(estimate, "tilt_suspected"):
        why = "the camera was tilted by an unknown angle"
        # An orthophoto has no metadata of a camera, and nobody can take it again.
        return Advice(why, ("line",) if is_orthophoto else ("original", "nadir"))
    if _warns(estimate, "stretched"):
        why = "the image is stretched in one direction"
        return Advice(why, ("line",) if is_orthophoto else ("original", "aspect"))
    setting = [ruler for ruler in estimate.rulers if ruler.sets_scale]
    facts = [ruler for ruler in setting if ruler.kind not in ("vehicles", "positions")]
    remedies: tuple[Remedy, ...] = ("drop", "line")
    if len(facts) > 1:
        remedies = ("facts", "elsewhere")
    elif facts:
        remedies = ("facts", "second")
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
        return Advice(why, ("vehicles", "line"))
    if estimate.leading_ruler == "camera":
        why = "the ground may lie higher or lower than the take-off"
        return Advice(why, ("line",), also="give overlapping photographs of the flight together")
    if region_would_help(estimate):
        return Advice(why, ("region", "line"))
    return Advice(why, ("line",))


def _warns(estimate: GsdEstimate, code: str) -> bool:
    return any(notice.code == code for notice in estimate.warnings)


_ENLARGED = Advice("the image is enlarged or blurred", ("original", "line"))
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

_ADVICE: Mapping[Reason, Advice] = {
    "no_photograph": Advice("the image is drawn, not photographed", ("photograph", "line")),
    "assumed": Advice("it rests on assumed facts alone", ("measured", "elsewhere")),
}
_CAUSES: Mapping[Reason, Callable[[GsdEstimate], Advice]] = {
    "too_few": _too_few,
    "too_coarse": _too_coarse,
    "not_cars": _not_cars,
    "disagree": _disagreement,
    "imprecise": _imprecise,
}
