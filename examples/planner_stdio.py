"""A planner that decides a landing: it launches the VehAnchor server, measures candidate zones, and acts on the record.

    python examples/planner_stdio.py examples/scenes/safe.jpg --zone 255 160 535 470

No language model takes part, so that the rules are plain to see; a planner with one should keep them all the same:

1. Nothing is decided on a scale with ``confidence`` < 0.5 or without one: try the next anchor, else hold altitude.
2. A zone fits only if the *lower* end of its 95 % interval does: ``inscribed_diameter_ci95_low_m``, never the estimate.
3. Every decision says why, on stderr; the decision itself is one JSON object on stdout.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from mcp import Client, StdioServerParameters

FALLBACK_CONFIDENCE = 0.5
ALTITUDE_ERROR = 0.10  # share of the height above ground that a barometer may be off by

WHAT_HELPS = {  # by the record's reason
    "too_coarse": "fly lower",
    "too_few": "climb, or fly on to a street, and look again",
    "not_cars": "another anchor is needed here",
    "disagree": "another anchor is needed here",
    "lost": "fly on to streets or houses, and look again",
    "imprecise": "take in cars, or give a known length",
}

log = logging.getLogger("planner")


class Action(StrEnum):
    """What the craft does next."""

    LAND = "land"
    NEXT_ZONE = "next_zone"
    HOLD_ALTITUDE = "hold_altitude"


@dataclass(frozen=True)
class Craft:
    """The vehicle that wants to land."""

    diameter_m: float
    margin_m: float

    @property
    def needed_m(self) -> float:
        """Diameter of the free circle it needs: its own and the margin on either side."""
        return self.diameter_m + 2 * self.margin_m


@dataclass(frozen=True)
class Zone:
    """A candidate, as the perception stack proposes it: a box in pixels of the image."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float


@dataclass(frozen=True)
class Ruler:
    """A source of scale: the vehicles in the image, or a scale known from elsewhere and how wrong it may be."""

    name: str
    gsd_m_per_px: float | None = None
    relative_error: float = 0.0


@dataclass(frozen=True)
class Decision:
    """An action and why; what was measured where that decided it."""

    action: Action
    reason: str
    anchor: str | None = None
    zone: Zone | None = None
    needed_m: float | None = None
    diameter_low_m: float | None = None
    center_x_px: float | None = None
    center_y_px: float | None = None


def judge(record: dict[str, Any], anchor: Ruler, zone: Zone, craft: Craft) -> Decision:
    """Decide on one zone by one record of ``measure_area``; HOLD_ALTITUDE where the anchor cannot be trusted."""
    if record["status"] == "no_scale":
        return Decision(Action.HOLD_ALTITUDE, f"no scale from {anchor.name}: nothing to measure by", anchor.name, zone)
    confidence = record["confidence"]  # null for a scale that was given
    if confidence is not None and confidence < FALLBACK_CONFIDENCE:
        reason_code = record["estimate"]["reason"]
        why = f"{reason_code}; {WHAT_HELPS[reason_code]}"
        reason = f"confidence {confidence:.2f} of the scale from {anchor.name} is below {FALLBACK_CONFIDENCE}: {why}"
        return Decision(Action.HOLD_ALTITUDE, reason, anchor.name, zone)
    low = record["inscribed_diameter_ci95_low_m"]
    if record["status"] != "ok" or low is None:
        return Decision(Action.NEXT_ZONE, "the zone's outline is not clear in the image", anchor.name, zone)
    low *= 1 - anchor.relative_error
    seen = f"a circle of at least {low:.1f} m fits by {anchor.name} (estimate {record['inscribed_diameter_m']:.1f} m)"
    center = record["inscribed_center"]
    measured = (anchor.name, zone, craft.needed_m, low, center["x_px"], center["y_px"])
    if low < craft.needed_m:
        return Decision(Action.NEXT_ZONE, f"too small: {seen}, {craft.needed_m:.1f} m needed", *measured)
    return Decision(Action.LAND, f"{seen}, {craft.needed_m:.1f} m needed", *measured)


async def decide(
    client: Client,
    image: Path,
    zones: Sequence[Zone],
    anchors: Sequence[Ruler],
    craft: Craft,
    region: str | None = None,
) -> Decision:
    """Go through the anchors, and for each through the zones, until one allows a landing or all are rejected."""
    decision = Decision(Action.HOLD_ALTITUDE, "no zone was proposed")
    for number, anchor in enumerate(anchors):
        if number:
            log.info("trying the next anchor: %s", anchor.name)
        for zone in zones:
            arguments: dict[str, Any] = {
                "image": {"kind": "path", "path": str(image.resolve())},
                "target": {"box": asdict(zone)},
                "detail": "full",
            }
            if anchor.gsd_m_per_px is not None:
                arguments["gsd_m_per_px"] = anchor.gsd_m_per_px
            elif region is not None:
                arguments["region"] = region
            result = await client.call_tool("measure_area", arguments)
            if result.is_error:  # "code: what is wrong. what to do"
                message = " ".join(getattr(part, "text", "") for part in result.content)
                return Decision(Action.HOLD_ALTITUDE, f"the measurement failed: {message}", anchor.name, zone)
            decision = judge(result.structured_content or {}, anchor, zone, craft)
            log.info("%s: %s", decision.action, decision.reason)
            if decision.action is Action.LAND:
                return decision
            if decision.action is Action.HOLD_ALTITUDE:
                break  # the anchor is of no use for any zone
        else:
            return decision  # every zone was measured with this anchor, and none fits
    return decision


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Decide a landing with VehAnchor's measurements.")
    parser.add_argument("image", type=Path)
    parser.add_argument("--zone", type=float, nargs=4, action="append", metavar=("X1", "Y1", "X2", "Y2"), default=[])
    parser.add_argument("--diameter", type=float, default=4.0, help="the craft's, rotors included, metres")
    parser.add_argument("--margin", type=float, default=2.0, help="to keep free on either side, metres")
    parser.add_argument("--region", help="whose cars they are, as in europe; name it where cars are small: south_asia")
    parser.add_argument("--altitude", type=float, help="next anchor: height above ground by the barometer, metres")
    parser.add_argument("--focal", type=float, help="the camera's focal length in pixels, with --altitude")
    return parser.parse_args()


async def main() -> None:
    """Launch the server, decide, print the decision."""
    options = _arguments()
    logging.basicConfig(level=logging.WARNING, format="%(name)s: %(message)s", stream=sys.stderr)
    log.setLevel(logging.INFO)
    anchors = [Ruler("vehicles in the image")]
    if options.altitude is not None and options.focal is not None:
        anchors.append(Ruler("barometer", options.altitude / options.focal, ALTITUDE_ERROR))
    zones = [Zone(*corners) for corners in options.zone]
    craft = Craft(options.diameter, options.margin)
    server = StdioServerParameters(
        command=sys.executable, args=["-m", "vehanchor", "serve", "--root", str(options.image.resolve().parent)]
    )
    async with Client(server) as client:
        decision = await decide(client, options.image, zones, anchors, craft, options.region)
    log.info("decision: %s, because %s", decision.action, decision.reason)
    print(json.dumps({name: value for name, value in asdict(decision).items() if value is not None}))


if __name__ == "__main__":
    asyncio.run(main())
