"""Where models run, as callers of the verbs say."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import onnxruntime
import pytest

import vehanchor
from research.scenes import render_scene
from vehanchor.errors import InvalidParameterError, ProviderUnavailableError
from vehanchor.models import session
from vehanchor.models.runtime import DEFAULT_PROVIDERS, Runtime


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, list[str]]]:
    """The providers that each model file was to run on, as on a machine with a GPU; they run on the CPU."""
    real, asked = onnxruntime.InferenceSession, {}

    def open_on_cpu(source: Any, options: Any, *, providers: list[str]) -> Any:
        on_cpu = real(source, options, providers=["CPUExecutionProvider"])
        asked[" ".join(each.name for each in (*on_cpu.get_inputs(), *on_cpu.get_outputs()))] = providers
        return on_cpu

    monkeypatch.setattr(onnxruntime, "InferenceSession", open_on_cpu)
    monkeypatch.setattr(
        onnxruntime, "get_available_providers", lambda: ["CUDAExecutionProvider", "CPUExecutionProvider"]
    )
    yield asked
    session._warn_once.cache_clear()  # another test wants to hear it, too


@pytest.mark.slow
def test_every_bundled_model_of_a_verb_runs_where_its_caller_says(opened: dict[str, list[str]]) -> None:
    image = render_scene(0.12, width_px=400, height_px=320, seed=3).image
    vehanchor.measure_area(image, box=(20, 20, 80, 80), providers=["cuda", "cpu"])
    assert len(opened) == 8, "the detector, both verifiers, the fleet, the ground, the courts, the segmenter's halves"
    assert set(map(tuple, opened.values())) == {("CUDAExecutionProvider", "CPUExecutionProvider")}
    opened.clear()
    vehanchor.measure_distance(image, [(20, 20), (80, 80)], providers="cuda")
    assert opened
    assert set(map(tuple, opened.values())) == {("CUDAExecutionProvider",)}


def test_a_provider_that_is_missing_is_named_by_every_verb() -> None:
    image = np.zeros((64, 64, 3), np.uint8)
    for verb in (
        lambda: vehanchor.estimate_gsd(image, providers=["abacus"]),
        lambda: vehanchor.estimate_gsd((image,), providers=["abacus"]),
        lambda: vehanchor.measure_distance(image, [(1, 1), (9, 9)], providers=["abacus"]),
        lambda: vehanchor.measure_area(image, box=(1, 1, 9, 9), providers=["abacus"]),
    ):
        with pytest.raises(ProviderUnavailableError, match="has no abacus here"):
            verb()


def test_providers_are_a_list_a_name_or_nothing() -> None:
    assert Runtime().providers == Runtime().with_keywords({"providers": None}).providers == DEFAULT_PROVIDERS
    assert Runtime(providers="cuda").providers == ("cuda",)
    assert Runtime(providers=["cuda", "cpu"]).providers == ("cuda", "cpu")
    for wrong in ([], [1], [None]):
        with pytest.raises(InvalidParameterError, match=r"name them, as in \['cuda', 'cpu'\]"):
            Runtime(providers=wrong)  # type: ignore[arg-type]
