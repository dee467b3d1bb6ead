"""Checks of compose.scale.yaml, its Caddyfile and secrets, and the Kubernetes manifests."""

from __future__ import annotations

import base64
import json
import os
import re
import ssl
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml

from tests.docker.containers import DOCKER, with_defaults

KUBERNETES = DOCKER / "kubernetes"
MANIFESTS = sorted([*KUBERNETES.glob("*.yaml"), KUBERNETES / "secrets.yaml.example"])
SCHEMA = "1.37"
UNMOUNTED = {"ca.key", "robots", "router_password", "grafana_password"}
"""Secrets of the operator, and of compose.yaml alone, which no service gets."""

MakeSecrets = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def compose() -> dict[str, Any]:
    loaded: dict[str, Any] = yaml.safe_load(with_defaults((DOCKER / "compose.scale.yaml").read_text()))
    return loaded


@pytest.fixture(scope="module")
def manifests() -> dict[tuple[str, str], dict[str, Any]]:
    """Objects of Kubernetes by kind and name."""
    objects = [one for path in MANIFESTS for one in yaml.safe_load_all(path.read_text())]
    by_name = {(one["kind"], one["metadata"]["name"]): one for one in objects}
    assert len(by_name) == len(objects)
    return by_name


@pytest.fixture
def make_secrets(tmp_path: Path) -> MakeSecrets:
    """Run make_secrets.py for a folder of the test."""

    def make(*options: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, DOCKER / "make_secrets.py", tmp_path / "secrets", *options]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    return make


# --- compose.scale.yaml ---


def test_services_are_confined(compose: dict[str, Any]) -> None:
    for name, service in compose["services"].items():
        assert service["read_only"] is True, name
        assert service["cap_drop"] == ["ALL"], name
        assert "no-new-privileges:true" in service["security_opt"], name
        assert service.get("cap_add", []) == (["NET_BIND_SERVICE"] if name == "proxy" else []), name
        assert service["logging"]["options"].keys() == {"max-size", "max-file"}, name
        assert "privileged" not in service, name


def test_services_share_no_volume(compose: dict[str, Any]) -> None:
    volumes = [
        text.split(":")[0]
        for service in compose["services"].values()
        for text in service.get("volumes", ())
        if not text.startswith("./")
    ]
    assert len(volumes) == len(set(volumes))
    assert set(volumes) == set(compose["volumes"])
    assert not {"database", "store"} & {name for name in volumes if name.startswith(("server", "worker"))}


def test_only_proxy_and_routers_are_published(compose: dict[str, Any]) -> None:
    services = compose["services"]
    assert {name for name, service in services.items() if "ports" in service} == {"proxy", "router-1", "router-2"}
    assert compose["networks"]["inside"] == {"internal": True}
    for name in ("database", "store"):
        assert services[name]["networks"] == ["inside"]
    assert services["proxy"]["networks"] == ["web"], "it reaches servers only"
    assert services["router-1"]["networks"] == services["router-2"]["networks"] == ["outside"]
    assert {name for name, service in services.items() if "web" in service["networks"]} == {
        "proxy",
        *(f"server-{number}" for number in (1, 2, 3)),
    }


def test_services_get_the_secrets_that_they_need(
    compose: dict[str, Any], make_secrets: MakeSecrets, tmp_path: Path
) -> None:
    used = {secret for service in compose["services"].values() for secret in service.get("secrets", ())}
    assert used == set(compose["secrets"])
    assert all(Path(secret["file"]).name == name for name, secret in compose["secrets"].items())
    done = make_secrets("--scale")
    assert done.returncode == 0, done.stderr
    created = {path.name for path in (tmp_path / "secrets").iterdir()}
    assert created == used | UNMOUNTED
    for name, service in compose["services"].items():
        for path in re.findall(r"/run/secrets/([\w.]+)", json.dumps(service)):
            assert path in service["secrets"], name


