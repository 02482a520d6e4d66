"""The examples with language models, as a user runs them, against a stand-in that speaks the real APIs.

They run in environments of their own (``tests/needs.py``), with our server as the command on the
PATH.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import ROOT
from tests.examples.stand_in import KEY, StandIn, ToolCall
from tests.needs import environment

pytestmark = [pytest.mark.frameworks, pytest.mark.timeout(600)]

EXAMPLES = ROOT / "examples"
IMAGE = EXAMPLES / "scenes" / "safe.jpg"
QUESTION = "What is the area of the flat roof in the box from (255, 160) to (535, 470)?"
_PATH: dict[str, Any] = {"kind": "path", "path": str(IMAGE)}
_BOX = {"box": {"x_min": 255, "y_min": 160, "x_max": 535, "y_max": 470}}
_LINE = {"points": [{"x": 255, "y": 160}, {"x": 535, "y": 160}]}
VIEW = ToolCall("view_image", {"image": _PATH, "long_side_px": 512})
ESTIMATE = ToolCall("estimate_gsd", {"image": _PATH})
DISTANCE = ToolCall("measure_distance", {"image": _PATH, "lines": [_LINE]})
MEASURE = ToolCall("measure_area", {"image": _PATH, "targets": [_BOX]})
CALLS = [VIEW, ESTIMATE, DISTANCE, MEASURE]


def filled(call: ToolCall) -> ToolCall:
    """The same call in strict mode, in which a model fills in every argument, with null if it has no value."""
    tools = json.loads((ROOT / "schemas" / "openai.json").read_text(encoding="utf-8"))
    (needed,) = (tool["parameters"]["required"] for tool in tools if tool["name"] == call.name)
    arguments = {name: call.arguments.get(name) for name in needed}
    return ToolCall(call.name, arguments)


STRICT = list(map(filled, CALLS))


@pytest.fixture(scope="session")
def with_mcp_2() -> Path:
    """One environment for all that live beside mcp 2.x: that they do is part of the test."""
    frameworks = EXAMPLES / "frameworks"
    return environment(
        EXAMPLES / "requirements.txt",
        frameworks / "pydantic_ai_agent.requirements.txt",
        frameworks / "google_adk_agent.requirements.txt",
    )


@pytest.fixture(scope="session")
def with_mcp_1() -> Path:
    return environment(EXAMPLES / "frameworks" / "langchain_agent.requirements.txt")


def run_example(
    python: Path, script: str, *options: str, **settings: str
) -> subprocess.CompletedProcess[str]:
    """Run an example, with our command on its PATH and nothing of the caller's environment."""
    command = str(Path(sys.executable).parent)  # where `vehanchor` is
    inherited = {
        name: os.environ[name] for name in ("HOME", "LANG", "TMPDIR") if name in os.environ
    }
    return subprocess.run(
        [str(python), str(EXAMPLES / script), str(IMAGE), QUESTION, *options],
        env={**inherited, "PATH": f"{command}:{os.environ['PATH']}", **settings},
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )


@pytest.fixture
def stand_in(request: pytest.FixtureRequest) -> Iterator[StandIn]:
    with StandIn(request.param).listening() as server:
        yield server


def variables(script: str, stand_in: StandIn) -> dict[str, str]:
    """What tells an example to ask the stand-in."""
    if "claude" in script:
        return {
            "ANTHROPIC_API_KEY": KEY,
            "ANTHROPIC_BASE_URL": stand_in.url,
            "ANTHROPIC_MODEL": "claude-stand-in",
        }
    if "google" in script:
        return {
            "GEMINI_API_KEY": KEY,
            "GOOGLE_GEMINI_BASE_URL": stand_in.url,
            "GEMINI_MODEL": "gemini-stand-in",
        }
    return {
        "OPENAI_API_KEY": KEY,
        "OPENAI_BASE_URL": f"{stand_in.url}/v1",
        "OPENAI_MODEL": "gpt-stand-in",
    }


def _check_answer(done: subprocess.CompletedProcess[str], stand_in: StandIn) -> None:
    """The server measured, and what it measured reached the model and came back."""
    assert done.returncode == 0, done.stderr
    assert stand_in.tool_names() == {
        "estimate_gsd",
        "measure_area",
        "measure_distance",
        "view_image",
    }
    assert len(stand_in.requests) == len(stand_in.calls) + 1
    assert stand_in.n_pictures() == 1, "the model saw what view_image shows"
    said = done.stdout.rpartition("The tool says:")[2]
    assert re.search(r"area_m2|[\d.]+ m2", said)


