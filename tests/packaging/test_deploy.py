"""The manifests of examples/deploy are valid and contain what the server needs."""

from __future__ import annotations

import re
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
    (manifest,) = [item for item in OBJECTS if item["kind"] == kind]
    return manifest


def pod_spec() -> dict[str, Any]:
    spec: dict[str, Any] = of_kind("Deployment")["spec"]["template"]["spec"]
    return spec


def pod_container() -> dict[str, Any]:
    (container,) = pod_spec()["containers"]
    manifest: dict[str, Any] = container
    return manifest


@pytest.mark.parametrize("version", KUBERNETES_VERSIONS)
@pytest.mark.parametrize("item", OBJECTS, ids=[item["kind"] for item in OBJECTS])
def test_every_kubernetes_object_is_valid(item: dict[str, Any], version: str) -> None:
    kubernetes_validate.validate(item, version, strict=True)


@pytest.mark.promise("deployment")
def test_the_pod_is_probed() -> None:
    container = pod_container()
    paths = {
        name: container[f"{name}Probe"]["httpGet"]["path"]
        for name in ("startup", "readiness", "liveness")
    }
    assert paths == {"startup": "/readyz", "readiness": "/readyz", "liveness": "/healthz"}


@pytest.mark.promise("deployment")
def test_the_pod_has_limits() -> None:
    assert set(pod_container()["resources"]["limits"]) == {"cpu", "memory"}