def test_secrets_are_kept_and_private(make_secrets: MakeSecrets, tmp_path: Path) -> None:
    folder = tmp_path / "secrets"
    first = make_secrets("--scale", "--host", "maps.example.org", "--host", "10.0.0.7")
    before = {path.name: path.read_text() for path in folder.iterdir()}
    assert all(text.strip() not in first.stdout for text in before.values())
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert stat.S_IMODE((folder / "ca.key").stat().st_mode) == 0o400
    again = make_secrets("--scale")
    assert again.stdout == ""
    assert {path.name: path.read_text() for path in folder.iterdir()} == before
    text = subprocess.run(
        ["openssl", "x509", "-in", folder / "server.pem", "-noout", "-text"], capture_output=True, text=True, check=True
    ).stdout
    for place in ("DNS:maps.example.org", "IP Address:10.0.0.7", "DNS:router-1", "DNS:router-2"):
        assert place in text
    ssl.create_default_context(cafile=folder / "ca.pem")
    ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(folder / "server.pem", folder / "server.key")


def test_rules_of_routers_follow_the_robots(make_secrets: MakeSecrets, tmp_path: Path) -> None:
    folder = tmp_path / "secrets"
    make_secrets("--scale")
    rules = json.loads((folder / "router.json5").read_text())["access_control"]
    assert rules["default_permission"] == "deny"
    assert all(subject.get("usernames") or subject.get("cert_common_names") for subject in rules["subjects"])
    with (folder / "robots").open("a") as robots:
        robots.write("tractor-7:ploughs-at-dawn\n")
    assert make_secrets("--scale").returncode == 0
    rules = json.loads((folder / "router.json5").read_text())["access_control"]
    assert "robot tractor-7" in {subject["id"] for subject in rules["subjects"]}
    assert "tractor-7:ploughs-at-dawn" in (folder / "router_users").read_text().splitlines()
    for name, reason in (("router", "reserved"), ("server", "reserved"), ("two words", "invalid name")):
        (folder / "robots").write_text(f"{name}:secret\n")
        refused = make_secrets("--scale")
        assert refused.returncode != 0
        assert reason in refused.stderr
        assert "Traceback" not in refused.stderr


def test_proxy_balances_all_servers(compose: dict[str, Any]) -> None:
    caddy = Path(sys.executable).parent / "caddy"
    adapted = subprocess.run(
        [caddy, "adapt", "--config", DOCKER / "Caddyfile"],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **compose["services"]["proxy"]["environment"]},
    )
    assert adapted.stderr.count("warn") == 0, adapted.stderr
    upstreams = re.findall(r'"dial":"([^"]+)"', adapted.stdout)
    servers = [name for name in compose["services"] if name.startswith("server-")]
    assert upstreams == [f"{name}:8000" for name in servers]
    health = json.loads(adapted.stdout)["apps"]["http"]["servers"]["srv0"]["routes"][0]["handle"][0]["health_checks"]
    assert health["active"]["uri"] == "/readyz"
    formatted = subprocess.run([caddy, "fmt", DOCKER / "Caddyfile"], capture_output=True, text=True, check=True)
    assert formatted.stdout == (DOCKER / "Caddyfile").read_text()


# --- Kubernetes ---


def pods(manifests: dict[tuple[str, str], dict[str, Any]]) -> Iterator[tuple[str, dict[str, Any]]]:
    for (kind, name), one in manifests.items():
        if kind in ("Deployment", "StatefulSet", "Job"):
            yield name, one["spec"]["template"]["spec"]


@pytest.mark.parametrize("path", MANIFESTS, ids=lambda path: path.name)
def test_manifest_matches_its_schema(path: Path) -> None:
    for one in yaml.safe_load_all(path.read_text()):
        kubernetes_validate.validate(one, SCHEMA, strict=True)


def test_schema_check_rejects_wrong_manifests(manifests: dict[tuple[str, str], dict[str, Any]]) -> None:
    wrong = {**manifests["Service", "server"], "spek": {}}
    with pytest.raises(kubernetes_validate.ValidationError, match="spek"):
        kubernetes_validate.validate(wrong, SCHEMA, strict=True)


def test_pods_are_confined_and_bounded(manifests: dict[tuple[str, str], dict[str, Any]]) -> None:
    for name, pod in pods(manifests):
        assert pod["automountServiceAccountToken"] is False, name
        assert pod["enableServiceLinks"] is False, f"{name}: variables of services may look like settings"
        assert pod["securityContext"]["runAsNonRoot"] is True, name
        (container,) = pod["containers"]
        context = container["securityContext"]
        assert context["allowPrivilegeEscalation"] is False, name
        assert context["capabilities"] == {"drop": ["ALL"]}, name
        assert context.get("readOnlyRootFilesystem") is True or name == "database", name
        assert {"cpu", "memory"} <= container["resources"]["requests"].keys(), name
        assert "memory" in container["resources"]["limits"], name
        if name != "migrate":
            assert container["readinessProbe"], name