def _check_transcript(done: subprocess.CompletedProcess[str], n_calls: int) -> None:
    kinds = [line.split()[0] for line in done.stdout.splitlines() if line]
    assert [kind for kind in kinds if kind in ("asked", "calls", "tool", "says")] == [
        "asked",
        *["calls", "tool"] * n_calls,
        "says",
    ], done.stdout
    assert re.search(r"^tool  Image of \d+ x \d+ px", done.stdout, flags=re.MULTILINE)
    assert re.search(r"^tool  0\.\d+ m/px \(95 % interval", done.stdout, flags=re.MULTILINE)
    assert re.search(r"^tool  [\d.]+ m \(95 % interval", done.stdout, flags=re.MULTILINE)
    assert re.search(r"^tool  .* m2", done.stdout, flags=re.MULTILINE)


@pytest.mark.parametrize("stand_in", [CALLS], indirect=True, ids=["all tools"])
@pytest.mark.parametrize("way", ["mcp", "schemas"])
def test_claude_measures_both_ways(with_mcp_2: Path, stand_in: StandIn, way: str) -> None:
    done = run_example(
        with_mcp_2, "claude_tool_use.py", "--way", way, **variables("claude", stand_in)
    )
    _check_answer(done, stand_in)
    _check_transcript(done, len(stand_in.calls))


@pytest.mark.parametrize("stand_in", [STRICT], indirect=True, ids=["all tools"])
@pytest.mark.parametrize("way", ["agents", "responses"])
def test_an_openai_model_measures_both_ways(with_mcp_2: Path, stand_in: StandIn, way: str) -> None:
    done = run_example(
        with_mcp_2, "openai_tool_use.py", "--way", way, **variables("openai", stand_in)
    )
    _check_answer(done, stand_in)
    _check_transcript(done, len(stand_in.calls))


@pytest.mark.parametrize(
    ("script", "settings", "missing"),
    [
        ("claude_tool_use.py", {}, "ANTHROPIC_API_KEY"),
        ("claude_tool_use.py", {"ANTHROPIC_API_KEY": KEY}, "ANTHROPIC_MODEL"),
        ("openai_tool_use.py", {}, "OPENAI_API_KEY"),
    ],
)
def test_without_a_key_or_a_model_it_says_what_to_set(
    with_mcp_2: Path, script: str, settings: dict[str, str], missing: str
) -> None:
    done = run_example(with_mcp_2, script, **settings)
    assert done.returncode == 1
    assert done.stderr.startswith(f"{missing} is not set: export {missing}=<")
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("script", "way", "prefix"),
    [
        ("claude_tool_use.py", "mcp", "ANTHROPIC"),
        ("openai_tool_use.py", "responses", "OPENAI"),
    ],
)
def test_an_unreachable_api_ends_in_a_sentence(
    with_mcp_2: Path, script: str, way: str, prefix: str
) -> None:
    # discard: nothing listens
    nowhere = {"API_KEY": KEY, "MODEL": "model", "BASE_URL": "http://127.0.0.1:9"}
    settings = {f"{prefix}_{name}": value for name, value in nowhere.items()}
    done = run_example(with_mcp_2, script, "--way", way, **settings)
    assert done.returncode == 1
    assert "the API gives no answer: Connection error" in done.stderr.splitlines()[-1]
    assert f"{prefix}_BASE_URL" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("stand_in", [CALLS], indirect=True, ids=["all tools"])
def test_a_langchain_agent_in_its_own_environment_measures(
    with_mcp_1: Path, stand_in: StandIn
) -> None:
    version = subprocess.run(
        [str(with_mcp_1), "-c", "from importlib.metadata import version; print(version('mcp'))"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert version.stdout.startswith("1.")  # once it is 2, one environment is enough
    script = "frameworks/langchain_agent.py"
    _check_answer(run_example(with_mcp_1, script, **variables(script, stand_in)), stand_in)


@pytest.mark.parametrize("stand_in", [CALLS], indirect=True, ids=["all tools"])
@pytest.mark.parametrize("script", ["pydantic_ai_agent.py", "google_adk_agent.py"])
def test_an_agent_of_another_framework_measures(
    with_mcp_2: Path, stand_in: StandIn, script: str
) -> None:
    done = run_example(with_mcp_2, f"frameworks/{script}", **variables(script, stand_in))
    _check_answer(done, stand_in)


def test_the_transcripts_are_of_these_scripts() -> None:
    for name in ("claude_tool_use", "openai_tool_use"):
        transcript = (ROOT / "docs" / "transcripts" / f"{name}.txt").read_text(encoding="utf-8")
        assert f"$ python examples/{name}.py " in transcript
        assert re.search(r"^tool  0\.\d+ m/px", transcript, flags=re.MULTILINE)
        assert KEY not in transcript
