"""Settings of the operator: image sources, models, limits and access.

Callers cannot change settings. Each field is declared once, with its default and help text. The
option of ``vehanchor serve`` and the ``VEHANCHOR_*`` variable follow from its name.
"""

from __future__ import annotations

import os
import re
import typing
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, TypeAlias
from urllib.parse import urlsplit

from pydantic import TypeAdapter, ValidationError

from vehanchor.errors import VehAnchorError
from vehanchor.options import ImageLimits, models
from vehanchor.options.option import Limits, Option, group, set_frozen

if TYPE_CHECKING:
    from collections.abc import Mapping

Isolation: TypeAlias = Literal["confined", "unconfined", "in-process"]

MAX_BODY_BYTES = 32 << 20  # of an HTTP request; examples/deploy/nginx.conf has the same limit
_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_EVERYWHERE = ("0.0.0.0", "::")
_MEGAPIXEL = 1_000_000
# Memory for decoding 8-bit RGB, with a reserve: 1 GiB for 100 megapixels.
_DECODED_BYTES_PER_PIXEL = 11
_NETWORKS_BYTES = 150 << 20  # memory of the networks during a call (research/results)
# In OpenID Connect an issuer has no fragment, so that the fragment is free for the age of its keys.
_ISSUER = re.compile(r"(https://[^#\s]+)(?:#max-age=([1-9]\d*))?")
_DAY_S = 86400.0

_Count: TypeAlias = Annotated[int, Limits(1, whole=True)]
_Positive: TypeAlias = Annotated[float, Limits(above=0)]


class SettingsError(VehAnchorError, ValueError, code="invalid_settings"):
    """A setting is invalid, or two settings contradict each other; the message has the remedy."""


