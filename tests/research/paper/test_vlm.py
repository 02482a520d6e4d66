from __future__ import annotations

import csv
import json
import logging
import re
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import vehanchor
from research.paper.__main__ import app
from research.paper.vlm import HINT, QUESTION, SYSTEM, draw_question
from research.paper.vlm_api import Budget, open_api, reply_journal
from tests.conftest import ROOT
from tests.models import blank_image, paint_vehicles, write_detector
from tests.research.paper.model_service import (
    ModelRequest,
    ModelService,
    Refusal,
    UseTool,
    model_service,
    red_rectangle,
)
from tests.sam_models import write_sam
from vehanchor.errors import InvalidParameterError
from vehanchor_evaluation.areas import read_areas

if TYPE_CHECKING:
    from collections.abc import Iterator

    from typer.testing import Result

KEY = "sk-very-secret-0123456789"
PROVIDERS = (pytest.param("anthropic", marks=pytest.mark.slow), "openai", "openai-compatible")
"""Each SDK takes seconds to import: one is enough for the quick tests."""
GSD = 5.045 / 29.0
BOXES = [(120, 200, 216, 296), (360, 200, 456, 296), (120, 336, 216, 432)]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three squares among cars, and models."""
    folder = tmp_path_factory.mktemp("vlm")
    image = blank_image(640, 480)
    ids = np.zeros((480, 640), np.uint8)
    for number, (x1, y1, x2, y2) in enumerate(BOXES, start=1):
        image[y1:y2, x1:x2] = (40, 140, 210)
        ids[y1:y2, x1:x2] = number
    paint_vehicles(
        image, [[60 + 70 * k, 60 + 70 * row, 29.0, 12, 0.3] for k in range(8) for row in (0, 1)]
    )
    (folder / "images").mkdir()
    cv2.imwrite(str(folder / "images" / "a.png"), image[:, :, ::-1])
    cv2.imwrite(str(folder / "a.png"), ids)
    (folder / "index.csv").write_text(
        f"image,mask,category,gsd_m_per_px\nimages/a.png,a.png,swimming-pool,{GSD}\n"
    )
    write_detector(folder / "detector.onnx")
    write_sam(folder)
    return folder


@pytest.fixture
def service(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModelService]:
    for name in ("ANTHROPIC_API_KEY", "OPENAI_API_KEY"):
        monkeypatch.setenv(name, KEY)
    for name in ("ANTHROPIC_BASE_URL", "ANTHROPIC_AUTH_TOKEN", "OPENAI_BASE_URL"):
        monkeypatch.delenv(name, raising=False)
    with model_service(ModelService()) as running:
        yield running


@pytest.fixture
def run(data: Path, service: ModelService, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Run ``python -m research.paper vlm`` against the service, into ``out`` of an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.delenv("VEHANCHOR_TRACEBACK", raising=False)

    def invoke(
        *arguments: object, provider: str = "openai-compatible", url: str | None = None
    ) -> Result:
        base = (url or service.url) + ("" if provider == "anthropic" else "/v1")
        words = ["--segments", data, "--provider", provider, "--model", "m", "--base-url", base]
        words += ["--out", "out", *arguments]
        return CliRunner().invoke(app, ["vlm", *(str(word) for word in words)])

    return invoke


def rows_of(name: str = "vlm") -> dict[str, dict[str, str]]:
    with Path(f"out/{name}.csv").open(newline="") as handle:
        return {row["entry"]: row for row in csv.DictReader(handle)}


def by_eye(request: ModelRequest) -> str:
    """Answer as a model that measures the red rectangle and knows the scale."""
    x1, y1, x2, y2 = red_rectangle(request.picture)
    return f"I see a pool.\n\n**AREA={(x2 - x1) * (y2 - y1) * GSD**2:,.3f} m²**"


# --- The question


NAMES_OF_CEILINGS = {
    "anthropic": "max_tokens",
    "openai": "max_completion_tokens",
    "openai-compatible": "max_tokens",
}


class Exchange(NamedTuple):
    """A run with a ceiling of 77 tokens, and the model's requests."""

    provider: str
    result: Result
    requests: list[ModelRequest]


