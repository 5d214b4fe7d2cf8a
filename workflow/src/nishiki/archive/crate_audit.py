"""Audit a packed scene by itself: without results, configuration or, perhaps, photographs.

A crate may come from a stranger: nothing is written, no link is followed, no name leads outside, and no file is held in
memory but manifests of a bounded size.
"""

import hashlib
import json
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from zipfile import BadZipFile

from nishiki.archive.audit import CAPTURE, Damage, Survey, survey_artifact
from nishiki.archive.crate import MANIFEST, parse_manifest_text
from nishiki.archive.pack import FolderContents, FolderTree, Tree, ZipTree
from nishiki.artifacts.artifact import MANIFEST as ARTIFACT
from nishiki.artifacts.artifact import is_inside
from nishiki.artifacts.packed import METADATA
from nishiki.artifacts.provenance import scene_of_field
from nishiki.formats.files import name_fault
from nishiki.threads import in_threads

ARTIFACT_FOLDER = re.compile(r"(artifacts/([A-Za-z0-9_-]+/)??[a-z_0-9]+/([0-9a-f]{12}))/")
CAPTURE_FOLDER, SEAL = "capture/", "manifest-sha256.txt"


@dataclass
class CrateAudit:
    """Running findings of an audit of a crate."""

    root: Path
    digest: str = ""
    scene: str = ""
    capture: str = ""  # digest; those of a mosaic's fields with commas between them
    photographs: bool = False
    files: int = 0
    bytes: int = 0
    stages: list[str] = field(default_factory=list)

    def damage(self, name: str, kind: str, detail: str) -> Damage:
        """Make one damage of the crate."""
        return Damage(self.root / name if name else self.root, kind, detail)


def is_crate(path: Path) -> bool:
    """Return whether this is a packed scene: a folder with a crate's description, or a ZIP file."""
    return (path.is_dir() and (path / METADATA).is_file()) or (path.is_file() and path.suffix.lower() == ".zip")


def audit_crate(audit: CrateAudit, *, threads: int, tell: Callable[[int, int, str], None]) -> Iterator[Damage]:
    """Yield every damage of a crate: files, links, manifests, keys, the way from the capture to every result."""
    try:
        tree = ZipTree(audit.root) if audit.root.is_file() else FolderTree(audit.root)
    except (BadZipFile, OSError, ValueError, NotImplementedError, struct.error) as error:
        yield audit.damage("", "unreadable", f"not a readable ZIP file: {error}")
        return
    listing = tree.listing()
    yield from _shape(audit, tree, listing)
    try:
        data = tree.read(MANIFEST)
        listed = parse_manifest_text(data)
    except (OSError, ValueError) as error:
        yield audit.damage(MANIFEST, "damaged" if MANIFEST in listing.files else "missing", str(error))
        return
    audit.digest = hashlib.sha256(data).hexdigest()
    for name in sorted(set(listed) - {*listing.files, *listing.links, *listing.others}):
        yield audit.damage(name, "missing", f"listed in {MANIFEST}")
    for name in sorted(set(listing.files) - set(listed) - {MANIFEST}):
        yield audit.damage(name, "foreign", f"not in {MANIFEST}")
    digests_read: dict[str, str] = {}
    yield from _contents(audit, tree, listing, listed, digests_read, threads, tell)
    everything = [*listing.files, *listing.links, *listing.others]
    folders = sorted({(match[1], match[3]) for name in everything if (match := ARTIFACT_FOLDER.match(name))})
    surveys = [survey_artifact(tree, folder, name=key) for folder, key in folders]
    for survey in surveys:
        yield from _artifact(survey, digests_read)
    yield from _chain(audit, surveys)
    yield from _capture(audit, tree, listing, listed, surveys)
    yield from _description(audit, tree, surveys)


