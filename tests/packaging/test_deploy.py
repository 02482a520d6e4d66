"""The manifests of examples/deploy: valid, and saying what the server needs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from tests.conftest import ROOT
from tests.packaging.container import read_dockerfile
from vehanchor import __version__
from vehanchor_server.settings import Settings

DEPLOY = ROOT / "examples/deploy"
KUBERNETES_VERSIONS = ("1.33", "1.37")
OBJECTS: list[dict[str, Any]] = list(yaml.safe_load_all((DEPLOY / "kubernetes.yml").read_text()))
COMPOSE: dict[str, Any] = yaml.safe_load((DEPLOY / "compose.yml").read_text())
IMAGE = read_dockerfile(ROOT / "Dockerfile")[-1]


def of_kind(kind: str) -> dict[str, Any]:
    (found,) = (item for item in OBJECTS if item["kind"] == kind)
    return found


@pytest.mark.parametrize("version", KUBERNETES_VERSIONS)
@pytest.mark.parametrize("item", OBJECTS, ids=[item["kind"] for item in OBJECTS])
def test_every_kubernetes_object_is_valid(item: dict[str, Any], version: str) -> None:
    kubernetes_validate.validate(item, version, strict=True)


@pytest.mark.promise("deployment")
def test_the_pod_is_probed_limited_and_locked_down() -> None:
    pod = of_kind("Deployment")["spec"]["template"]["spec"]
    (container,) = pod["containers"]
    probes = {
        name: container[f"{name}Probe"]["httpGet"]["path"]
        for name in ("startup", "readiness", "liveness")
    }
    assert probes == {"startup": "/readyz", "readiness": "/readyz", "liveness": "/healthz"}
    assert set(container["resources"]["limits"]) == {"cpu", "memory"}
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    user = f"{pod['securityContext']['runAsUser']}:{pod['securityContext']['runAsGroup']}"
    assert user == IMAGE.last("USER").text
    assert str(container["ports"][0]["containerPort"]) == IMAGE.last("EXPOSE").text


def test_what_selects_the_pods_finds_them() -> None:
    labels = of_kind("Deployment")["spec"]["template"]["metadata"]["labels"]
    assert of_kind("Deployment")["spec"]["selector"]["matchLabels"] == labels
    assert of_kind("PodDisruptionBudget")["spec"]["selector"]["matchLabels"] == labels
    assert of_kind("Service")["spec"]["selector"] == labels
    target = of_kind("HorizontalPodAutoscaler")["spec"]["scaleTargetRef"]
    assert target == {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "name": of_kind("Deployment")["metadata"]["name"],
    }


def test_only_the_namespace_reaches_the_server_and_the_server_reaches_nothing() -> None:
    policy = of_kind("NetworkPolicy")["spec"]
    pod = of_kind("Deployment")["spec"]["template"]
    assert policy["podSelector"]["matchLabels"] == pod["metadata"]["labels"]
    assert set(policy["policyTypes"]) == {"Ingress", "Egress"}
    assert policy["egress"] == []
    (rule,) = policy["ingress"]
    assert rule["from"] == [{"podSelector": {}}]
    (container,) = pod["spec"]["containers"]
    assert [port["port"] for port in rule["ports"]] == [port["name"] for port in container["ports"]]


def test_the_documents_advise_a_token_that_others_cannot_read() -> None:
    (secret,) = (
        each
        for each in of_kind("Deployment")["spec"]["template"]["spec"]["volumes"]
        if "secret" in each
    )
    assert secret["secret"]["defaultMode"] & 0o007 == 0
    for text in (DEPLOY / "compose.yml", ROOT / "docs/how-to/deploy.md"):
        assert "umask 077" in text.read_text()
        assert "chmod 644" not in text.read_text()


def _settings(variables: dict[str, str], tmp_path: Path) -> Settings:
    """The server's options from a manifest's variables and the image's, with a token file that exists."""
    token = tmp_path / "token"
    token.write_text("0123456789abcdef0123456789abcdef")
    given = {
        **IMAGE.environment,
        **variables,
        "VEHANCHOR_ROOTS": str(tmp_path),
        "VEHANCHOR_TOKEN_FILE": str(token),
    }
    unknown = {name for name in given if name.startswith("VEHANCHOR_")} - {
        f"VEHANCHOR_{name.upper()}" for name in Settings.__dataclass_fields__
    }
    assert not unknown, "variables that the server does not know"
    settings = Settings.from_environment(given)
    settings.check_exposure()
    return settings


def test_the_server_understands_the_variables_that_are_set(tmp_path: Path) -> None:
    (container,) = of_kind("Deployment")["spec"]["template"]["spec"]["containers"]
    on_kubernetes = {variable["name"]: variable["value"] for variable in container["env"]}
    assert _settings(on_kubernetes, tmp_path).max_concurrency == int(
        container["resources"]["limits"]["cpu"]
    )
    mount = container["volumeMounts"][0]["mountPath"]
    assert on_kubernetes["VEHANCHOR_TOKEN_FILE"] == f"{mount}/token"

    service = COMPOSE["services"]["vehanchor"]
    settings = _settings(service["environment"], tmp_path)
    assert settings.max_concurrency == int(service["deploy"]["resources"]["limits"]["cpus"])
    assert service["environment"]["VEHANCHOR_TOKEN_FILE"] == f"/run/secrets/{service['secrets'][0]}"


@pytest.mark.promise("deployment")
def test_compose_runs_two_replicas_locked_down_and_shows_only_nginx_on_loopback() -> None:
    services = COMPOSE["services"]
    assert services["vehanchor"]["deploy"]["replicas"] == 2
    assert "ports" not in services["vehanchor"]
    assert all(port.startswith("127.0.0.1:") for port in services["nginx"]["ports"])
    for service in services.values():
        assert service["read_only"]
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true", "seccomp=builtin"]
    linted = [
        sys.executable,
        "-m",
        "compose_lint",
        "--fail-on",
        "high",
        str(DEPLOY / "compose.yml"),
    ]
    found = subprocess.run(linted, capture_output=True, text=True, check=False)
    assert found.returncode == 0, found.stdout


def test_the_images_carry_this_version() -> None:
    (container,) = of_kind("Deployment")["spec"]["template"]["spec"]["containers"]
    assert (
        container["image"]
        == COMPOSE["services"]["vehanchor"]["image"]
        == f"vehanchor:{__version__}"
    )
