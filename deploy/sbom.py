"""Bill of materials (SBOM) of an installation: CycloneDX 1.6, from a lock file and installed metadata.

    .venv/bin/python deploy/sbom.py requirements.lock > gridsec.cdx.json      (make sbom)

A component is a package of the lock file that is installed; a different installed version is an error. Names,
licenses, home pages and dependencies are those of the installed metadata, hashes those of the lock file. The
same installation gives the same file: its time is SOURCE_DATE_EPOCH, or left out.
"""

from __future__ import annotations

import json
import os
import re
import sys
import uuid
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

PROJECT = "gridsec"
SPEC = "1.6"
_PIN = re.compile(r"^([A-Za-z0-9._-]+)==([^ ;\\]+)(?: ; ([^\\]+?))? *\\?$")
_HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})")
_SPDX = re.compile(r"^[A-Za-z0-9.+-]+( (AND|OR|WITH) [A-Za-z0-9.+-]+)*$")
_CLASSIFIERS = {
    "License :: OSI Approved :: Apache Software License": "Apache-2.0",
    "License :: OSI Approved :: BSD License": "BSD",
    "License :: OSI Approved :: ISC License (ISCL)": "ISC",
    "License :: OSI Approved :: MIT License": "MIT",
    "License :: OSI Approved :: Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "License :: OSI Approved :: Python Software Foundation License": "PSF-2.0",
}
"""Names of licenses in the metadata of packages without a license expression."""


def pins(lock: str) -> dict[str, dict[str, list[str]]]:
    """SHA-256 of the files of each package for this system and Python, by name and version."""
    out: dict[str, dict[str, list[str]]] = {}
    current: list[str] = []
    for line in lock.splitlines():
        if pin := _PIN.match(line):
            current = []
            if not pin[3] or Marker(pin[3]).evaluate():
                out.setdefault(canonicalize_name(pin[1]), {})[pin[2]] = current
        current += _HASH.findall(line)
    return out


def installed(names: Mapping[str, Mapping[str, list[str]]]) -> dict[str, Distribution]:
    """Installed distributions of the locked packages, by name.

    Raises SystemExit if a package has another version than the lock file.
    """
    found, wrong = {}, []
    for name, versions in sorted(names.items()):
        try:
            found[name] = distribution(name)
        except PackageNotFoundError:  # an installation without the build backend
            continue
        if found[name].version not in versions:
            wrong.append(f"{name} {found[name].version} is installed; expected {' or '.join(versions)}")
    if wrong:
        sys.exit("\n".join(wrong))
    return found


def requirements(dist: Distribution) -> list[Requirement]:
    """Requirements of a distribution, those of its extras included."""
    return [Requirement(text) for text in dist.requires or ()]


def graph(main: Distribution, found: Mapping[str, Distribution]) -> list[dict[str, Any]]:
    """Needs of each component here, with the extras that other components ask for."""
    wanted = {reference(each): requirements(each) for each in (main, *found.values())}
    extras: dict[str, set[str]] = {}
    for each in (each for listed in wanted.values() for each in listed):
        if each.extras and (each.marker is None or each.marker.evaluate({"extra": ""})):
            extras.setdefault(canonicalize_name(each.name), set()).update(each.extras)
    out = []
    for dist in (main, *found.values()):
        own = ["", *sorted(extras.get(canonicalize_name(dist.metadata["Name"]), ()))]
        needed = {
            reference(found[name])
            for each in wanted[reference(dist)]
            if (name := canonicalize_name(each.name)) in found
            if each.marker is None or any(each.marker.evaluate({"extra": extra}) for extra in own)
        }
        out.append({"ref": reference(dist), "dependsOn": sorted(needed)})
    return out


def licenses(dist: Distribution) -> list[dict[str, Any]]:
    """License of a distribution: its expression, else its classifiers, else its text if that is a name."""
    expression = dist.metadata.get("License-Expression")
    if expression:
        return [{"expression": expression}]
    known = [_CLASSIFIERS[each] for each in dist.metadata.get_all("Classifier") or () if each in _CLASSIFIERS]
    text = (dist.metadata.get("License") or "").strip()
    if not known and _SPDX.match(text):
        known = [text]
    return [{"license": {"name": each}} for each in dict.fromkeys(known)]


def component(dist: Distribution, hashes: list[str], kind: str) -> dict[str, Any]:
    """Component of a distribution."""
    name = canonicalize_name(dist.metadata["Name"])
    urls = [each.partition(", ") for each in dist.metadata.get_all("Project-URL") or ()]
    pages = [url for label, _, url in urls if label.lower() in {"homepage", "home", "repository", "source"}]
    page = dist.metadata.get("Home-page") or next(iter(pages), None)
    out: dict[str, Any] = {
        "type": kind,
        "bom-ref": reference(dist),
        "name": name,
        "version": dist.version,
        "purl": reference(dist),
        "licenses": licenses(dist),
    }
    if page:
        out["externalReferences"] = [{"type": "website", "url": page}]
    if hashes:
        # A package has several files, and one of them is installed.
        out["properties"] = [{"name": "gridsec:lock:sha256", "value": each} for each in sorted(hashes)]
    return {key: value for key, value in out.items() if value}


def reference(dist: Distribution) -> str:
    """Package URL of a distribution."""
    return f"pkg:pypi/{canonicalize_name(dist.metadata['Name'])}@{dist.version}"


def bill(lock: str, epoch: str | None = None) -> dict[str, Any]:
    """Bill of materials.

    lock: text of the lock file.
    epoch: time of the bill, Unix s; None leaves it out.
    """
    locked, main = pins(lock), distribution(PROJECT)
    found = installed(locked)
    parts = [component(each, locked[name][each.version], "library") for name, each in found.items()]
    tree = graph(main, found)
    metadata: dict[str, Any] = {"component": component(main, [], "application")}
    if epoch is not None:
        when = datetime.fromtimestamp(int(epoch), UTC)
        metadata["timestamp"] = when.isoformat().replace("+00:00", "Z")
    content = {"metadata": metadata, "components": parts, "dependencies": tree}
    number = uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(content, sort_keys=True))
    return {
        "$schema": f"http://cyclonedx.org/schema/bom-{SPEC}.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": SPEC,
        "serialNumber": f"urn:uuid:{number}",
        "version": 1,
        **content,
    }


if __name__ == "__main__":
    text = Path(sys.argv[1]).read_text("utf-8")
    print(json.dumps(bill(text, os.environ.get("SOURCE_DATE_EPOCH")), indent=1, ensure_ascii=False))