def _shape(audit: CrateAudit, tree: Tree, listing: FolderContents) -> Iterator[Damage]:
    for name, target in listing.links.items():
        yield audit.damage(name, "link", f"a crate holds files, not links; to {target}")
    for name, what in listing.others.items():
        yield audit.damage(name, "foreign", what)
    for name, why in listing.unreadable.items():
        yield audit.damage(name, "unreadable", why)
    if isinstance(tree, ZipTree):
        for name in tree.repeated:
            yield audit.damage(name, "foreign", "appears more than once in the ZIP file")
        for name in tree.members:
            if not is_inside(name.rstrip("/")) or name_fault(name):
                yield audit.damage("", "foreign", f"a name that may lead outside: {name}")
        if sum(listing.files.values()) > audit.root.stat().st_size:
            yield audit.damage("", "damaged", "files overlap inside the ZIP file")


def _contents(
    audit: CrateAudit,
    tree: Tree,
    listing: FolderContents,
    listed: dict[str, str],
    digests_read: dict[str, str],
    threads: int,
    tell: Callable[[int, int, str], None],
) -> Iterator[Damage]:
    """Digest every listed file once, and fill `digests_read`."""
    names = [name for name in sorted(listed) if name in listing.files]
    # A ZIP file is one file handle: several threads would only wait for each other.
    most = 1 if isinstance(tree, ZipTree) else threads
    for name, digest, error in in_threads(lambda name: _digest(tree, name), names, most, 4 * most):
        audit.files += 1
        audit.bytes += listing.files[name]
        digests_read[name] = digest
        if error:
            yield audit.damage(name, "unreadable", error)
        elif digest != listed[name]:
            yield audit.damage(name, "damaged", f"sha256 {digest[:12]}…, expected {listed[name][:12]}…")
        tell(audit.files, len(names), f"{audit.bytes / 1e9:.2f} GB")


def _digest(tree: Tree, name: str) -> tuple[str, str, str]:
    try:
        return name, tree.digest(name), ""
    except OSError as error:
        return name, "", str(error.strerror)


def _artifact(survey: Survey, digests_read: dict[str, str]) -> Iterator[Damage]:
    """Compare an artifact with its own manifest; its files were read before."""
    yield from survey.damages
    for name, sha256 in survey.to_read:
        digest = digests_read.get(survey.member_name(name))
        if digest is not None and digest != sha256:
            yield Damage(survey.folder / name, "damaged", f"not what its {ARTIFACT} says", survey.folder)
    if survey.stage and survey.stage != survey.folder.parent.name:
        yield Damage(survey.folder, "misplaced", f"made by stage {survey.stage}", survey.folder)


def _chain(audit: CrateAudit, surveys: list[Survey]) -> Iterator[Damage]:
    """Check that every result was made from results in the crate, the first from one capture, all of one scene."""
    digests = {survey.below: survey.digest for survey in surveys}
    scenes: set[str] = set()
    captures = _captures_of(surveys)
    fields = {_field_of(survey) for survey in surveys}
    for survey in surveys:
        own = _field_of(survey)
        audit.stages.append(own + survey.stage)
        scenes |= {survey.scene.removesuffix(scene_of_field("", own[:-1]) if own else "")} - {""}
        for stage, (key, digest) in survey.upstream.items():
            if stage == CAPTURE:
                continue
            if (above := f"artifacts/{own}{stage}/{key}") not in digests:
                yield Damage(survey.folder, "incomplete", f"made from {stage}/{key}, which is not in the crate")
            elif digests[above] != digest:
                yield Damage(survey.folder, "stale", f"made from another version of {stage}/{key}")
    audit.scene = next(iter(sorted(scenes)), "")
    audit.capture = ", ".join(sorted(captures))
    if not surveys:
        yield audit.damage("artifacts", "incomplete", "the crate holds no result")
    if len(scenes) > 1:
        yield audit.damage("artifacts", "misplaced", f"results of several scenes: {', '.join(sorted(scenes))}")
    expected = len(fields - {""}) or 1
    if surveys and len(captures) != expected:
        found = f"the results go back to {len(captures)} captures, expected {expected}"
        yield audit.damage("artifacts", "incomplete", found)


