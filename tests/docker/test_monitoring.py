"""Monitoring: alerts that fire and that do not, their runbook, the dashboard, and the metrics that all of them name.

``promtool`` of Debian's package ``prometheus`` checks the files and runs the alerts on series.
"""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.api.conftest import Api, create_farm

ROOT = Path(__file__).resolve().parents[2]
MONITORING = ROOT / "docker" / "monitoring"
ALERTS = MONITORING / "prometheus" / "alerts.yml"
DASHBOARD = MONITORING / "grafana" / "dashboards" / "fleetmap.json"
RUNBOOK = ROOT / "docs" / "how-to" / "runbook.md"

NOT_METRICS = frozenset({"fleetmap_admin_token", "fleetmap_head_total"})
DAY = 86_400

LONG_MINUTES = 1440
"""Minute from which on a case has one value, and one evaluation, an hour: else it would take a minute."""

Series = Mapping[str, str]
"""Values by series, in promtool's notation, one a minute."""


def series(metric: str, **labels: str) -> str:
    return metric + "{" + ",".join(f'{name}="{value}"' for name, value in labels.items()) + "}"


def server(metric: str, **more: str) -> str:
    return series(metric, **{"job": "fleetmap", "instance": "a", **more})


def channel(metric: str, **more: str) -> str:
    return server(metric, environment="farm", channel="production", **more)


def constant(value: float | str, minutes: int) -> str:
    return f"{value}x{minutes}"


REQUESTS = [server("fleetmap_requests_total", method="GET", route="/a", status=status) for status in ("200", "500")]
DISK = [server(f"fleetmap_disk_{name}", folder="data") for name in ("free_bytes", "size_bytes")]
INODES = [server(f"fleetmap_disk_{name}", folder="data") for name in ("free_inodes", "inodes")]
GIB = 2**30

