from __future__ import annotations

import base64
import hmac
import json
import sys
import time
from pathlib import Path
from typing import Any

import anyio
import jwt
import pytest
from cryptography.hazmat.primitives.asymmetric import ec, rsa
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from tests.server.conversation import listening, serving
from vehanchor_server.settings import Settings, SettingsError
from vehanchor_server.transport.auth import (
    KEYS_RETRY_S,
    OidcVerifier,
    StaticTokenVerifier,
    _get_json,
    read_tokens,
    token_verifier,
)

pytestmark = pytest.mark.anyio

ISSUER = "https://issuer.test/realm"
AUDIENCE = "https://vehanchor.test/mcp"
MAX_KEY_AGE_S = 100.0
TOKEN = "a-long-enough-token-1234"


async def test_only_a_known_token_is_accepted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    compared: list[int] = []
    original = hmac.compare_digest

    def counted(a: bytes, b: bytes) -> bool:
        compared.append(len(a))
        return original(a, b)

    monkeypatch.setattr(hmac, "compare_digest", counted)
    verifier = StaticTokenVerifier(["another-token-0123456789", TOKEN])
    accepted = await verifier.verify_token(TOKEN)
    assert accepted is not None
    assert accepted.client_id == "token-2"
    for wrong in ("", TOKEN[:-1], TOKEN + "x", TOKEN.upper(), f" {TOKEN}", "ä", "\udcff"):
        assert await verifier.verify_token(wrong) is None
    assert compared == [32] * 16  # in constant time with each


def test_token_files_are_read_by_line(tmp_path: Path) -> None:
    path = tmp_path / "tokens"
    path.write_text(f"# for the planner\n{TOKEN}\n\n  another-token-0123456789 \n")
    assert read_tokens(path) == [TOKEN, "another-token-0123456789"]


@pytest.mark.parametrize(
    ("content", "words"),
    [(None, "cannot be read"), (b"# none\n", "no token"), (b"short\n", "16"), (b"\xff", "cannot")],
)
def test_token_files_that_protect_nothing_are_refused(
    tmp_path: Path, content: bytes | None, words: str
) -> None:
    path = tmp_path / "tokens"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SettingsError, match=words):
        token_verifier(Settings(token_file=path))


class Issuer:
    """An issuer of tokens, with its documents."""

    def __init__(self) -> None:
        self.key = rsa.generate_private_key(65537, 2048)
        self.kid = "key-1"
        self.fetched: list[str] = []
        self.says_it_is = ISSUER
        self.jwks_uri = "https://issuer.test/keys"
        self.broken = False
        self.holds_answers = False

    async def get_json(self, url: str) -> dict[str, Any]:
        self.fetched.append(url)
        while self.holds_answers:
            await anyio.sleep(0.005)
        if self.broken:
            raise OSError("unreachable")
        if url == f"{ISSUER}/.well-known/openid-configuration":
            return {"issuer": self.says_it_is, "jwks_uri": self.jwks_uri}
        assert url == self.jwks_uri
        public = json.loads(jwt.algorithms.RSAAlgorithm.to_jwk(self.key.public_key()))
        return {"keys": [{**public, "kid": self.kid, "use": "sig", "alg": "RS256"}]}

    def token(
        self, *, key: Any = None, alg: str = "RS256", kid: str | None = None, **claims: Any
    ) -> str:
        body = {
            "iss": ISSUER,
            "aud": AUDIENCE,
            "sub": "planner",
            "exp": time.time() + 300,
            **claims,
        }
        body = {name: value for name, value in body.items() if value is not None}
        return jwt.encode(
            body, self.key if key is None else key, alg, headers={"kid": kid or self.kid}
        )

    def verifier(self) -> OidcVerifier:
        return OidcVerifier(ISSUER, AUDIENCE, max_key_age_s=MAX_KEY_AGE_S, get_json=self.get_json)


@pytest.fixture(scope="module")
def _issuer() -> Issuer:
    return Issuer()  # making a key takes a while


@pytest.fixture
def issuer(_issuer: Issuer) -> Issuer:
    fresh = Issuer.__new__(Issuer)
    fresh.__dict__.update(_issuer.__dict__, fetched=[])
    return fresh