def _captures_of(surveys: list[Survey]) -> set[str]:
    """Return digests of the captures that artifacts were made from."""
    return {survey.upstream[CAPTURE][1] for survey in surveys if CAPTURE in survey.upstream}


def _field_of(survey: Survey) -> str:
    """Return the field of a mosaic that an artifact is of, with a slash after it; empty where it is of none."""
    own = survey.below.split("/")[1:-2]
    return f"{own[0]}/" if own else ""


def _capture(
    audit: CrateAudit, tree: Tree, listing: FolderContents, listed: dict[str, str], surveys: list[Survey]
) -> Iterator[Damage]:
    """Check that the results lead back to this seal and that all or none of the capture's files are present."""
    from nishiki.capture.seal import manifest_text

    bags: list[str] = []  # of a mosaic one for each field
    for name in sorted(listing.files, key=lambda name: (name.count("/"), name)):
        if name.startswith(CAPTURE_FOLDER) and name.endswith(f"/{SEAL}"):
            bag = name.removesuffix(SEAL)
            bags += [] if any(bag.startswith(f"{other}data/") for other in bags) else [bag]
    found, captures = set(), _captures_of(surveys)
    for bag in bags or [CAPTURE_FOLDER]:
        try:
            sealed = parse_seal(tree.read(f"{bag}{SEAL}"))
        except (OSError, ValueError) as error:
            yield audit.damage(f"{bag}{SEAL}", "damaged" if bags else "missing", str(error))
            return
        digest = hashlib.sha256(manifest_text(sealed).encode()).hexdigest()
        found.add(digest)
        if captures and digest not in captures:
            made = ", ".join(f"{each[:12]}…" for each in sorted(captures))
            yield audit.damage(f"{bag}{SEAL}", "damaged", f"capture {digest[:12]}…, the results were made from {made}")
        present = {name.removeprefix(bag) for name in listing.files if name.startswith(f"{bag}data/")}
        audit.photographs |= bool(present)
        for name in sorted(set(sealed) - present) if present else ():
            yield audit.damage(f"{bag}{name}", "missing", "listed in the seal of the capture")
        for name in sorted(present):
            if name not in sealed:
                yield audit.damage(f"{bag}{name}", "foreign", "not in the seal of the capture")
            elif listed.get(f"{bag}{name}") != sealed[name]:
                yield audit.damage(f"{bag}{name}", "damaged", "changed after sealing")
    if len(bags) > 1:
        for digest in sorted(captures - found):
            yield audit.damage(CAPTURE_FOLDER, "incomplete", f"no seal of the capture {digest[:12]}…")


def parse_seal(data: bytes) -> dict[str, str]:
    """Parse digests by name from a bag's manifest. Raises ValueError for other lines and names that lead outside."""
    from nishiki.capture.seal import manifest_entry

    digests = {}
    for number, line in enumerate(data.decode("utf-8").splitlines(), start=1):
        entry = manifest_entry(line)
        if entry is None or not is_inside(entry[0]):
            raise ValueError(f"line {number}: expected 64 hexadecimal digits and a name inside the bag")
        digests[entry[0]] = entry[1]
    return digests


def _description(audit: CrateAudit, tree: Tree, surveys: list[Survey]) -> Iterator[Damage]:
    """Check that the description names every result and its sources."""
    try:
        graph = json.loads(tree.read(METADATA))["@graph"]
        entities = {str(entity["@id"]): entity for entity in graph}
        for survey in surveys:
            folder = f"{survey.below}/"
            identifier = entities.get(folder, {}).get("identifier")
            own = _field_of(survey)
            made = {entry["@id"] for entry in entities.get(f"#run-{own}{survey.stage}", {}).get("object", [])}
            above = {
                "capture/" if stage == CAPTURE else f"artifacts/{own}{stage}/{key}/"
                for stage, (key, _) in survey.upstream.items()
            }
            if identifier != f"sha256:{survey.digest}" or not above <= made:
                yield audit.damage(METADATA, "damaged", f"does not describe {folder} as it is")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        yield audit.damage(METADATA, "damaged", f"not a description of a crate ({type(error).__name__})")