@pytest.fixture(params=PROVIDERS)
def exchange(run: Any, service: ModelService, request: pytest.FixtureRequest) -> Exchange:
    """Run each provider once; the model measures the red rectangle."""
    requests: list[ModelRequest] = []

    def answer(model_request: ModelRequest) -> str:
        requests.append(model_request)
        return by_eye(model_request)

    service.answer = answer
    result = run("--max-output-tokens", 77, provider=request.param)
    assert result.exit_code == 0, result.output
    return Exchange(request.param, result, requests)


def test_the_model_gets_the_papers_question(exchange: Exchange) -> None:
    assert len(exchange.requests) == 3
    assert {request.system for request in exchange.requests} == {SYSTEM}
    assert {request.text for request in exchange.requests} == {QUESTION}
    assert "remote sensing image analysis expert" in SYSTEM
    assert "AREA=<number>" in QUESTION
    assert "red rectangle" in QUESTION


def test_the_red_rectangle_shows_the_target(exchange: Exchange) -> None:
    for row in rows_of().values():
        assert float(row["stated_area_m2"]) == pytest.approx(float(row["true_area_m2"]), rel=0.08)
    report = json.loads(Path("out/vlm.json").read_text())
    assert report["rows"][0]["name"] == "m"
    assert report["rows"][0]["median"] < 0.08
    assert report["run"]["provider"] == exchange.provider


def test_the_ceiling_of_tokens_has_the_providers_name(
    exchange: Exchange, service: ModelService
) -> None:
    _, _, payload = service.requests[-1]
    assert payload[NAMES_OF_CEILINGS[exchange.provider]] == 77
    assert len(set(NAMES_OF_CEILINGS.values()) & payload.keys()) == 1


def test_the_key_goes_to_the_service_only(exchange: Exchange, service: ModelService) -> None:
    _, headers, _ = service.requests[-1]
    assert KEY in (headers.get("x-api-key") or headers["authorization"])
    assert KEY not in exchange.result.output
    for path in Path("out").rglob("*"):
        assert path.is_dir() or KEY.encode() not in path.read_bytes()


def test_the_hint_is_one_more_sentence(run: Any, service: ModelService) -> None:
    texts = []

    def answer(request: ModelRequest) -> str:
        texts.append(request.text)
        return "AREA=1"

    service.answer = answer
    assert run("--hint", "--limit", 1).exit_code == 0
    assert texts == [f"{QUESTION} {HINT}"]
    assert (
        HINT == "Small vehicles (cars) are approximately 5 m long; use them as a scale reference."
    )
    assert json.loads(Path("out/vlm_hint.json").read_text())["rows"][0]["name"] == "m + hint"


