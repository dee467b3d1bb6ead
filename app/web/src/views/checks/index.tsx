/**
 * Checks: mistakes in the version that is shown, by rule, on the map, with repairs.
 *
 * Address: `check=` the chosen finding; `hide-checks=` severities that are not listed.
 */
import { RotateCw } from "lucide-preact";
import { useMemo, useState } from "preact/hooks";
import { go, param } from "../../address";
import { type Finding, type Severity, useChecking } from "../../checks";
import { can } from "../../session";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { SearchField } from "../../ui/search-field";
import { Bars, Empty, Problem } from "../../ui/states";
import { count } from "../../ui/text";
import type { ViewProps } from "../registry";
import "./checks.css";
import { FixPanel } from "./fix";
import { groupFindings, keyOf, SEVERITIES } from "./fixes";
import { RuleSection } from "./list";
import { showFinding, useMarks } from "./marks";

const NAMES: Record<Severity, [string, string]> = {
  error: ["error", "errors"],
  warning: ["warning", "warnings"],
  info: ["note", "notes"],
};

export default function ChecksView({ site, map }: ViewProps) {
  const checks = useChecking(site, 0);
  const [text, setText] = useState("");
  const [fixing, setFixing] = useState<Finding[] | null>(null);
  const hidden = param("hide-checks") ?? "";
  const data = checks.data.value;
  const severities = useMemo(() => new Set(SEVERITIES.filter((one) => !hidden.split(",").includes(one))), [hidden]);
  const groups = useMemo(() => (data ? groupFindings(data, text, severities) : []), [data, text, severities]);
  const shown = useMemo(() => groups.flatMap(({ items }) => items), [groups]);
  const asked = param("check");
  const chosen = shown.find((finding) => keyOf(finding) === asked);
  const choose = (finding: Finding) => {
    go({ check: keyOf(finding), level: finding.level, feature: null }, { replace: true });
    showFinding(map, finding);
  };
  useMarks(map, fixing ? NONE : shown, fixing ? undefined : chosen, choose);
  const problem = checks.problem.value;
  if (!data) return problem ? <Problem error={problem} retry={checks.reload} /> : <Bars />;
  if (fixing) return <FixPanel site={site} map={map} findings={fixing} onClose={() => setFixing(null)} />;
  return (
    <div class="stack checks" aria-busy={checks.loading.value}>
      {problem && <Problem error={problem} retry={checks.reload} />}
      {data.items.length === 0 ? (
        <Clean site={site} rules={data.rules} />
      ) : (
        <>
          <Filters data={data.items} severities={severities} />
          <SearchField label="Search findings" hint="Search by name, id or level" value={text} onInput={setText} />
          <OldVersion site={site} />
          {data.truncated && (
            <p class="note">Only the first {data.items.length} findings are listed: repair these, then check again.</p>
          )}
          {groups.map((group) => (
            <RuleSection
              key={group.rule}
              group={group}
              site={site}
              chosen={chosen}
              onChoose={choose}
              onFix={canFix(site) ? setFixing : undefined}
            />
          ))}
          {groups.length === 0 && <Empty title="No finding matches" />}
        </>
      )}
      <Button icon={RotateCw} busy={checks.loading.value} onClick={checks.reload}>
        Check again
      </Button>
    </div>
  );
}

const NONE: Finding[] = [];

/** Repairs are made on the head: findings of another version may be about something else. */
function canFix(site: Site): boolean {
  return can("editor") && site.number !== null && site.number === site.environment.value?.version;
}

function OldVersion({ site }: { site: Site }) {
  const head = site.environment.value?.version;
  if (!can("editor") || canFix(site) || head === undefined) return null;
  return (
    <div class="note">
      <p>
        {site.number === null ? "These are findings of a trial." : `These are findings of v${site.number}.`} Repairs are
        made on the latest version.
      </p>
      <Button onClick={() => go({ version: "latest" })}>Check v{head}</Button>
    </div>
  );
}

function Filters({ data, severities }: { data: Finding[]; severities: ReadonlySet<Severity> }) {
  const toggle = (severity: Severity) => {
    const hidden = SEVERITIES.filter((one) => severities.has(one) === (one === severity));
    go({ "hide-checks": hidden.join(",") }, { replace: true });
  };
  return (
    <div class="actions severities" role="group" aria-label="Show findings by severity">
      {SEVERITIES.map((severity) => {
        const number = data.filter((finding) => finding.severity === severity).length;
        return (
          number > 0 && (
            <Button key={severity} pressed={severities.has(severity)} onClick={() => toggle(severity)}>
              <i class={`sign ${severity}`} aria-hidden="true" /> {count(number, ...NAMES[severity])}
            </Button>
          )
        );
      })}
    </div>
  );
}

function Clean({ site, rules }: { site: Site; rules: { rule: string; title: string }[] }) {
  return (
    <Empty title="No mistakes found">
      <p>{site.number === null ? "The trial" : `v${site.number}`} was checked for:</p>
      <ul class="rules">
        {rules.map(({ rule, title }) => (
          <li key={rule}>{title}</li>
        ))}
      </ul>
    </Empty>
  );
}
