"""A crate against the shapes of its profile, with the package roc-validator, without a network.

The package ships the profiles but fetches the two JSON-LD contexts from w3id.org. Here they are stood in for: both map
nearly every term to the schema.org term of the same name; the exceptions that we use are listed. As a program:

    uv run --no-project --with roc-validator python tests/crate_profile.py CRATE
"""

import json
import sys
from pathlib import Path
from typing import Any

PROFILE = "provenance-run-crate"
SCHEMA = "http://schema.org/"
RUN = "https://w3id.org/ro/terms/workflow-run#"
BIOSCHEMAS = "https://bioschemas.org/"
EXCEPTIONS = {
    "File": f"{SCHEMA}MediaObject",
    "conformsTo": "http://purl.org/dc/terms/conformsTo",
    "ComputationalWorkflow": f"{BIOSCHEMAS}ComputationalWorkflow",
    "FormalParameter": f"{BIOSCHEMAS}FormalParameter",
    "input": f"{BIOSCHEMAS}ComputationalWorkflow#input",
    "output": f"{BIOSCHEMAS}ComputationalWorkflow#output",
    "sha256": f"{RUN}sha256",
}
ALLOWED = (
    "agent that is a Person or Organization",  # who ran the computer is recorded nowhere
    "organizational affiliation",  # capture.yaml asks for a name only
    "`publisher` property",  # whoever publishes the crate knows; who packs it does not
    "The Application SHOULD have a url",  # none is recorded for the project
    "id SHOULD be an absolute URI",  # scripts and workflow are files of the crate, with relative names
)
"""Recommendations that are not followed, each with its reason."""


def contexts(description: dict[str, Any]) -> dict[str, Any]:
    """What the two contexts say of the terms of a description."""
    terms = {term for entity in description["@graph"] for term in entity if not term.startswith("@")}
    for entity in description["@graph"]:
        kinds = entity["@type"]
        terms |= set(kinds if isinstance(kinds, list) else [kinds])
    return {"@context": {term: EXCEPTIONS.get(term, SCHEMA + term) for term in sorted(terms)}}


def problems(crate: Path, *, severity: str = "REQUIRED") -> list[str]:
    """Everything in a crate that its profile, or one that it builds on, finds wrong."""
    import requests
    from rocrate_validator import models, services
    from rocrate_validator.utils.http import HttpRequester

    known = json.dumps(contexts(json.loads((crate / "ro-crate-metadata.json").read_text()))).encode()

    def get(self, url: str, *_: Any, **__: Any) -> requests.Response:
        response = requests.Response()
        response.status_code = 200 if url.endswith("/context") else 404
        response._content = known
        response.headers["Content-Type"] = "application/ld+json"
        return response

    HttpRequester.get = get
    settings = services.ValidationSettings(
        rocrate_uri=str(crate),
        profile_identifier=PROFILE,
        requirement_severity=models.Severity[severity],
        skip_availability_check=True,
    )
    result = services.validate(settings)
    return sorted(
        f"{issue.check.identifier} {issue.severity.name}: {issue.message} {issue.violatingEntity or ''}"
        for issue in result.get_issues()
    )


if __name__ == "__main__":
    found = problems(Path(sys.argv[1]), severity="RECOMMENDED")
    print("\n".join(found))
    print(f"{len(found)} findings, {sum('REQUIRED' in line for line in found)} of them of requirements")