CASES: Mapping[str, tuple[int, Series, Series]] = {
    "FleetmapDown critical": (3, {server("up"): "0x9"}, {server("up"): "1 0 1 0 1"}),
    "FleetmapReadOnly critical": (7, {server("fleetmap_writable"): "0x9"}, {server("fleetmap_writable"): "0 0 1 1x9"}),
    "FleetmapErrors warning": (
        40,
        {REQUESTS[0]: "0+900x60", REQUESTS[1]: "0+100x60"},
        {REQUESTS[0]: "0+980x60", REQUESTS[1]: "0+20x60"},
    ),
    "FleetmapVersionsDiffer info": (
        70,
        {server("fleetmap_info", version="0.1"): "1x90", server("fleetmap_info", version="0.2", instance="b"): "1x90"},
        {server("fleetmap_info", version="0.2"): "1x90", server("fleetmap_info", version="0.2", instance="b"): "1x90"},
    ),
    "FleetmapClockOff warning": (
        7,
        {server("fleetmap_clock_offset_seconds"): "-6x9"},
        {server("fleetmap_clock_offset_seconds"): "4x9"},
    ),
    "FleetmapDiskFull critical": (
        7,
        {DISK[0]: constant(4 * GIB, 9), DISK[1]: constant(100 * GIB, 9)},
        {DISK[0]: constant(6 * GIB, 9), DISK[1]: constant(100 * GIB, 9)},
    ),
    "FleetmapDiskFull warning": (
        480,
        {DISK[0]: f"{20 * GIB}-{8 * 2**20}x500", DISK[1]: constant(100 * GIB, 500)},
        {DISK[0]: f"{20 * GIB}-{2**20}x500", DISK[1]: constant(100 * GIB, 500)},
    ),
    "FleetmapInodesUsed warning": (
        12,
        {INODES[0]: "49x20", INODES[1]: "1000x20"},
        {INODES[0]: "51x20", INODES[1]: "1000x20"},
    ),
    "FleetmapCacheUnwritable warning": (
        12,
        {server("fleetmap_cache_problem"): "1x20"},
        {server("fleetmap_cache_problem"): "1x8 0x12"},
    ),
    "FleetmapCacheDamaged warning": (
        30,
        {server("fleetmap_cache_damaged_total"): "0x10 1x30"},
        {server("fleetmap_cache_damaged_total"): "7x40"},
    ),
    "FleetmapDataDamaged critical": (
        5,
        {server("fleetmap_scrub_findings", kind="blob"): "0 1x9"},
        {server("fleetmap_scrub_findings", kind="cache"): "3x9", server("fleetmap_scrub_findings", kind="blob"): "0x9"},
    ),
    "FleetmapScrubOld warning": (
        70,
        {server("fleetmap_scrub_age_seconds"): constant(15 * DAY, 90)},
        {server("fleetmap_scrub_age_seconds"): "+Inf " * 90},
    ),
    "FleetmapScrubIncomplete warning": (
        15 * 1440,
        {server("fleetmap_scrub_age_seconds"): "+Inf " * 361},
        {server("fleetmap_scrub_age_seconds"): "+Inf " * 312 + "60x48"},
    ),
    "FleetmapWebhookFailing warning": (
        10,
        {server("fleetmap_webhook_failing_seconds", webhook="a"): constant(7200, 30)},
        {server("fleetmap_webhook_failing_seconds", webhook="a"): constant(600, 30)},
    ),
    "FleetmapBackupOld warning": (
        70,
        {server("fleetmap_backup_age_seconds"): constant(3 * DAY, 90)},
        {server("fleetmap_backup_age_seconds"): constant(DAY, 90)},
    ),
    "FleetmapRobotsLate warning": (
        20,
        {channel("fleetmap_robots_late"): "2x30"},
        {channel("fleetmap_robots_late"): "2x12 0 2x12"},
    ),
    "FleetmapRobotsFailed warning": (
        15,
        {channel("fleetmap_robots", status="failed"): "1x30"},
        {channel("fleetmap_robots", status="lagging"): "9x30", channel("fleetmap_robots", status="failed"): "0x30"},
    ),
    "FleetmapRolloutStuck warning": (
        5,
        {channel("fleetmap_rollout_overdue_seconds", state="waiting"): "4000x9"},
        {channel("fleetmap_rollout_overdue_seconds", state="waiting"): "3000x9"},
    ),
    "FleetmapMoveOverdue critical": (
        5,
        {server("fleetmap_moves_overdue_seconds"): "90+60x9"},
        {server("fleetmap_moves_overdue_seconds"): "0 0 61 0 0x9"},
    ),
    "FleetmapClosuresEnd info": (
        2,
        {server("fleetmap_closures_ending", environment="farm"): "1x9"},
        {server("fleetmap_closures_ending", environment="farm"): "0x9"},
    ),
    "FleetmapReportsWait warning": (
        40,
        {server("fleetmap_overlays_pending", environment="farm"): "1x50"},
        {server("fleetmap_overlays_pending", environment="farm"): "1x25 0 1x25"},
    ),
    "FleetmapEventsUnsent critical": (
        5,
        {server("fleetmap_events_oldest_unsent_seconds"): "70+60x9"},
        {server("fleetmap_events_oldest_unsent_seconds"): "70 0 70 0 70 0"},
    ),
    "FleetmapEventsDisconnected warning": (
        15,
        {server("fleetmap_events_connected"): "0x20", server("fleetmap_events_connected", instance="b"): "1x20"},
        {server("fleetmap_events_connected"): "0x8 1x12"},
    ),
    "FleetmapQueueSlow warning": (
        8,
        {server("fleetmap_queue_oldest_seconds"): "130+60x9"},
        {server("fleetmap_queue_oldest_seconds"): "100x9"},
    ),
    "FleetmapWorkersMissing warning": (
        5,
        {server("fleetmap_queue_workers"): "2 0x9", server("fleetmap_queue_workers", instance="b"): "2 0x9"},
        {
            server("fleetmap_queue_workers"): "2 0x9",
            server("fleetmap_queue_workers", instance="b"): "2x9",
            server("fleetmap_queue_workers", job="without-workers"): "0x9",
        },
    ),
    "FleetmapCertificateEnds critical": (
        7,
        {server("fleetmap_certificate_left_seconds", certificate="https"): constant(2 * DAY, 9)},
        {server("fleetmap_certificate_left_seconds", certificate="https"): constant(4 * DAY, 9)},
    ),
    "FleetmapCertificateEnds warning": (
        70,
        {server("fleetmap_certificate_left_seconds", certificate="zenoh"): constant(20 * DAY, 90)},
        {server("fleetmap_certificate_left_seconds", certificate="zenoh"): constant(22 * DAY, 90)},
    ),
    "FleetmapMirrorCutOff warning": (
        8,
        {server("fleetmap_mirror_contact_age_seconds"): "4000+60x9"},
        {server("fleetmap_mirror_contact_age_seconds"): "40x9"},
    ),
    "FleetmapMirrorEnds critical": (
        8,
        {server("fleetmap_mirror_permission_seconds"): constant(DAY, 9)},
        {server("fleetmap_mirror_permission_seconds"): constant(6 * DAY, 9)},
    ),
}
"""By alert and severity: the minute to look at, series with which it fires then, series with which it does not."""