def test_probes_call_the_port_and_paths_of_the_server(manifests: dict[tuple[str, str], dict[str, Any]]) -> None:
    for name in ("server", "worker"):
        (container,) = manifests["Deployment", name]["spec"]["template"]["spec"]["containers"]
        paths = {probe: container[probe]["httpGet"]["path"] for probe in container if probe.endswith("Probe")}
        assert paths == {"startupProbe": "/readyz", "readinessProbe": "/readyz", "livenessProbe": "/healthz"}
        assert container["ports"] == [{"name": "http", "containerPort": 8000}]


def test_manifests_run_what_compose_runs(
    manifests: dict[tuple[str, str], dict[str, Any]], compose: dict[str, Any]
) -> None:
    services = compose["services"]
    names = {"server": "server-1", "worker": "worker-1"}
    for name, pod in pods(manifests):
        (container,) = pod["containers"]
        service = services[names.get(name, name)]
        assert container["image"] == service["image"], name
        assert container.get("args") == service["command"], name
        assert container.get("command") == service.get("entrypoint"), name
        if service["image"].startswith("fleet-map-server"):
            maps = [source["configMapRef"]["name"] for source in container["envFrom"]]
            environment = {k: v for one in maps for k, v in manifests["ConfigMap", one]["data"].items()}
            assert environment.keys() == service["environment"].keys(), name
            same = {
                k: v for k, v in environment.items() if k not in ("FLEETMAP_ZENOH_ADVERTISE", "FORWARDED_ALLOW_IPS")
            }
            assert {k: str(service["environment"][k]) for k in same} == same, name
        sources = [volume["projected"]["sources"] for volume in pod["volumes"] if "projected" in volume]
        secrets = {key for source in sources[0] for key in manifests["Secret", source["secret"]["name"]]["stringData"]}
        assert secrets == set(service["secrets"]), name


def test_selectors_and_references_resolve(manifests: dict[tuple[str, str], dict[str, Any]]) -> None:
    labels = [
        one["spec"]["template"]["metadata"]["labels"]
        for (kind, _), one in manifests.items()
        if kind in ("Deployment", "StatefulSet", "Job")
    ]

    def selects(selector: dict[str, str]) -> int:
        return sum(selector.items() <= one.items() for one in labels)

    for (kind, name), one in manifests.items():
        spec = one.get("spec", {})
        if kind == "Service":
            assert selects(spec["selector"]) == 1, name
        if kind in ("PodDisruptionBudget", "Deployment", "StatefulSet"):
            assert selects(spec["selector"]["matchLabels"]) >= 1, name
        if kind == "NetworkPolicy":
            assert selects(spec["podSelector"]["matchLabels"]) == 1, name
            (peer,) = spec["ingress"][0]["from"]
            assert selects(peer["podSelector"]["matchLabels"]) == 3, "servers, workers and migrations"
        if kind == "StatefulSet":
            assert ("Service", spec["serviceName"]) in manifests
    ingress = manifests["Ingress", "server"]["spec"]
    assert ("Secret", ingress["tls"][0]["secretName"]) in manifests
    assert ("Service", ingress["rules"][0]["http"]["paths"][0]["backend"]["service"]["name"]) in manifests


def test_secrets_of_manifests_are_printed(
    manifests: dict[tuple[str, str], dict[str, Any]], make_secrets: MakeSecrets, tmp_path: Path
) -> None:
    assert "run make_secrets.py --scale first" in make_secrets("--kubernetes").stderr
    make_secrets("--scale")
    printed = json.loads(make_secrets("--kubernetes").stdout)["items"]
    for secret in printed:
        kubernetes_validate.validate(secret, SCHEMA, strict=True)
    keys = {secret["metadata"]["name"]: (secret["type"], set(secret["data"])) for secret in printed}
    examples = {name: one for (kind, name), one in manifests.items() if kind == "Secret"}
    assert keys == {name: (one["type"], set(one["stringData"])) for name, one in examples.items()}
    token = next(one["data"]["fleetmap_admin_token"] for one in printed if "fleetmap_admin_token" in one["data"])
    assert base64.b64decode(token).decode() == (tmp_path / "secrets" / "fleetmap_admin_token").read_text()
