"""Settings of the operator: image sources, models, limits and access.

Callers cannot change settings. Each field is declared once, with its default and help text. The option of
``vehanchor serve`` and the ``VEHANCHOR_*`` variable follow from its name.
"""

from __future__ import annotations

import math
import os
import typing
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeAlias
from urllib.parse import urlsplit

from pydantic import TypeAdapter, ValidationError

from vehanchor.errors import VehAnchorError
from vehanchor.options import ImageLimits, models

if TYPE_CHECKING:
    from collections.abc import Mapping

Isolation: TypeAlias = Literal["confined", "unconfined", "in-process"]

MAX_BODY_BYTES = 32 << 20  # of an HTTP request; examples/deploy/nginx.conf has the same limit
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_EVERYWHERE = ("0.0.0.0", "::")
_MEGAPIXEL = 1_000_000
_DECODED_BYTES_PER_PIXEL = 11  # memory for decoding 8-bit RGB, with a reserve; 1 GiB for 100 megapixels
_NETWORKS_BYTES = 150 << 20  # memory of the networks during a call (research/results)
_SOURCES, _WORK, _HTTP = "Image sources", "Models and limits", "HTTP"


class SettingsError(VehAnchorError, ValueError, code="invalid_settings"):
    """A setting is invalid, or two settings contradict each other; the message has the remedy."""


class Words(NamedTuple):
    """Words of a setting for ``--help``.

    Attributes:
        help: one or two sentences.
        panel: heading.
        flag: name of the option; empty for the field's own.
        metavar: placeholder of the value.
        if_unset: meaning of a default of None.
        separator: separates values in the variable; empty for one value.
    """

    help: str
    panel: str
    flag: str = ""
    metavar: str = ""
    if_unset: str = ""
    separator: str = ""


def _words(help_text: str, panel: str, **parts: str) -> dict[str, Words]:
    """Build the metadata of a field."""
    return {"words": Words(help_text, panel, **parts)}