@pytest.fixture(scope="module")
def promtool() -> str:
    path = shutil.which("promtool")
    if path is None:
        pytest.skip("promtool is not installed: apt-get install --no-install-recommends prometheus")
    return path


@pytest.fixture(scope="module")
def rules() -> list[dict[str, Any]]:
    return [rule for group in yaml.safe_load(ALERTS.read_text())["groups"] for rule in group["rules"]]


def run(promtool: str, *arguments: str) -> None:
    done = subprocess.run([promtool, *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_files_are_valid(promtool: str) -> None:
    run(promtool, "check", "rules", str(ALERTS))
    run(promtool, "check", "config", "--syntax-only", str(MONITORING / "prometheus" / "prometheus.yml"))


def unit_tests(case: str) -> Iterator[dict[str, Any]]:
    """Yield promtool's tests of a case: with the series with which its alert fires, and with the others."""
    minute, firing, quiet = CASES[case]
    alert, severity = case.split()
    for name, inputs, value in ((f"{case} fires", firing, 1), (f"{case} is quiet", quiet, 0)):
        selector = f'ALERTS{{alertname="{alert}",severity="{severity}",alertstate="firing"}}'
        expected = [{"labels": "{}", "value": value}]
        yield {
            "name": name,
            "interval": interval(minute),
            "input_series": [{"series": one, "values": values} for one, values in inputs.items()],
            "promql_expr_test": [
                {"expr": f"count({selector}) or vector(0)", "eval_time": f"{minute}m", "exp_samples": expected}
            ],
        }


def interval(minute: int) -> str:
    return "1m" if minute < LONG_MINUTES else "1h"


def test_alerts_fire_if_they_must_and_only_then(promtool: str, rules: list[dict[str, Any]], tmp_path: Path) -> None:
    """Each case evaluates its own rule: all of them, each minute, would take a tenth of a minute."""
    cases = {f"{rule['alert']} {rule['labels']['severity']}": rule for rule in rules}
    assert set(CASES) == set(cases)
    assert len(cases) == len(rules)
    files = []
    for number, (case, rule) in enumerate(cases.items()):
        own, file = tmp_path / f"{number}-rule.yml", tmp_path / f"{number}-test.yml"
        own.write_text(yaml.safe_dump({"groups": [{"name": "own", "rules": [rule]}]}))
        every = {"evaluation_interval": interval(CASES[case][0]), "rule_files": [str(own)]}
        file.write_text(yaml.safe_dump({**every, "tests": list(unit_tests(case))}))
        files.append(str(file))
    run(promtool, "test", "rules", *files)


def test_watched_rollouts_fire_as_well(promtool: str, tmp_path: Path) -> None:
    selector = 'ALERTS{alertname="FleetmapRolloutStuck",alertstate="firing"}'
    watched = channel("fleetmap_rollout_overdue_seconds", state="watching")
    tests = [
        {
            "interval": "1m",
            "input_series": [{"series": watched, "values": values}],
            "promql_expr_test": [
                {
                    "expr": f"count({selector}) or vector(0)",
                    "eval_time": "5m",
                    "exp_samples": [{"labels": "{}", "value": value}],
                }
            ],
        }
        for values, value in (("400x9", 1), ("200x9", 0))
    ]
    file = tmp_path / "tests.yml"
    file.write_text(yaml.safe_dump({"rule_files": [str(ALERTS)], "tests": tests}))
    run(promtool, "test", "rules", str(file))


def test_every_alert_has_its_section_of_the_runbook(rules: list[dict[str, Any]]) -> None:
    text = RUNBOOK.read_text()
    sections = Counter(re.findall(r"^### (\w+)$", text, re.MULTILINE))
    assert sections == Counter({rule["alert"] for rule in rules}), "one section for each alert, and no others"
    for rule in rules:
        link = rule["annotations"]["runbook_url"]
        assert link.endswith(f"/docs/how-to/runbook.md#{rule['alert'].lower()}"), link
        assert rule["annotations"]["summary"]
        assert rule["annotations"]["description"]
        assert rule["labels"]["severity"] in ("critical", "warning", "info")
    for section in re.split(r"^### ", text, flags=re.MULTILINE)[1:]:
        assert "- **Look" in section, section[:80]
        assert "- **Do:**" in section or "and **do:**" in section, section[:80]


def metrics_in(text: str) -> set[str]:
    """Names of metrics in rules, the dashboard or a page."""
    return set(re.findall(r"\bfleetmap_[a-z_]+\b(?![\w.]*=)", text)) - NOT_METRICS


def test_every_metric_that_is_named_exists(api: Api, fresh: Callable[[], str]) -> None:
    api.get(f"/maps/{create_farm(api, fresh())}/tmap2")
    text = api.get("/metrics").text
    served = set(re.findall(r"^# TYPE (\w+) ", text, re.MULTILINE)) | set(re.findall(r"^(\w+)[{ ]", text, re.MULTILINE))
    used = {
        path.name: metrics_in(path.read_text())
        for path in (ALERTS, DASHBOARD, RUNBOOK, ROOT / "docs" / "how-to" / "maintain.md")
    }
    assert len(used[ALERTS.name]) > 20
    assert len(used[DASHBOARD.name]) > 30
    for name, metrics in used.items():
        assert metrics - served == set(), name


def test_dashboard_shows_every_metric_in_expressions_that_parse(promtool: str, tmp_path: Path) -> None:
    dashboard = json.loads(DASHBOARD.read_text())
    expressions = [target["expr"] for panel in dashboard["panels"] for target in panel.get("targets", ())]
    ids = [panel["id"] for panel in dashboard["panels"]]
    assert len(ids) == len(set(ids))
    for panel in dashboard["panels"]:
        place = panel["gridPos"]
        assert place["x"] + place["w"] <= 24
        assert panel["type"] == "row" or panel["targets"], panel["title"]
    rules = [{"record": f"panel_{k}", "expr": e.replace("$job", "fleetmap")} for k, e in enumerate(expressions)]
    file = tmp_path / "panels.yml"
    file.write_text(yaml.safe_dump({"groups": [{"name": "panels", "rules": rules}]}))
    run(promtool, "check", "rules", str(file))
    alerted = metrics_in(ALERTS.read_text())
    assert alerted - metrics_in(DASHBOARD.read_text()) == set(), "what wakes somebody is on the dashboard"


def test_provisioning_names_the_data_source_of_the_dashboard() -> None:
    folder = MONITORING / "grafana" / "provisioning"
    (source,) = yaml.safe_load((folder / "datasources" / "prometheus.yml").read_text())["datasources"]
    text = DASHBOARD.read_text()
    assert set(re.findall(r'"type": "prometheus",\s+"uid": "(\w+)"', text)) == {source["uid"]}
    (provider,) = yaml.safe_load((folder / "dashboards" / "fleetmap.yml").read_text())["providers"]
    assert provider["options"]["path"] == "/var/lib/grafana/dashboards"
