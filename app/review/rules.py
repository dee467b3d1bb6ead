"""The list of rules that a version is checked by, and the check."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any, Literal, get_args

from app.model.layers import Layers
from app.review import geometry_rules, graph_rules, obstacle_rules
from app.review.findings import SEVERITIES, Finding, Severity, Site
from app.review.fixes import Fixer

RuleName = Literal[
    "edge-through-obstacle",
    "edge-through-keepout",
    "lifts-do-not-stack",
    "near-miss",
    "duplicate-name",
    "duplicate-edge",
    "zero-length-edge",
    "dead-end",
    "unreachable-part",
    "object-on-edge",
    "outside-fence",
    "isolated-node",
    "crossing-edges-without-node",
]

MAX_FINDINGS = 1000
"""Maximum number of findings of a check; those of higher severity come first."""


@dataclass(frozen=True, slots=True)
class Rule:
    """A rule: its name, what it looks for, and the function that yields its findings."""

    name: RuleName
    title: str
    severity: Severity
    find: Callable[[Site, Fixer], Iterator[Finding]]

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON members."""
        return {"rule": self.name, "title": self.title, "severity": self.severity}


RULES: tuple[Rule, ...] = (
    Rule(
        "edge-through-obstacle",
        "Edges cross occupied cells, buildings or walls",
        "error",
        obstacle_rules.edges_through_obstacles,
    ),
    Rule("edge-through-keepout", "Edges cross keepout zones or masks", "error", obstacle_rules.edges_through_keepouts),
    Rule(
        "lifts-do-not-stack",
        "Stops of a lift are not above each other",
        "error",
        geometry_rules.lifts_that_do_not_stack,
    ),
    Rule(
        "near-miss", "Nodes are close to an edge or a node without a connection", "warning", geometry_rules.near_misses
    ),
    Rule("duplicate-name", "Nodes of a level have the same name", "warning", graph_rules.duplicate_names),
    Rule("duplicate-edge", "Edges lead the same way", "warning", graph_rules.duplicate_edges),
    Rule("zero-length-edge", "Edges have no length", "warning", graph_rules.zero_lengths),
    Rule("dead-end", "Nodes can be entered but not left", "warning", graph_rules.dead_ends),
    Rule(
        "unreachable-part",
        "Parts of the network cannot be reached, or not be left",
        "warning",
        graph_rules.unreachable_parts,
    ),
    Rule("object-on-edge", "Objects stand on edges", "warning", obstacle_rules.objects_on_edges),
    Rule("outside-fence", "Nodes lie outside the fence", "warning", geometry_rules.outside_fence),
    Rule("isolated-node", "Nodes have no edges", "info", graph_rules.isolated_nodes),
    Rule("crossing-edges-without-node", "Edges cross without a node", "info", geometry_rules.crossing_edges),
)
assert {rule.name for rule in RULES} == set(get_args(RuleName))


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Findings with their rules. truncated: there are more, or a rule stopped at its limits."""

    findings: tuple[tuple[Rule, Finding], ...]
    truncated: bool

    def as_dicts(self) -> list[dict[str, Any]]:
        """Return the findings as JSON."""
        return [_as_dict(rule, finding) for rule, finding in self.findings]


def _as_dict(rule: Rule, finding: Finding) -> dict[str, Any]:
    return {
        "rule": rule.name,
        "severity": rule.severity,
        "layer": finding.layer,
        "level": finding.level,
        "ids": list(finding.ids),
        "where": None if finding.position is None else list(finding.position),
        "detail": finding.detail,
        "fix": None if finding.fix is None else finding.fix.as_dict(),
    }


def check_layers(layers: Layers, level: str | None = None) -> CheckResult:
    """Check a version's content by all rules. level: only findings on this level; default: all."""
    levels = sorted({key.level for key in layers.vector("topology")})
    site = Site(layers, [name for name in levels if level in (None, name)])
    fixer = Fixer(site.network, layers.frame)
    out: list[tuple[Rule, Finding]] = []
    truncated = False
    for rule in sorted(RULES, key=lambda rule: SEVERITIES.index(rule.severity)):
        space = MAX_FINDINGS - len(out)
        fitting = (finding for finding in rule.find(site, fixer) if level in (None, finding.level))
        result = list(islice(fitting, space + 1))
        out += [(rule, finding) for finding in result[:space]]
        if len(result) > space:
            truncated = True
            break
    return CheckResult(tuple(out), truncated or site.truncated)