@pytest.mark.parametrize(("max_side", "factor"), [(1568, 1.0), (320, 0.5)])
def test_the_rectangle_is_just_outside_the_box_at_any_size(max_side: int, factor: float) -> None:
    image = np.full((480, 640, 3), 90, np.uint8)
    question = draw_question(image, 1.0, box=(120, 200, 216, 296), max_side_px=max_side)
    bgr = cv2.imdecode(np.frombuffer(question.jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert bgr is not None
    assert (question.width_px, question.height_px) == (640 * factor, 480 * factor)
    assert question.corners == pytest.approx([side * factor for side in (120, 200, 216, 296)])
    rectangle = red_rectangle(np.ascontiguousarray(bgr[:, :, ::-1]).astype(np.uint8))
    assert rectangle == pytest.approx(question.corners, abs=2)
    # The rectangle is drawn into a copy.
    assert not (image != 90).any()


# --- The reply


@pytest.mark.parametrize("provider", PROVIDERS)
def test_refusals_count_as_an_error_of_100_percent(
    run: Any, service: ModelService, provider: str
) -> None:
    answers: list[str | Refusal] = [Refusal(), "I would rather not say.", "AREA=1"]
    service.answer = lambda _: answers.pop(0)
    result = run(provider=provider)
    assert result.exit_code == 0, result.output
    (row,) = json.loads(Path("out/vlm.json").read_text())["rows"]
    assert (row["entries"], row["answered"]) == (3, 1)
    assert row["catastrophic"] == pytest.approx(2 / 3)
    assert [trial["problem"] for trial in rows_of().values()] == ["refused", "no_area_line", ""]
    assert "1 no_area_line, 1 refused" in result.stdout


# --- The service


def test_an_entry_whose_requests_all_fail_is_reported(run: Any, service: ModelService) -> None:
    service.failures = [(400, {}), (500, {"retry-after-ms": "1"}), (500, {"retry-after-ms": "1"})]
    result = run("--retries", 1)
    assert result.exit_code == 0, result.output
    assert len(rows_of()) == 1
    assert result.stderr.count("warning[request_failed]") == 2
    assert "status 400" in result.stderr
    assert json.loads(Path("out/vlm.json").read_text())["left_out"] == {"request_failed": 2}


@pytest.mark.parametrize(
    ("provider", "status"),
    [
        pytest.param("anthropic", 401, marks=pytest.mark.slow),
        ("openai", 403),
        ("openai-compatible", 404),
    ],
)
def test_a_refused_key_or_model_ends_the_run(
    run: Any, service: ModelService, provider: str, status: int
) -> None:
    service.failures = [(status, {})] * 9
    result = run(provider=provider)
    assert result.exit_code == 3
    assert len(service.requests) == 1
    assert (
        "lacks the model 'm'" if status == 404 else f"refuses the key ({status})"
    ) in result.stderr


def test_a_service_that_is_down_ends_the_run(
    run: Any, data: Path, tmp_path: Path, service: ModelService
) -> None:
    (tmp_path / "long").mkdir()
    rows = ["image,mask,category,gsd_m_per_px"]
    for k in range(4):
        shutil.copy(data / "a.png", tmp_path / "long" / f"{k}.png")
        rows.append(f"{data / 'images' / 'a.png'},{k}.png,pool,{GSD}")
    (tmp_path / "long" / "index.csv").write_text("\n".join(rows))
    result = run("--retries", 0, "--segments", tmp_path / "long", url="http://127.0.0.1:9")
    assert result.exit_code == 3
    assert "5 requests in a row failed" in result.stderr


def test_a_reply_is_requested_once(run: Any, service: ModelService) -> None:
    service.answer = by_eye
    assert run("--limit", 2).exit_code == 0
    assert len(service.requests) == 2
    second = run()
    assert second.exit_code == 0
    assert len(service.requests) == 3
    assert "this run: 1 requests, 1050 tokens" in second.stdout


def test_a_hint_has_its_own_replies(run: Any, service: ModelService) -> None:
    service.answer = by_eye
    assert run().exit_code == 0
    assert run("--hint").exit_code == 0
    assert len(service.requests) == 6
    assert Path("out/replies.sqlite").exists()


def test_a_repeated_run_writes_the_same_table(run: Any, service: ModelService) -> None:
    service.answer = by_eye
    assert run().exit_code == 0
    assert run("--hint").exit_code == 0
    table = Path("out/vlm.csv").read_text()
    assert run("--hint").exit_code == 0
    assert len(service.requests) == 6
    assert Path("out/vlm.csv").read_text() == table


def test_a_ceiling_of_requests_ends_the_run_with_what_it_has(
    run: Any, service: ModelService
) -> None:
    service.answer = by_eye
    result = run("--max-requests", 2)
    assert result.exit_code == 3
    assert "stopped: 2 requests made" in result.stderr
    assert len(rows_of()) == 2
    assert "2 of 3 entries asked" in result.stdout
    assert run("--max-requests", 2).exit_code == 0
    assert (len(rows_of()), len(service.requests)) == (3, 3)


def test_a_message_that_quotes_the_key_hides_it(
    run: Any, service: ModelService, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OPENAI_API_KEY", "scripted")  # a word of the service's message
    service.failures = [(400, {})]
    result = run("--limit", 1)
    assert "***" in result.stderr
    assert "scripted" not in result.stderr


def test_a_missing_key_is_named(run: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OPENAI_API_KEY")
    result = run(provider="openai")
    assert result.exit_code == 2
    assert "set OPENAI_API_KEY" in result.stderr


def test_a_compatible_service_needs_no_key_but_its_address(
    service: ModelService, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OPENAI_API_KEY")
    replies = reply_journal(tmp_path)
    api = open_api("openai-compatible", "qwen", replies, Budget(), base_url=service.url + "/v1")
    assert api.ask("s", api.first_messages("s", "t", jpeg())).text == "AREA=100"
    with pytest.raises(InvalidParameterError, match="--base-url"):
        open_api("openai-compatible", "qwen", replies, Budget())


@pytest.mark.parametrize("url", ["http://user:pass@host/v1", "https://host/v1?key=5", "host:8000"])
def test_an_address_with_a_secret_in_it_is_refused(tmp_path: Path, url: str) -> None:
    with pytest.raises(InvalidParameterError, match="come from the environment"):
        open_api("openai-compatible", "qwen", reply_journal(tmp_path), Budget(), base_url=url)


def jpeg() -> str:
    import base64

    _, encoded = cv2.imencode(".jpg", np.zeros((20, 20, 3), np.uint8))
    return base64.b64encode(encoded.tobytes()).decode()


# --- The agent


def box_target(tools: list[dict[str, Any]], corners: list[float]) -> dict[str, Any]:
    """Build a target of ``measure_area`` for its schema."""
    schema = next(tool["schema"] for tool in tools if tool["name"] == "measure_area")
    targets = schema["properties"]["targets"]
    lists = [schema for schema in targets.get("anyOf", [targets]) if "items" in schema]
    box = lists[0]["items"]["properties"]["box"]
    objects = [schema for schema in box.get("anyOf", [box]) if "properties" in schema]
    sides = objects[0]["properties"]
    return {"box": dict(zip(sides, corners, strict=True))}


class Planner:
    """Act as a model that measures the rectangle's corners and states what the tool returned."""

    def __init__(self) -> None:
        self.requests: list[ModelRequest] = []

    def __call__(self, request: ModelRequest) -> str | UseTool:
        self.requests.append(request)
        if request.tool_results:
            record = json.loads(request.tool_results[-1].splitlines()[-1])
            return f"AREA={record['area_m2']:.3f}"
        path = re.search(r"The file is (\S+)\. ", request.text)
        size = re.search(r"is (\d+) x (\d+) px", request.text)
        corners = [
            float(number)
            for number in re.findall(r"[\d.]+(?=[,)])", request.text.partition("corners")[2])
        ]
        assert path
        assert size
        arguments = {
            "image": {"kind": "path", "path": path[1]},
            "targets": [box_target(request.tools, corners)],
            "frame": {"width_px": int(size[1]), "height_px": int(size[2])},
        }
        return UseTool("measure_area", arguments)


def _arguments(tools: list[dict[str, Any]]) -> dict[str, set[str]]:
    return {tool["name"]: set(tool["input_schema"]["properties"]) for tool in tools}


class AgentRun(NamedTuple):
    """A run of an agent with tools, its words, and the model behind it."""

    provider: str
    words: list[Any]
    result: Result
    planner: Planner


@pytest.fixture(params=PROVIDERS[:2])
def agent_run(
    run: Any,
    data: Path,
    service: ModelService,
    request: pytest.FixtureRequest,
    caplog: pytest.LogCaptureFixture,
) -> AgentRun:
    """Run an agent once with each provider, and keep its log."""
    planner = Planner()
    service.answer = planner
    words = ["--agent", "--max-side", 320, "--retries", 0, "--detector", data / "detector.onnx"]
    words += ["--segmenter", data / "encoder.onnx", data / "decoder.onnx"]
    with caplog.at_level(logging.INFO):
        result = run(*words, provider=request.param)
    assert result.exit_code == 0, result.output
    return AgentRun(request.param, words, result, planner)


def test_an_agent_states_what_the_tools_measure(agent_run: AgentRun, data: Path) -> None:
    rows = rows_of("vlm_tools")
    assert len(rows) == 3, agent_run.result.stderr
    for entry in read_areas(data).entries:
        row = rows[entry.name]
        measured = vehanchor.measure_area(
            entry.image,
            box=entry.corners,
            detector=str(data / "detector.onnx"),
            segmenter=(data / "encoder.onnx", data / "decoder.onnx"),
        )
        # Tools state three digits.
        assert float(row["stated_area_m2"]) == pytest.approx(measured.area_m2, rel=5e-3)
        assert (row["turns"], row["tool_calls"]) == ("2", "measure_area")
    assert "tool calls: 3 measure_area; 6 turns" in agent_run.result.stdout


def test_an_agent_has_the_servers_tools(agent_run: AgentRun, service: ModelService) -> None:
    assert {tool["name"] for tool in agent_run.planner.requests[0].tools} == {
        "estimate_gsd",
        "measure_area",
        "measure_distance",
        "view_image",
    }
    schemas = json.loads((ROOT / "schemas" / "anthropic.json").read_text())
    if agent_run.provider == "anthropic":
        # The agent's server has a root, so images are paths.
        tools = service.requests[0][2]["tools"]
        assert _arguments(tools) == _arguments(schemas)


def test_an_agent_gets_results_without_outlines(agent_run: AgentRun) -> None:
    assert "outline" not in agent_run.planner.requests[1].tool_results[0]


@pytest.mark.usefixtures("agent_run")
def test_an_agent_logs_nothing_of_a_server(caplog: pytest.LogCaptureFixture) -> None:
    records = caplog.get_records("setup")
    assert not [record for record in records if record.name.startswith("vehanchor_server")]


def test_each_turn_of_an_agent_is_kept(
    agent_run: AgentRun, run: Any, service: ModelService
) -> None:
    n_requests = len(service.requests)
    assert run(*agent_run.words, provider=agent_run.provider).exit_code == 0
    assert len(service.requests) == n_requests


def test_an_agent_that_never_answers_is_stopped(
    run: Any, data: Path, service: ModelService
) -> None:
    service.answer = lambda _: UseTool(
        "estimate_gsd", {"image": {"kind": "path", "path": "/etc/passwd"}}
    )
    result = run("--agent", "--max-turns", 3, "--limit", 1, "--detector", data / "detector.onnx")
    assert result.exit_code == 0, result.output
    (row,) = rows_of("vlm_tools").values()
    assert (row["problem"], row["turns"]) == ("too_many_turns", "3")
    assert row["tool_calls"] == "estimate_gsd estimate_gsd"


@pytest.mark.parametrize("provider", PROVIDERS[:2])
def test_the_model_gets_the_errors_of_tools(
    run: Any, data: Path, service: ModelService, provider: str
) -> None:
    results: list[str] = []

    def answer(request: ModelRequest) -> str | UseTool:
        n_results = len(request.tool_results)
        results.extend(request.tool_results[len(results) :])
        calls = [
            UseTool("estimate_gsd", {"image": {"kind": "path", "path": "/etc/passwd"}}),
            UseTool("estimate_gsd", {"picture": 1}),
            UseTool("no_such_tool", {}),
        ]
        return calls[n_results] if n_results < len(calls) else "AREA=5"

    service.answer = answer
    words = ["--agent", "--limit", 1, "--detector", data / "detector.onnx"]
    assert run(*words, provider=provider).exit_code == 0
    assert len(results) == 3
    assert "/etc/passwd" in results[0] or "not" in results[0]
    assert all(results)
