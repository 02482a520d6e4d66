from __future__ import annotations

import pytest

from tests.needs import needed_module, needed_program

PROGRAM = "a-program-that-nobody-has"


@pytest.mark.parametrize(
    ("ci", "without", "outcome"),
    [
        (None, None, pytest.skip.Exception),
        ("true", None, pytest.fail.Exception),
        ("true", "another", pytest.fail.Exception),
        ("true", f"another {PROGRAM}", pytest.skip.Exception),
    ],
)
def test_a_missing_program_skips_here_and_fails_in_ci_unless_it_is_excused(
    monkeypatch: pytest.MonkeyPatch, ci: str | None, without: str | None, outcome: type[BaseException]
) -> None:
    for name, value in (("CI", ci), ("VEHANCHOR_CI_WITHOUT", without)):
        if value is None:
            monkeypatch.delenv(name, raising=False)
        else:
            monkeypatch.setenv(name, value)
    with pytest.raises(outcome, match=PROGRAM):
        needed_program(PROGRAM, "build it")
    with pytest.raises(outcome, match=PROGRAM):
        needed_module(f"{PROGRAM}.part", "build it")
