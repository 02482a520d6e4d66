"""Requirements of the installation: which package a failed import lacks."""

from __future__ import annotations

import re
from importlib.metadata import PackageNotFoundError, packages_distributions, requires, version

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def unmet_requirement(error: ImportError) -> str | None:
    """Describe the package behind a failed import: what is needed, and what is installed.

    Args:
        error: the failed import.

    Returns:
        A clause such as "it needs mcp>=2.3,<3, and mcp 1.9.4 is installed"; None if no package
        that VehAnchor requires has the module, so that the error is its own.
    """
    if error.name is None:
        return None
    module = error.name.partition(".")[0]
    packages = {module, *packages_distributions().get(module, ())}
    normal_names = {_normalised(package) for package in packages}
    for line in requires("vehanchor") or ():
        requirement, _, condition = line.partition(";")
        name = _NAME.match(requirement)
        if name is None or "extra" in condition:
            continue
        if _normalised(name.group()) in normal_names:
            return f"it needs {requirement.strip()}, and {_installed(name.group())}"
    return None


def _normalised(name: str) -> str:
    """Normalise the name of a package (PEP 503)."""
    return re.sub(r"[-_.]+", "-", name).lower()


def _installed(name: str) -> str:
    try:
        return f"{name} {version(name)} is installed"
    except PackageNotFoundError:
        return f"{name} is not installed"