async def test_the_issuers_tokens_are_accepted_with_one_fetch(issuer: Issuer) -> None:
    accepted = await issuer.verifier().verify_token(issuer.token())
    assert accepted is not None
    assert accepted.client_id == "planner"
    verifier = issuer.verifier()
    for _ in range(3):
        assert (
            await verifier.verify_token(issuer.token(aud=["https://other.test", AUDIENCE]))
            is not None
        )
    issuer.fetched.clear()
    for i in range(5):
        assert await verifier.verify_token(issuer.token(kid=f"unknown-{i}")) is None
    assert issuer.fetched == [], "unknown keys flood the issuer"


@pytest.mark.promise("issuer")
@pytest.mark.parametrize(
    "claims",
    [
        {"aud": "https://other.test"},
        {"aud": None},
        {"iss": "https://evil.test"},
        {"iss": None},
        {"exp": 1_000_000_000},
        {"exp": None},
        {"nbf": 4_000_000_000},
        {"exp": 1e400},
    ],
)
async def test_claims_that_do_not_fit_are_refused(issuer: Issuer, claims: dict[str, Any]) -> None:
    assert await issuer.verifier().verify_token(issuer.token(**claims)) is None


def forged(token: str, alg: str, secret: bytes) -> str:
    """The token's claims under another algorithm, as no honest library would sign them."""
    header = json.dumps({"alg": alg, "kid": "key-1", "typ": "JWT"})
    claims = token.split(".")[1]
    signed = f"{_base64url(header.encode())}.{claims}"
    signature = b""
    if secret:
        signature = hmac.new(secret, signed.encode(), "sha256").digest()
    return f"{signed}.{_base64url(signature)}"


def _base64url(data: bytes) -> str:
    return base64.urlsafe_b64encode(data).rstrip(b"=").decode()


@pytest.mark.promise("issuer")
async def test_other_keys_or_algorithms_are_refused(issuer: Issuer) -> None:
    verifier = issuer.verifier()
    public = issuer.key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
    assert (
        await verifier.verify_token(issuer.token(key=rsa.generate_private_key(65537, 2048))) is None
    )
    assert await verifier.verify_token(forged(issuer.token(), "HS256", public)) is None
    assert await verifier.verify_token(forged(issuer.token(), "none", b"")) is None
    assert (
        await verifier.verify_token(
            issuer.token(key=ec.generate_private_key(ec.SECP256R1()), alg="ES256")
        )
        is None
    )
    head, body, signature = issuer.token().split(".")
    assert await verifier.verify_token(f"{head}.{body}x.{signature}") is None
    for garbage in ("", "a.b.c", "x", f"{head}.{body}."):
        assert await verifier.verify_token(garbage) is None


async def test_a_new_key_of_the_issuer_is_found(
    issuer: Issuer, monkeypatch: pytest.MonkeyPatch
) -> None:
    verifier = issuer.verifier()
    assert await verifier.verify_token(issuer.token()) is not None
    issuer.kid = "key-2"
    monkeypatch.setattr("vehanchor_server.transport.auth.KEYS_RETRY_S", 0)
    assert await verifier.verify_token(issuer.token()) is not None


