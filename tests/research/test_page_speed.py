"""The speed of the page, printed for whoever reads the log of CI: a benchmark, not a limit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from research.benchmarks.page import measure_pages, table, viewer, write_photographs

pytestmark = pytest.mark.browser


def test_the_page_shows_a_photograph_before_its_answer(
    chromium: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    names = write_photographs(tmp_path, 2)
    with viewer(tmp_path) as url:
        [times] = measure_pages(chromium, [url], names)
    [only] = times
    assert 0 < only.photograph <= only.answer
    with capsys.disabled():
        print(f"\n{table([times])}")
