"""Random calls from a listed schema alone, and the calls of the documentation."""

from __future__ import annotations

import json
import random
import re
from typing import Any

from tests.conftest import ROOT

_TEXTS = ["car_park.jpg", "FR", "iso_container_20ft", "0.13 0.12 0.15 0.8 aa bb"]


def random_value(node: dict[str, Any], chance: random.Random) -> Any:
    """A value that the schema allows; nothing beside the schema is known."""
    if "anyOf" in node:
        return random_value(chance.choice(node["anyOf"]), chance)
    if "enum" in node:
        return chance.choice(node["enum"])
    kind = node["type"]
    if kind == "object" and "properties" not in node:
        return {}
    if kind == "object":
        names = list(node["properties"])
        optional = [name for name in names if name not in node.get("required", ())]
        n_most = min(node.get("maxProperties", len(names)) - len(names) + len(optional), len(optional))
        chosen = chance.sample(optional, chance.randint(min(node.get("minProperties", 0), n_most), n_most))
        return {
            name: random_value(node["properties"][name], chance)
            for name in names
            if name in chosen or name not in optional
        }
    if kind == "array":
        n_least = node.get("minItems", 0)
        n_items = chance.randint(n_least, min(node.get("maxItems", n_least + 3), n_least + 3))
        return [random_value(node["items"], chance) for _ in range(n_items)]
    if kind == "number":
        return chance.choice([chance.randint(1, 900), round(chance.uniform(0.1, 900), 2)])
    if kind == "integer":
        return chance.choice([chance.randint(256, 1024), 512.0])  # JSON Schema takes 512.0 for an integer
    return {"string": chance.choice(_TEXTS), "boolean": chance.random() < 0.5}[kind]


def documented_calls() -> list[tuple[str, dict[str, Any]]]:
    """The tools and arguments of all calls in the documentation and the examples' transcripts."""
    found: list[tuple[str, dict[str, Any]]] = []
    for path in [*ROOT.glob("docs/**/*.md"), ROOT / "README.md", ROOT / "server/vehanchor_server/SKILL.md"]:
        for block in re.findall(r"```json\n(.*?)\n```", path.read_text(encoding="utf-8"), re.DOTALL):
            call = json.loads(block)
            if isinstance(call, dict) and "tool" in call:
                found.append((call["tool"], call["arguments"]))
    for path in ROOT.glob("docs/transcripts/*.txt"):
        for tool, arguments in re.findall(r"^calls (\w+) (\{.*\})$", path.read_text(encoding="utf-8"), re.MULTILINE):
            found.append((tool, json.loads(arguments)))
    return found