@pytest.mark.promise("deployment")
def test_the_pod_is_locked_down() -> None:
    assert pod_container()["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }


@pytest.mark.promise("deployment")
def test_the_pod_has_the_user_of_the_image() -> None:
    context = pod_spec()["securityContext"]
    assert f"{context['runAsUser']}:{context['runAsGroup']}" == IMAGE.last("USER").text


def test_the_pod_has_the_port_of_the_image() -> None:
    assert str(pod_container()["ports"][0]["containerPort"]) == IMAGE.last("EXPOSE").text


def pod_labels() -> dict[str, str]:
    labels: dict[str, str] = of_kind("Deployment")["spec"]["template"]["metadata"]["labels"]
    return labels


def test_every_selector_selects_the_pods() -> None:
    labels = pod_labels()
    assert of_kind("Deployment")["spec"]["selector"]["matchLabels"] == labels
    assert of_kind("PodDisruptionBudget")["spec"]["selector"]["matchLabels"] == labels
    assert of_kind("Service")["spec"]["selector"] == labels


def test_the_autoscaler_scales_the_deployment() -> None:
    target = of_kind("HorizontalPodAutoscaler")["spec"]["scaleTargetRef"]
    assert target == {
        "apiVersion": "apps/v1",
        "kind": "Deployment",
        "name": of_kind("Deployment")["metadata"]["name"],
    }


def test_only_the_namespace_reaches_the_server() -> None:
    policy = of_kind("NetworkPolicy")["spec"]
    assert policy["podSelector"]["matchLabels"] == pod_labels()
    assert "Ingress" in policy["policyTypes"]
    (rule,) = policy["ingress"]
    assert rule["from"] == [{"podSelector": {}}]
    ports = [port["name"] for port in pod_container()["ports"]]
    assert [port["port"] for port in rule["ports"]] == ports


def test_the_server_reaches_nothing() -> None:
    policy = of_kind("NetworkPolicy")["spec"]
    assert set(policy["policyTypes"]) == {"Ingress", "Egress"}
    assert policy["egress"] == []


def test_others_cannot_read_the_token() -> None:
    (volume,) = [volume for volume in pod_spec()["volumes"] if "secret" in volume]
    assert volume["secret"]["defaultMode"] & 0o007 == 0


@pytest.mark.parametrize("path", [DEPLOY / "compose.yml", ROOT / "docs/how-to/deploy.md"])
def test_the_documents_advise_a_token_that_others_cannot_read(path: Path) -> None:
    text = path.read_text()
    assert "umask 077" in text
    assert "chmod 644" not in text


def _settings(variables: dict[str, str], tmp_path: Path) -> Settings:
    """Read the server's options from the variables of a manifest and of the image."""
    token = tmp_path / "token"
    token.write_text("0123456789abcdef0123456789abcdef")
    environment = {
        **IMAGE.environment,
        **variables,
        "VEHANCHOR_ROOTS": str(tmp_path),
        "VEHANCHOR_TOKEN_FILE": str(token),
    }
    named = {name for name in environment if name.startswith("VEHANCHOR_")}
    known = {f"VEHANCHOR_{name.upper()}" for name in Settings.__dataclass_fields__}
    assert named <= known, "variables that the server does not know"
    settings = Settings.from_environment(environment)
    settings.check_exposure()
    return settings


def test_the_server_understands_the_variables_of_the_pod(tmp_path: Path) -> None:
    container = pod_container()
    variables = {variable["name"]: variable["value"] for variable in container["env"]}
    settings = _settings(variables, tmp_path)
    assert settings.max_concurrency == int(container["resources"]["limits"]["cpu"])
    mount = container["volumeMounts"][0]["mountPath"]
    assert variables["VEHANCHOR_TOKEN_FILE"] == f"{mount}/token"


def test_the_server_understands_the_variables_of_compose(tmp_path: Path) -> None:
    service = COMPOSE["services"]["vehanchor"]
    variables = service["environment"]
    settings = _settings(variables, tmp_path)
    assert settings.max_concurrency == int(service["deploy"]["resources"]["limits"]["cpus"])
    assert variables["VEHANCHOR_TOKEN_FILE"] == f"/run/secrets/{service['secrets'][0]}"


@pytest.mark.promise("deployment")
def test_compose_runs_two_replicas() -> None:
    assert COMPOSE["services"]["vehanchor"]["deploy"]["replicas"] == 2


@pytest.mark.promise("deployment")
def test_compose_opens_only_nginx_on_loopback() -> None:
    services = COMPOSE["services"]
    assert "ports" not in services["vehanchor"]
    assert all(port.startswith("127.0.0.1:") for port in services["nginx"]["ports"])


@pytest.mark.promise("deployment")
def test_compose_locks_every_service_down() -> None:
    for service in COMPOSE["services"].values():
        assert service["read_only"]
        assert service["cap_drop"] == ["ALL"]
        assert service["security_opt"] == ["no-new-privileges:true", "seccomp=builtin"]


@pytest.mark.promise("deployment")
def test_a_linter_finds_no_high_risk_in_compose() -> None:
    lint = [sys.executable, "-m", "compose_lint", "--fail-on", "high"]
    done = subprocess.run(
        [*lint, str(DEPLOY / "compose.yml")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


def test_the_images_have_this_version() -> None:
    image = f"vehanchor:{__version__}"
    assert pod_container()["image"] == image
    assert COMPOSE["services"]["vehanchor"]["image"] == image


NGINX = (DEPLOY / "nginx.conf").read_text()
NGINX_SERVICE = COMPOSE["services"]["nginx"]
# The caller's, two ends between front and http, and the one to a replica.
CONNECTIONS_PER_CALL = 4
# Pools and buffers of a request that nginx does not let one set.
REQUEST_KIB = 8
# nginx without a call takes 5 MiB (measured on Debian, PSS of both processes).
IDLE_KIB = 8 << 10


def _kib(text: str) -> int:
    """A size of nginx or Compose, such as 16k and 128m, in KiB."""
    factors = {"k": 1, "m": 1024, "g": 1024**2}
    return int(text[:-1]) * factors[text[-1]]


def _directive(name: str) -> list[int]:
    """All values of a directive that is a size, in KiB."""
    return [_kib(value) for value in re.findall(rf"\b{name} (\d+[km]);", NGINX)]


@pytest.mark.promise("deployment")
def test_the_memory_of_nginx_is_enough_for_all_its_connections() -> None:
    connections = int(re.findall(r"worker_connections (\d+);", NGINX)[0])
    calls = connections // CONNECTIONS_PER_CALL
    front, answer = _directive("proxy_buffer_size")
    (body,) = _directive("client_body_buffer_size")
    per_call = 2 * front + body + answer + REQUEST_KIB
    (temporary,) = re.findall(r"size=(\d+m)", NGINX_SERVICE["tmpfs"][0])
    limit = _kib(NGINX_SERVICE["deploy"]["resources"]["limits"]["memory"])
    waiting = _kib_that_wait_in_the_kernel()
    assert calls * per_call + waiting + _kib(temporary) + IDLE_KIB <= limit


def _kib_that_wait_in_the_kernel() -> int:
    """The most that the bodies of one address take in the kernel: received, and to be sent."""
    (connections,) = re.findall(r"limit_conn connections (\d+);", NGINX)
    (calls,) = re.findall(r"limit_conn callers (\d+);", NGINX)
    sysctls = NGINX_SERVICE["sysctls"]
    received = int(sysctls["net.ipv4.tcp_rmem"].split()[-1])
    to_send = int(sysctls["net.ipv4.tcp_wmem"].split()[-1])
    return (int(connections) * received + int(calls) * to_send) >> 10


def test_nginx_stores_no_body() -> None:
    assert "proxy_request_buffering off;" in NGINX
