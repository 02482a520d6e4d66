"""What the operator decides: where images may come from, which model, how much work, who may call.

Nothing here can be changed by a caller. Every field is a flag of ``vehanchor serve`` and a ``VEHANCHOR_*`` variable.
"""

from __future__ import annotations

import math
import os
import typing
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

__all__ = ["Settings", "SettingsError"]

_PREFIX = "VEHANCHOR_"
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_TRUE, _FALSE = ("1", "true", "yes", "on"), ("0", "false", "no", "off")


class SettingsError(ValueError):
    """An option has no meaning, or two options contradict each other; the message says which and what to do."""


@dataclass(frozen=True)
class Settings:
    """The operator's options.

    Attributes:
        roots: directories below which images may be read by path; none means that paths are off.
        image_hosts: hosts (``name`` or ``name:port``) that images may be fetched from; none means that URLs are off.
        detector: bundled name or path of the detector; None for the default one.
        segmenter: paths of a segmenter's encoder and decoder; None for the bundled one.
        calibration: file of a reference length, as ``vehanchor calibrate`` writes it, for callers who name neither
            region nor reference length; None takes the detector's own.
        threads: CPU threads of a model; None leaves it to ONNX Runtime.
        min_score: lowest detection score; None takes the model's.
        max_image_mb: encoded size of an image, MiB.
        max_megapixels: declared size of an image that is decoded whole, millions of pixels.
        max_windowed_megapixels: declared size of a TIFF that is read by windows, millions of pixels.
        max_concurrency: calls that run at once in this process; None is one for each CPU, two at least.
        deadline_s: seconds after which a call ends; below the 60 s at which common clients give up.
        fetch_timeout_s: seconds that fetching an image may take in all.
        host: address that HTTP listens on.
        port: port that HTTP listens on.
        allowed_hosts: Host headers to accept beside the loopback ones (``name``, ``name:port`` or ``name:*``).
        allowed_origins: Origin headers to accept beside the loopback ones.
        public_url: the URL under which callers reach the server; named in 401 answers.
        token_file: file with one bearer token a line; ``#`` starts a comment.
        oidc_issuer: issuer whose JWTs are accepted as bearer tokens.
        oidc_audience: audience that those JWTs must carry.
        max_body_mb: size of an HTTP request, MiB.
        insecure: listen on a public address without authentication all the same.
    """

    roots: tuple[Path, ...] = ()
    image_hosts: tuple[str, ...] = ()
    detector: str | None = None
    segmenter: tuple[Path, Path] | None = None
    calibration: Path | None = None
    threads: int | None = None
    min_score: float | None = None
    max_image_mb: float = 512.0
    max_megapixels: float = 100.0
    max_windowed_megapixels: float = 10_000.0
    max_concurrency: int | None = None
    deadline_s: float = 55.0
    fetch_timeout_s: float = 20.0
    host: str = "127.0.0.1"
    port: int = 8000
    allowed_hosts: tuple[str, ...] = ()
    allowed_origins: tuple[str, ...] = ()
    public_url: str | None = None
    token_file: Path | None = None
    oidc_issuer: str | None = None
    oidc_audience: str | None = None
    max_body_mb: float = 32.0
    insecure: bool = False

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                continue
            if not (math.isfinite(value) and (value > 0 or (field.name == "min_score" and value == 0))):
                raise SettingsError(f"{field.name} is {value}: use a finite number > 0")
        if self.min_score is not None and self.min_score > 1:
            raise SettingsError(f"min_score is {self.min_score}: it lies in 0..1")
        object.__setattr__(self, "roots", tuple(_checked_root(root) for root in self.roots))
        object.__setattr__(self, "image_hosts", tuple(host.strip().lower() for host in self.image_hosts))
        for host in self.image_hosts:
            name, _, port = host.partition(":")
            if not name or set(name) & set("/*@[]") or (":" in host and not port.isdigit()):
                raise SettingsError(f"image host {host!r}: give a plain host name or name:port, without https:// or *")
        if self.segmenter is not None and len(self.segmenter) != 2:
            raise SettingsError("segmenter needs two files: give its encoder and its decoder")
        if (self.oidc_issuer is None) != (self.oidc_audience is None):
            raise SettingsError("oidc_issuer and oidc_audience belong together: give both or neither")
        if self.oidc_issuer is not None and not self.oidc_issuer.startswith("https://"):
            raise SettingsError(f"oidc_issuer is {self.oidc_issuer!r}: an issuer is an https:// URL")
        if self.oidc_issuer is not None and self.token_file is not None:
            raise SettingsError("token_file and oidc_issuer exclude each other: choose one way to authenticate")

    @property
    def authenticated(self) -> bool:
        """Whether HTTP callers must show a token."""
        return self.token_file is not None or self.oidc_issuer is not None

    @property
    def loopback(self) -> bool:
        """Whether HTTP listens where only this machine reaches it."""
        return self.host in _LOOPBACK

    def check_exposure(self) -> None:
        """Refuse to listen where others reach the server and none has to show a token.

        Raises:
            SettingsError: a public address, no authentication, and not ``insecure``.
        """
        if not (self.loopback or self.authenticated or self.insecure):
            raise SettingsError(
                f"refusing to listen on {self.host} without authentication: everyone could use the server. "
                "Give --token-file or --oidc-issuer with --oidc-audience, listen on 127.0.0.1, or pass --insecure"
            )

    @classmethod
    def from_environment(cls, environ: Mapping[str, str] | None = None, /, **given: Any) -> Settings:
        """Options from ``VEHANCHOR_*`` variables, those ``given`` (and not None) first.

        Paths are separated by the system's path separator, other lists by commas. An empty variable is none.

        Raises:
            SettingsError: a variable cannot be read, or what it says has no meaning.
        """
        environ = os.environ if environ is None else environ
        chosen: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        for name, kind in typing.get_type_hints(cls).items():
            text = environ.get(_PREFIX + name.upper())
            if name not in chosen and text:
                chosen[name] = _parsed(name, text, kind)
        return cls(**chosen)

    def to_environment(self) -> dict[str, str]:
        """The variables that make ``from_environment`` give these options: how worker processes get them."""
        variables = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, tuple):
                value = (_separator(type(value[0])) if value else "").join(map(str, value))
            if value is not None:
                variables[_PREFIX + field.name.upper()] = str(value)
        return variables


