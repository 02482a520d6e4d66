"""MkDocs hook: insert the model cards."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

_BUNDLED = Path(__file__).parent.parent / "skill" / "vehanchor" / "models" / "bundled"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace ``<!-- model cards -->`` by the cards of all bundled models.

    Their headings are one level lower.
    """
    if "<!-- model cards -->" not in markdown:
        return markdown
    cards = [card.read_text(encoding="utf-8") for card in sorted(_BUNDLED.glob("*.md"))]
    lowered = [re.sub(r"^#", "##", card, flags=re.MULTILINE) for card in cards]
    return markdown.replace("<!-- model cards -->", "\n\n".join(lowered))