@group(frozen=True)
class Settings:
    """The operator's settings; the ``Option`` of each field has its help text.

    Raises:
        SettingsError: a setting is invalid, or two settings contradict each other.
    """

    error: ClassVar[type[VehAnchorError]] = SettingsError

    roots: Annotated[
        tuple[Path, ...],
        Option("Directory of images that callers may read by path; repeatable.", flag="root"),
    ] = ()
    image_hosts: Annotated[
        tuple[str, ...],
        Option("Host from which images may be fetched (https); repeatable.", flag="image-host"),
    ] = ()
    detector: Annotated[str | None, models.DETECTOR] = None
    segmenter: Annotated[tuple[Path, Path] | None, models.SEGMENTER] = None
    # For callers who give no region or reference length.
    calibration: Annotated[Path | None, models.CALIBRATION] = None
    threads: Annotated[_Count | None, models.THREADS] = None
    providers: Annotated[tuple[str, ...], models.PROVIDERS] = ()
    max_megapixels: Annotated[
        _Positive,
        Option(
            "Largest image decoded at once, megapixels; the memory of a worker follows from it."
        ),
    ] = ImageLimits.max_pixels / _MEGAPIXEL
    max_concurrency: Annotated[
        _Count | None,
        Option("Concurrent calls, each in a worker of its own. Default: one per CPU, at least 2."),
    ] = None
    # Clients give up after 60 s.
    deadline_s: Annotated[_Positive, Option("Seconds after which a call ends.")] = 55.0
    isolation: Annotated[
        Isolation,
        Option(
            "Place of decoding and models: 'confined' processes, which can be killed and on "
            "Linux have few rights; 'unconfined' ones with all rights of this user; "
            "'in-process', for your own images only."
        ),
    ] = "confined"
    never_ask: Annotated[
        bool,
        Option(
            "Never ask the user for a region, a height or a known length; for unattended agents."
        ),
    ] = False
    host: Annotated[str, Option("Address to listen on.")] = "127.0.0.1"
    port: Annotated[int, Limits(1, 65535, whole=True), Option("Port to listen on.")] = 8000
    public_urls: Annotated[
        tuple[str, ...],
        Option(
            "URL of /mcp for callers, whose Host and Origin are accepted besides the loopback "
            "names; repeatable.",
            flag="public-url",
        ),
    ] = ()
    token_file: Annotated[Path | None, Option("File with one accepted bearer token per line.")] = (
        None
    )
    oidc: Annotated[
        tuple[str, str] | None,
        Option(
            "Issuer of accepted JWTs, and their required audience. The issuer's keys end a day "
            "after their last fetch, or after the seconds that follow it, as in "
            "https://example.org#max-age=3600.",
            metavar="ISSUER AUDIENCE",
        ),
    ] = None
    insecure: Annotated[bool, Option("Listen publicly without authentication.")] = False

    def __post_init__(self) -> None:
        spelled = tuple(Path(os.path.abspath(root)) for root in self.roots)  # noqa: PTH100
        resolved = tuple(_checked_root(root) for root in self.roots)
        hosts = tuple(host.strip().lower() for host in self.image_hosts)
        set_frozen(self, "_spelled", spelled)
        set_frozen(self, "roots", resolved)
        set_frozen(self, "image_hosts", hosts)
        for host in self.image_hosts:
            _check_image_host(host)
        self._check_authentication()

    def _check_authentication(self) -> None:
        """Refuse incomplete addresses, and contradictions between the ways to authenticate."""
        for url in self.public_urls:
            if not _is_web_address(url):
                raise SettingsError(
                    f"public_url is {url!r}: write all of it, as in https://example.org/mcp"
                )
        if self.oidc is None:
            return
        if not _ISSUER.fullmatch(self.oidc[0]):
            raise SettingsError(
                f"oidc is {' '.join(self.oidc)!r}: give the issuer's https:// URL and the "
                "audience; #max-age=SECONDS may follow the URL"
            )
        if self.token_file is not None:
            raise SettingsError(
                "token_file and oidc exclude each other: choose one way to authenticate"
            )
        if not self.public_urls and self.host in _EVERYWHERE:
            raise SettingsError(
                f"listening on {self.host} with an issuer: give --public-url, the address for "
                "callers"
            )

    @property
    def issuer(self) -> tuple[str, float]:
        """URL of the issuer, and seconds from their last fetch after which its keys end."""
        assert self.oidc is not None
        parts = _ISSUER.fullmatch(self.oidc[0])
        assert parts is not None
        return parts[1], float(parts[2] or _DAY_S)

    @property
    def image_kinds(self) -> tuple[str, ...]:
        """Kinds of images that models can name, as far as they are allowed; base64 is too long."""
        kinds = []
        if self.roots:
            kinds.append("path")
        if self.image_hosts:
            kinds.append("url")
        return tuple(kinds)

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
            max_pixels=max_pixels, max_decoded_bytes=_DECODED_BYTES_PER_PIXEL * max_pixels
        )

    @property
    def max_worker_bytes(self) -> int:
        """Memory limit of a worker beside its models: two decoded images and running networks."""
        return 2 * self.image_limits.max_decoded_bytes + _NETWORKS_BYTES

    def check_exposure(self) -> None:
        """Refuse to listen on a public address without authentication.

        Raises:
            SettingsError: a public address without authentication and without ``insecure``.
        """
        is_public = self.host not in _LOOPBACK
        has_authentication = self.token_file is not None or self.oidc is not None
        if is_public and not has_authentication and not self.insecure:
            raise SettingsError(
                f"refusing to listen on {self.host} without authentication: everyone could use "
                "the server. Give --token-file or --oidc, listen on 127.0.0.1, or pass --insecure"
            )

    @classmethod
    def from_environment(
        cls, environ: Mapping[str, str] | None = None, /, **options: Any
    ) -> Settings:
        """Read settings from options and from ``VEHANCHOR_*`` variables.

        The system's path separator separates paths, commas separate other lists. An empty variable
        counts as unset.

        Args:
            environ: the variables; None for those of this process.
            options: settings that take precedence over variables; None counts as unset.

        Raises:
            SettingsError: a variable is malformed or invalid.
        """
        environ = os.environ if environ is None else environ
        values = {name: value for name, value in options.items() if value is not None}
        kinds = typing.get_type_hints(cls, include_extras=True)
        for setting in fields(cls):
            name = setting.name
            variable = variable_name(name)
            text = environ.get(variable)
            if name not in values and text:
                values[name] = _from_text(variable, text, kinds[name])
        return cls(**values)


def _check_image_host(host: str) -> None:
    name, _, port = host.partition(":")
    has_invalid_port = ":" in host and not port.isdigit()
    if not name or set(name) & set("/*@[]") or has_invalid_port:
        raise SettingsError(
            f"image host {host!r}: give a plain host name or name:port, without https:// or *"
        )


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
        raise SettingsError(
            f"root {root} is the whole file system; give the directory of the images"
        )
    return resolved


def _from_text(variable: str, text: str, kind: Any) -> Any:
    """Convert a variable's text to the field's type."""
    value: Any = text
    if "tuple[" in str(kind):
        separator = os.pathsep if "Path" in str(kind) else ","
        value = [part.strip() for part in text.split(separator) if part.strip()]
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as error:
        reason = error.errors()[0]["msg"].lower()
        raise SettingsError(f"{variable} is {text!r}: {reason}") from None
