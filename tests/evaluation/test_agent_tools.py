from __future__ import annotations

from contextlib import contextmanager
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from vehanchor.errors import MissingExtraError
from vehanchor_evaluation import agent_tools
from vehanchor_evaluation.agent_tools import GROUP, open_agent_tools

if TYPE_CHECKING:
    from collections.abc import Iterator


class _Tools:
    def __init__(self, **opened: Any) -> None:
        self.opened = opened
        self.anthropic_tools: list[dict[str, Any]] = []
        self.openai_tools: list[dict[str, Any]] = []

    def call(self, name: str, arguments: dict[str, Any]) -> tuple[str, bool]:
        return f"{name} {arguments}", False


@contextmanager
def open_stand_in(roots: Any, *, detector: Any, segmenter: Any) -> Iterator[_Tools]:
    yield _Tools(roots=roots, detector=detector, segmenter=segmenter)


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> list[EntryPoint]:
    """The entry points that are installed."""
    points: list[EntryPoint] = []

    def entry_points(group: str) -> list[EntryPoint]:
        return [point for point in points if point.group == group]

    monkeypatch.setattr(agent_tools, "entry_points", entry_points)
    return points


def test_tools_are_those_that_a_distribution_registers(
    registered: list[EntryPoint], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(agent_tools, "stand_in", open_stand_in, raising=False)
    registered.append(EntryPoint("server", f"{agent_tools.__name__}:stand_in", GROUP))
    with open_agent_tools([tmp_path], detector="d.onnx") as tools:
        assert tools.call("measure_area", {"a": 1}) == ("measure_area {'a': 1}", False)
        assert isinstance(tools, _Tools)
        assert tools.opened == {"roots": [tmp_path], "detector": "d.onnx", "segmenter": None}


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (None, "no installed package has any"),
        ("no_such_package:open", "cannot be loaded .*No module named 'no_such_package'"),
        ("vehanchor_evaluation.agent_tools:no_such_thing", "cannot be loaded"),
    ],
)
def test_without_tools_an_agent_is_refused_in_words(
    registered: list[EntryPoint], value: str | None, words: str
) -> None:
    if value is not None:
        registered.append(EntryPoint("server", value, GROUP))
    with pytest.raises(MissingExtraError, match=words):
        open_agent_tools([])
