"""The examples with language models run as for a user, against a stand-in for the real APIs.

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
    """Complete a call for strict mode: a model passes null for arguments without a value."""
    tools = json.loads((ROOT / "schemas" / "openai.json").read_text(encoding="utf-8"))
    (tool,) = [tool for tool in tools if tool["name"] == call.name]
    names = tool["parameters"]["required"]
    return ToolCall(call.name, {name: call.arguments.get(name) for name in names})


STRICT = [filled(call) for call in CALLS]


@pytest.fixture(scope="session")
def with_mcp_2() -> Path:
    """Python of one environment for all examples with mcp 2: they must work beside each other."""
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
    """Run an example with our command on its PATH, without the rest of the caller's environment."""
    commands = str(Path(sys.executable).parent)
    kept = ("HOME", "LANG", "TMPDIR")
    inherited = {name: os.environ[name] for name in kept if name in os.environ}
    return subprocess.run(
        [str(python), str(EXAMPLES / script), str(IMAGE), QUESTION, *options],
        env={**inherited, "PATH": f"{commands}:{os.environ['PATH']}", **settings},
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
    """Return the variables with which an example asks the stand-in."""
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
    """Check that the server measured, and that its result reached the model and came back."""
    assert done.returncode == 0, done.stderr
    assert stand_in.tool_names() == {
        "estimate_gsd",
        "measure_area",
        "measure_distance",
        "view_image",
    }
    assert len(stand_in.requests) == len(stand_in.calls) + 1
    assert stand_in.n_pictures() == 1, "the model gets the picture of view_image"
    answer = done.stdout.rpartition("The tool says:")[2]
    assert re.search(r"area_m2|[\d.]+ m2", answer)


def _check_transcript(done: subprocess.CompletedProcess[str], n_calls: int) -> None:
    first_words = [line.split()[0] for line in done.stdout.splitlines() if line]
    kinds = [word for word in first_words if word in ("asked", "calls", "tool", "says")]
    assert kinds == ["asked", *["calls", "tool"] * n_calls, "says"], done.stdout
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
def test_a_missing_key_or_model_is_named(
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
    # Nothing listens on port 9.
    nowhere = {"API_KEY": KEY, "MODEL": "model", "BASE_URL": "http://127.0.0.1:9"}
    settings = {f"{prefix}_{name}": value for name, value in nowhere.items()}
    done = run_example(with_mcp_2, script, "--way", way, **settings)
    assert done.returncode == 1
    assert "the API gives no answer: Connection error" in done.stderr.splitlines()[-1]
    assert f"{prefix}_BASE_URL" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("stand_in", [CALLS], indirect=True, ids=["all tools"])
def test_a_langchain_agent_measures(with_mcp_1: Path, stand_in: StandIn) -> None:
    script = "frameworks/langchain_agent.py"
    _check_answer(run_example(with_mcp_1, script, **variables(script, stand_in)), stand_in)


def test_langchain_still_needs_an_environment_of_its_own(with_mcp_1: Path) -> None:
    version = subprocess.run(
        [str(with_mcp_1), "-c", "from importlib.metadata import version; print(version('mcp'))"],
        capture_output=True,
        text=True,
        check=True,
    )
    # With version 2, one environment is enough for all examples.
    assert version.stdout.startswith("1.")


@pytest.mark.parametrize("stand_in", [CALLS], indirect=True, ids=["all tools"])
@pytest.mark.parametrize("script", ["pydantic_ai_agent.py", "google_adk_agent.py"])
def test_an_agent_of_another_framework_measures(
    with_mcp_2: Path, stand_in: StandIn, script: str
) -> None:
    done = run_example(with_mcp_2, f"frameworks/{script}", **variables(script, stand_in))
    _check_answer(done, stand_in)


@pytest.mark.parametrize("name", ["claude_tool_use", "openai_tool_use"])
def test_the_transcript_is_of_its_script(name: str) -> None:
    transcript = (ROOT / "docs" / "transcripts" / f"{name}.txt").read_text(encoding="utf-8")
    assert f"$ python examples/{name}.py " in transcript
    assert re.search(r"^tool  0\.\d+ m/px", transcript, flags=re.MULTILINE)
    assert KEY not in transcript
