"""MkDocs hooks: insert the model cards, and the figure of the page of results."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mkdocs.structure.files import File

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

_ROOT = Path(__file__).parent.parent
_BUNDLED = _ROOT / "skill" / "vehanchor" / "models" / "bundled"
_FIGURE = _ROOT / "research" / "results" / "calibration.svg"


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the figure that the page of results shows beside itself."""
    files.append(File.generated(config, _FIGURE.name, abs_src_path=str(_FIGURE)))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace ``<!-- model cards -->`` by the cards of all bundled models.

    Their headings are one level lower.
    """
    if "<!-- model cards -->" not in markdown:
        return markdown
    cards = [card.read_text(encoding="utf-8") for card in sorted(_BUNDLED.glob("*.md"))]
    lowered = [re.sub(r"^#", "##", card, flags=re.MULTILINE) for card in cards]
    return markdown.replace("<!-- model cards -->", "\n\n".join(lowered))