def _checked_root(root: Path) -> Path:
    """The directory, resolved; a root that is missing or is everything is a mistake to tell at once."""
    try:
        resolved = Path(root).resolve(strict=True)
    except OSError as error:
        raise SettingsError(f"root {root}: {error.strerror}; give an existing directory") from None
    if not resolved.is_dir():
        raise SettingsError(f"root {root} is not a directory; give the directory that holds the images")
    if resolved == Path(resolved.anchor):
        raise SettingsError(f"root {root} is the whole file system; give the directory that holds the images")
    return resolved


def _parsed(name: str, text: str, kind: Any) -> Any:
    """A variable's text as the field's type."""
    if type(None) in typing.get_args(kind):  # optional
        kind = next(option for option in typing.get_args(kind) if option is not type(None))
    many = typing.get_origin(kind) is tuple
    one = typing.get_args(kind)[0] if many else kind
    try:
        if one is bool:
            if text.lower() not in _TRUE + _FALSE:
                raise ValueError(text)
            return text.lower() in _TRUE
        if many:
            return tuple(one(part.strip()) for part in text.split(_separator(one)) if part.strip())
        return one(text)
    except ValueError:
        raise SettingsError(f"{_PREFIX}{name.upper()} is {text!r}: expected {one.__name__}") from None


def _separator(kind: type) -> str:
    """What stands between the parts of a variable."""
    return os.pathsep if issubclass(kind, Path) else ","
