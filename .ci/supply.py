#!/usr/bin/env python3
"""What an installed environment is made of, and what is known against it.

    .ci/supply.py sbom PYTHON OUT.json    CycloneDX of the environment of an interpreter: its
    distributions, and inside
                                       each the C libraries that its wheel brings; with Debian's
                                       packages, where dpkg is
    .ci/supply.py audit LOCKED.txt        known vulnerabilities of locked versions; fails, too,
    where nothing is known

Runs ``cyclonedx-py`` (cyclonedx-bom) and ``pip-audit``, which `.ci/run` gives an environment of
their own.
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

# libcrypto-5409cd36.so.1.1.1k, libgdal-7562cabc.so.36.3.10.2, libopenblasp-r0-59ffcd50.3.15.so
_LIBRARY = re.compile(
    r"^lib(?P<name>[\w+]+?)(?:-[\w.]*?)?(?:-[0-9a-f]{8})?(?P<before>(?:\.\d+)*)\.so(?:\.(?P<after>[\w.]+))?$"
)
# What is linked into an extension module shows only in its text.
_LINKED = {
    "OpenSSL": rb"OpenSSL (\d+\.\d+\.\d+[a-z]?)",
    "zlib": rb"(?:in|de)flate (\d+\.\d+\.\d+)",
    "FFmpeg": rb"FFmpeg version (\d[\w.]+)",
}


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    sbom = commands.add_parser("sbom")
    sbom.add_argument("python", type=Path)
    sbom.add_argument("out", type=Path)
    audit_parser = commands.add_parser("audit")
    audit_parser.add_argument("requirements", type=Path)
    options = parser.parse_args()
    if options.command == "sbom":
        bill = bill_of_materials(options.python)
        options.out.write_text(json.dumps(bill, indent=1) + "\n")
        inside = sum(len(component.get("components", [])) for component in bill["components"])
        print(
            f"{options.out}: {len(bill['components'])} components, {inside} C libraries inside "
            "wheels"
        )
        return 0
    found = verdict(audited(options.requirements))
    print("\n".join(found) or "nothing is known against any of them")
    return 1 if found else 0


def bill_of_materials(python: Path) -> dict[str, Any]:
    """CycloneDX 1.6 of an interpreter's environment, as a JSON object."""
    command = ["cyclonedx-py", "environment", str(python), "--of", "JSON", "--output-reproducible"]
    bill: dict[str, Any] = json.loads(
        subprocess.run(command, check=True, capture_output=True, text=True).stdout
    )
    where = [str(python), "-c", "import sysconfig; print(sysconfig.get_path('platlib'))"]
    site = Path(subprocess.run(where, check=True, capture_output=True, text=True).stdout.strip())
    for component in bill["components"]:
        libraries = native(site, component["name"])
        if libraries:
            component["components"] = libraries
    bill["components"] += debian()
    return bill


def native(site: Path, distribution: str) -> list[dict[str, str]]:
    """The C libraries that a distribution's wheel brings: beside its modules, and linked into them."""
    record = next(site.glob(f"{re.sub(r'[-_.]+', '_', distribution)}-*.dist-info/RECORD"), None)
    if record is None:
        return []
    names = [line.split(",")[0] for line in record.read_text().splitlines()]
    shared = [Path(name) for name in names if re.search(r"\.(so|dylib|dll)(\.|$)", Path(name).name)]
    found: dict[tuple[str, str], str] = {}
    for path in shared:
        match = _LIBRARY.match(path.name)
        if match:
            version = (match["after"] or match["before"]).strip(".")
            found[match["name"], version] = str(path)
        content = (site / path).read_bytes()
        for name, pattern in _LINKED.items():
            for version in {each.decode() for each in re.findall(pattern, content)}:
                found.setdefault((name, version), str(path))
    return [
        {"type": "library", "name": name, "version": version, "description": f"in {path}"}
        for (name, version), path in sorted(found.items())
    ]


def debian() -> list[dict[str, str]]:
    """The packages of a Debian below; none elsewhere."""
    if shutil.which("dpkg-query") is None:
        return []
    command = ["dpkg-query", "-W", "-f", "${Package} ${Version} ${Architecture}\n"]
    lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    return [
        {
            "type": "library",
            "name": name,
            "version": version,
            "purl": f"pkg:deb/debian/{name}@{version}?arch={machine}",
        }
        for name, version, machine in (line.split() for line in lines)
    ]


def audited(requirements: Path) -> dict[str, Any]:
    """What ``pip-audit`` says of locked requirements, as a JSON object."""
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
        raise SystemExit(
            f"error: pip-audit gives no answer: {run.stderr.strip()[-2000:]}"
        ) from None
    return answer


def verdict(answer: dict[str, Any]) -> list[str]:
    """What speaks against the requirements, a line each: known vulnerabilities, and whatever nobody could look up.

    ``pip-audit`` says "No known vulnerabilities found" and exits with 0 where its database did not
    answer.
    """
    dependencies = answer.get("dependencies", [])
    if not dependencies:
        return ["pip-audit looked at nothing"]
    lines = []
    for each in dependencies:
        if "skip_reason" in each:
            lines.append(f"{each['name']}: not looked up: {each['skip_reason']}")
        for flaw in each.get("vulns", []):
            mended = ", ".join(flaw["fix_versions"]) or "no version"
            lines.append(f"{each['name']} {each['version']}: {flaw['id']}, mended in {mended}")
    return lines


if __name__ == "__main__":
    sys.exit(main())