async def test_an_issuer_that_is_not_itself_or_not_there_is_told_in_the_log(
    issuer: Issuer, caplog: pytest.LogCaptureFixture
) -> None:
    issuer.says_it_is = "https://evil.test"
    assert await issuer.verifier().verify_token(issuer.token()) is None
    issuer.says_it_is = ISSUER
    issuer.jwks_uri = "http://issuer.test/keys"
    assert await issuer.verifier().verify_token(issuer.token()) is None
    issuer.broken = True
    assert await issuer.verifier().verify_token(issuer.token()) is None
    assert [word in caplog.text for word in ("evil.test", "not https", "unreachable")] == [True] * 3


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a fetch wait for longer than a busy machine takes for a test."""
    monkeypatch.setattr("vehanchor_server.transport.auth.FETCH_S", 60)


class Stranger:
    """A caller with a key that the issuer does not have; its call waits for a held fetch.

    Attributes:
        answers: to its call; empty while it waits.
    """

    def __init__(self, verifier: OidcVerifier, issuer: Issuer) -> None:
        self.answers: list[Any] = []
        self._verifier = verifier
        self._issuer = issuer

    async def call(self) -> None:
        token = self._issuer.token(kid="a-stranger's")
        self.answers.append(await self._verifier.verify_token(token))

    async def waits(self) -> None:
        """Wait until the issuer was asked because of the call."""
        while not self._issuer.fetched:
            await anyio.sleep(0.005)


@pytest.fixture
async def known(issuer: Issuer) -> OidcVerifier:
    """A verifier that knows the issuer's key; the issuer's next answers are held."""
    verifier = issuer.verifier()
    assert await verifier.verify_token(issuer.token()) is not None
    issuer.fetched.clear()
    issuer.holds_answers = True
    return verifier


@pytest.mark.promise("issuer")
@pytest.mark.usefixtures("patient")
async def test_a_slow_issuer_makes_only_the_stranger_wait(
    known: OidcVerifier, issuer: Issuer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vehanchor_server.transport.auth.KEYS_RETRY_S", -1)
    # every call would fetch, too
    monkeypatch.setattr("vehanchor_server.transport.auth.KEYS_REFRESH_S", -1)
    stranger = Stranger(known, issuer)
    async with anyio.create_task_group() as group:
        group.start_soon(stranger.call)
        await stranger.waits()
        for _ in range(5):
            assert await known.verify_token(issuer.token()) is not None
        assert not stranger.answers
        issuer.holds_answers = False
    assert stranger.answers == [None]


async def test_a_fetch_goes_on_if_its_caller_hangs_up(issuer: Issuer) -> None:
    verifier = issuer.verifier()
    issuer.holds_answers = True
    with anyio.move_on_after(0.05):
        await verifier.verify_token(issuer.token())
    issuer.holds_answers = False
    assert await verifier.verify_token(issuer.token()) is not None
    assert len(issuer.fetched) == 2, "one fetch has two documents"


@pytest.mark.promise("issuer")
async def test_keys_of_a_dead_issuer_end(
    issuer: Issuer, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    verifier = issuer.verifier()
    monkeypatch.setattr("vehanchor_server.transport.auth.KEYS_RETRY_S", 0)
    assert await verifier.verify_token(issuer.token()) is not None
    issuer.broken = True
    assert await verifier.verify_token(issuer.token()) is not None
    verifier._fetched_at -= MAX_KEY_AGE_S
    assert await verifier.verify_token(issuer.token()) is None
    assert f"ended {MAX_KEY_AGE_S:g} s after their last fetch" in caplog.text
    issuer.broken = False
    assert await verifier.verify_token(issuer.token()) is not None


@pytest.mark.parametrize(("n_bytes", "word"), [(1, "Timeout"), (64 << 10, "bytes")])
async def test_a_dripping_issuer_is_limited_in_time_or_bytes(
    issuer: Issuer,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    n_bytes: int,
    word: str,
) -> None:
    async def drip(scope: Any, receive: Any, send: Any) -> None:
        await send({"type": "http.response.start", "status": 200})
        while True:
            await send({"type": "http.response.body", "body": b" " * n_bytes, "more_body": True})
            await anyio.sleep(0.01)

    with listening() as listener, serving(drip, listener):
        dripping = f"http://127.0.0.1:{listener.getsockname()[1]}"
        fetch_s = 0.4 if n_bytes == 1 else 60
        monkeypatch.setattr("vehanchor_server.transport.auth.FETCH_S", fetch_s)
        verifier = OidcVerifier(
            ISSUER, AUDIENCE, max_key_age_s=100, get_json=lambda _: _get_json(dripping)
        )
        assert await verifier.verify_token(issuer.token()) is None
    assert word in caplog.text


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has other permissions")
@pytest.mark.parametrize(("mode", "warned"), [(0o600, False), (0o640, False), (0o644, True)])
def test_a_token_file_that_everyone_can_read_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, mode: int, warned: bool
) -> None:
    path = tmp_path / "token"
    path.write_text("0123456789abcdef0123456789abcdef")
    path.chmod(mode)
    assert len(read_tokens(path)) == 1
    assert ("every user of this machine can read the token file" in caplog.text) == warned


@pytest.mark.usefixtures("patient")
async def test_a_second_unknown_key_is_refused_at_once(known: OidcVerifier, issuer: Issuer) -> None:
    known._tried_at = -KEYS_RETRY_S
    stranger = Stranger(known, issuer)
    async with anyio.create_task_group() as group:
        group.start_soon(stranger.call)
        await stranger.waits()
        assert await known.verify_token(issuer.token(kid="second")) is None
        assert not stranger.answers
        issuer.holds_answers = False
    assert len(issuer.fetched) == 2, "one fetch has two documents"


def test_settings_choose_the_verifier() -> None:
    assert token_verifier(Settings()) is None
    for age, expected_s in (("", 86400), ("#max-age=90", 90)):
        oidc = token_verifier(Settings(oidc=(ISSUER + age, AUDIENCE)))
        assert isinstance(oidc, OidcVerifier)
        assert (oidc._issuer, oidc._max_key_age_s) == (ISSUER, expected_s)