@dataclass(frozen=True)
class Settings:
    """The operator's settings; the metadata of each field has its help text.

    Raises:
        SettingsError: a setting is invalid, or two settings contradict each other.
    """

    roots: tuple[Path, ...] = field(
        default=(),
        metadata=_words(
            "Directory of images that callers may read by path; repeatable.",
            _SOURCES,
            flag="root",
            separator=os.pathsep,
        ),
    )
    image_hosts: tuple[str, ...] = field(
        default=(),
        metadata=_words(
            "Host from which images may be fetched (https); repeatable.", _SOURCES, flag="image-host", separator=","
        ),
    )
    detector: str | None = field(
        default=None, metadata=_words(models.DETECTOR.help, _WORK, metavar=models.DETECTOR.metavar)
    )
    segmenter: tuple[Path, Path] | None = field(
        default=None,
        metadata=_words(models.SEGMENTER.help, _WORK, metavar=models.SEGMENTER.metavar, separator=os.pathsep),
    )
    calibration: Path | None = field(  # for callers who give neither region nor reference length
        default=None, metadata=_words(models.CALIBRATION.help, _WORK, metavar=models.CALIBRATION.metavar)
    )
    threads: int | None = field(
        default=None, metadata=_words(models.THREADS.help, _WORK, metavar=models.THREADS.metavar)
    )
    providers: tuple[str, ...] = field(
        default=(),
        metadata=_words(
            models.PROVIDERS.help, _WORK, flag=models.PROVIDERS.flag, metavar=models.PROVIDERS.metavar, separator=","
        ),
    )
    max_megapixels: float = field(
        default=ImageLimits.max_pixels / _MEGAPIXEL,
        metadata=_words("Largest image decoded at once, megapixels; the memory of a worker follows from it.", _WORK),
    )
    max_concurrency: int | None = field(
        default=None,
        metadata=_words("Concurrent calls, each in a worker of its own.", _WORK, if_unset="one per CPU, at least 2"),
    )
    deadline_s: float = field(  # common clients give up after 60 s
        default=55.0, metadata=_words("Seconds after which a call ends.", _WORK)
    )
    isolation: Isolation = field(
        default="confined",
        metadata=_words(
            "Place of decoding and models: 'confined' processes, which can be killed and on Linux have few rights; "
            "'unconfined' ones with all rights of this user; 'in-process', for your own images only.",
            _WORK,
        ),
    )
    never_ask: bool = field(
        default=False,
        metadata=_words("Never ask the user for a region, a height or a known length; for unattended agents.", _WORK),
    )
    host: str = field(default="127.0.0.1", metadata=_words("Address to listen on.", _HTTP))
    port: int = field(default=8000, metadata=_words("Port to listen on.", _HTTP))
    public_urls: tuple[str, ...] = field(
        default=(),
        metadata=_words(
            "URL of /mcp for callers, whose Host and Origin are accepted besides the loopback names; repeatable.",
            _HTTP,
            flag="public-url",
            separator=",",
        ),
    )
    token_file: Path | None = field(
        default=None, metadata=_words("File with one accepted bearer token per line.", _HTTP)
    )
    oidc: tuple[str, str] | None = field(
        default=None,
        metadata=_words(
            "Issuer of accepted JWTs, and their required audience.", _HTTP, metavar="ISSUER AUDIENCE", separator=","
        ),
    )
    insecure: bool = field(default=False, metadata=_words("Listen publicly without authentication.", _HTTP))

    def __post_init__(self) -> None:
        self._check_values()
        object.__setattr__(self, "_spelled", tuple(Path(os.path.abspath(root)) for root in self.roots))  # noqa: PTH100
        object.__setattr__(self, "roots", tuple(_checked_root(root) for root in self.roots))
        object.__setattr__(self, "image_hosts", tuple(host.strip().lower() for host in self.image_hosts))
        for host in self.image_hosts:
            name, _, port = host.partition(":")
            if not name or set(name) & set("/*@[]") or (":" in host and not port.isdigit()):
                raise SettingsError(f"image host {host!r}: give a plain host name or name:port, without https:// or *")
        self._check_authentication()

    def _check_values(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            numeric = isinstance(value, (int, float)) and not isinstance(value, bool)
            if numeric and not (math.isfinite(value) and value > 0):
                raise SettingsError(f"{each.name} is {value}: use a finite number > 0")
        if self.isolation not in typing.get_args(Isolation):
            raise SettingsError(f"isolation is {self.isolation!r}: use {', '.join(typing.get_args(Isolation))}")
        if self.segmenter is not None and len(self.segmenter) != 2:
            raise SettingsError("segmenter needs two files: give its encoder and its decoder")

    def _check_authentication(self) -> None:
        for url in self.public_urls:
            if not _is_web_address(url):
                raise SettingsError(f"public_url is {url!r}: write all of it, as in https://example.org/mcp")
        if self.oidc is None:
            return
        if len(self.oidc) != 2 or not self.oidc[0].startswith("https://"):
            raise SettingsError(f"oidc is {' '.join(self.oidc)!r}: give the issuer's https:// URL and the audience")
        if self.token_file is not None:
            raise SettingsError("token_file and oidc exclude each other: choose one way to authenticate")
        if not self.public_urls and self.host in _EVERYWHERE:
            raise SettingsError(f"listening on {self.host} with an issuer: give --public-url, the address for callers")

    @property
    def image_kinds(self) -> tuple[str, ...]:
        """Kinds of images that models can name: by path and by URL, if allowed; models cannot write base64."""
        return (*(["path"] if self.roots else []), *(["url"] if self.image_hosts else []))

    @property
    def spelled_roots(self) -> tuple[Path, ...]:
        """The roots as given by the operator: absolute, with unresolved links."""
        spelled: tuple[Path, ...] = self.__dict__["_spelled"]
        return spelled

    @property
    def image_limits(self) -> ImageLimits:
        """Limits on accepted images."""
        max_pixels = round(self.max_megapixels * _MEGAPIXEL)
        return ImageLimits(
            max_pixels=max_pixels,
            max_decoded_bytes=_DECODED_BYTES_PER_PIXEL * max_pixels,
            max_unpacked_bytes=1,  # refuse large JPEGs, so that callers cannot fill the disk
        )

    @property
    def max_worker_bytes(self) -> int:
        """Memory limit of a worker in addition to its models: twice that of decoding, and the networks."""
        return 2 * self.image_limits.max_decoded_bytes + _NETWORKS_BYTES

    def check_exposure(self) -> None:
        """Refuse to listen on a public address without authentication.

        Raises:
            SettingsError: a public address without authentication and without ``insecure``.
        """
        if self.host not in _LOOPBACK and self.token_file is None and self.oidc is None and not self.insecure:
            raise SettingsError(
                f"refusing to listen on {self.host} without authentication: everyone could use the server. "
                "Give --token-file or --oidc, listen on 127.0.0.1, or pass --insecure"
            )

    @classmethod
    def from_environment(cls, environ: Mapping[str, str] | None = None, /, **given: Any) -> Settings:
        """Read settings from ``VEHANCHOR_*`` variables; ``given`` values other than None take precedence.

        The system's path separator separates paths, commas separate other lists. An empty variable counts as unset.

        Raises:
            SettingsError: a variable is malformed or invalid.
        """
        environ = os.environ if environ is None else environ
        chosen: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        kinds = typing.get_type_hints(cls)
        for each in fields(cls):
            text = environ.get(variable_name(each.name))
            if each.name not in chosen and text:
                chosen[each.name] = _from_text(
                    variable_name(each.name), text, kinds[each.name], each.metadata["words"].separator
                )
        return cls(**chosen)


def _is_web_address(text: str) -> bool:
    try:
        parts = urlsplit(text)
        return parts.scheme in ("http", "https") and bool(parts.hostname)
    except ValueError:  # brackets without an address in them
        return False


def variable_name(name: str) -> str:
    """Return the environment variable of a field."""
    return f"VEHANCHOR_{name.upper()}"


def _checked_root(root: Path) -> Path:
    """Resolve a root; refuse missing directories and the whole file system."""
    try:
        resolved = Path(root).resolve(strict=True)
    except OSError as error:
        raise SettingsError(f"root {root}: {error.strerror}; give an existing directory") from None
    if not resolved.is_dir():
        raise SettingsError(f"root {root} is not a directory; give the directory of the images")
    if resolved == Path(resolved.anchor):
        raise SettingsError(f"root {root} is the whole file system; give the directory of the images")
    return resolved


def _from_text(variable: str, text: str, kind: Any, separator: str) -> Any:
    """Convert a variable's text to the field's type."""
    value: Any = text
    if separator:
        value = [part.strip() for part in text.split(separator) if part.strip()]
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as error:
        raise SettingsError(f"{variable} is {text!r}: {error.errors()[0]['msg'].lower()}") from None
