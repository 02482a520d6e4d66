#!/usr/bin/env python3
"""List the parts of an installed environment, and the known vulnerabilities of its packages.

    .ci/supply.py sbom PYTHON OUT.json
        Write the bill of materials (CycloneDX) of an interpreter's environment: its distributions,
        the C libraries inside their wheels, and Debian's packages where dpkg is installed.
    .ci/supply.py audit LOCKED.txt
        List the known vulnerabilities of locked versions. The command also fails if a version
        could not be looked up.

The script runs ``cyclonedx-py`` (cyclonedx-bom) and ``pip-audit``. `.ci/run` installs them in an
environment of their own.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

# Names of libraries in wheels, with a checksum and the version before or after ".so", such as
# libcrypto-5409cd36.so.1.1.1k, libgdal-7562cabc.so.36.3.10.2, libopenblasp-r0-59ffcd50.3.15.so.
_LIBRARY = re.compile(
    r"^lib(?P<name>[\w+]+?)(?:-[\w.]*?)?(?:-[0-9a-f]{8})?"
    r"(?P<before>(?:\.\d+)*)\.so(?:\.(?P<after>[\w.]+))?$"
)
# A library that is linked into an extension module shows only in the module's text.
_LINKED = {
    "OpenSSL": rb"OpenSSL (\d+\.\d+\.\d+[a-z]?)",
    "zlib": rb"(?:in|de)flate (\d+\.\d+\.\d+)",
    "FFmpeg": rb"FFmpeg version (\d[\w.]+)",
}


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    sbom = commands.add_parser("sbom")
    sbom.add_argument("python", type=Path)
    sbom.add_argument("out", type=Path)
    audit = commands.add_parser("audit")
    audit.add_argument("requirements", type=Path)
    options = parser.parse_args()
    if options.command == "sbom":
        return write_bill(options.python, options.out)
    return report_audit(options.requirements)


def write_bill(python: Path, out: Path) -> int:
    """Write the bill of materials; return the exit status."""
    bill = bill_of_materials(python)
    out.write_text(json.dumps(bill, indent=1) + "\n")
    components = bill["components"]
    n_inside = sum(len(component.get("components", [])) for component in components)
    print(f"{out}: {len(components)} components, {n_inside} C libraries inside wheels")
    return 0


def report_audit(requirements: Path) -> int:
    """Print the objections to locked requirements; return the exit status."""
    objections = verdict(audited(requirements))
    if objections:
        print("\n".join(objections))
        return 1
    print("no vulnerability is known")
    return 0


def bill_of_materials(python: Path) -> dict[str, Any]:
    """Make the CycloneDX 1.6 of an interpreter's environment, as a JSON object."""
    command = ["cyclonedx-py", "environment", str(python), "--of", "JSON", "--output-reproducible"]
    bill: dict[str, Any] = json.loads(output_of(command))
    site_query = "import sysconfig; print(sysconfig.get_path('platlib'))"
    site = Path(output_of([str(python), "-c", site_query]).strip())
    for component in bill["components"]:
        libraries = native(site, component["name"])
        if libraries:
            component["components"] = libraries
    bill["components"] += debian()
    return bill


def output_of(command: list[str]) -> str:
    """Run a command that must succeed; return its output."""
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout


def native(site: Path, distribution: str) -> list[dict[str, str]]:
    """List the C libraries in a distribution's wheel.

    They lie beside its modules, or are linked into them.
    """
    stem = re.sub(r"[-_.]+", "_", distribution)
    record = next(site.glob(f"{stem}-*.dist-info/RECORD"), None)
    if record is None:
        return []
    names = [line.split(",")[0] for line in record.read_text().splitlines()]
    paths = [Path(name) for name in names if re.search(r"\.(so|dylib|dll)(\.|$)", Path(name).name)]
    # The first path of each library and version.
    libraries: dict[tuple[str, str], str] = {}
    for path in paths:
        match = _LIBRARY.match(path.name)
        if match:
            version = (match["after"] or match["before"]).strip(".")
            libraries[match["name"], version] = str(path)
        content = (site / path).read_bytes()
        for name, pattern in _LINKED.items():
            for version_text in set(re.findall(pattern, content)):
                libraries.setdefault((name, version_text.decode()), str(path))
    return [
        {"type": "library", "name": name, "version": version, "description": f"in {path}"}
        for (name, version), path in sorted(libraries.items())
    ]


def debian() -> list[dict[str, str]]:
    """List the packages of the Debian system; the list is empty on other systems."""
    if shutil.which("dpkg-query") is None:
        return []
    query = ["dpkg-query", "-W", "-f", "${Package} ${Version} ${Architecture}\n"]
    packages = []
    for line in output_of(query).splitlines():
        name, version, machine = line.split()
        package = {
            "type": "library",
            "name": name,
            "version": version,
            "purl": f"pkg:deb/debian/{name}@{version}?arch={machine}",
        }
        packages.append(package)
    return packages


def audited(requirements: Path) -> dict[str, Any]:
    """Run ``pip-audit`` on locked requirements; return its answer, a JSON object."""
    command = [
        "pip-audit",
        "--requirement",
        str(requirements),
        "--require-hashes",
        "--disable-pip",
        "--format",
        "json",
    ]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        answer: dict[str, Any] = json.loads(run.stdout)
    except json.JSONDecodeError:
        reason = run.stderr.strip()[-2000:]
        raise SystemExit(f"error: pip-audit gives no answer: {reason}") from None
    return answer


def verdict(answer: dict[str, Any]) -> list[str]:
    """List the objections to the requirements, one a line.

    They are known vulnerabilities, and packages that could not be looked up. ``pip-audit`` itself
    reports "No known vulnerabilities found" and exits with 0 if its database did not answer.
    """
    dependencies = answer.get("dependencies", [])
    if not dependencies:
        return ["pip-audit looked at nothing"]
    objections = []
    for package in dependencies:
        name = package["name"]
        if "skip_reason" in package:
            objections.append(f"{name}: not looked up: {package['skip_reason']}")
        for flaw in package.get("vulns", []):
            fixed = ", ".join(flaw["fix_versions"]) or "no version"
            objections.append(f"{name} {package['version']}: {flaw['id']}, fixed in {fixed}")
    return objections


if __name__ == "__main__":
    sys.exit(main())
