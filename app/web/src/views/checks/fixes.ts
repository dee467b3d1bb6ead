/** Grouping of findings, and repairs that can be made at once. */
import type { Checks, Finding, Severity } from "../../checks";

export const SEVERITIES: Severity[] = ["error", "warning", "info"];

export interface RuleGroup {
  rule: string;
  title: string;
  severity: Severity;
  items: Finding[];
}

/** Groups findings by rule, errors first. */
export function groupFindings({ items, rules }: Checks, text: string, severities: ReadonlySet<Severity>): RuleGroup[] {
  const wanted = text.trim().toLowerCase();
  const groups = new Map<string, RuleGroup>();
  for (const { rule, title, severity } of rules) groups.set(rule, { rule, title, severity, items: [] });
  for (const item of items) {
    if (!severities.has(item.severity)) continue;
    if (wanted && !`${item.detail} ${item.ids.join(" ")} ${item.level}`.toLowerCase().includes(wanted)) continue;
    groups.get(item.rule)?.items.push(item);
  }
  return [...groups.values()]
    .filter((group) => group.items.length)
    .sort((one, other) => SEVERITIES.indexOf(one.severity) - SEVERITIES.indexOf(other.severity));
}

/** Name of a finding in addresses: the same after a reload, as long as the mistake is there. */
export function keyOf({ rule, level, ids, where }: Finding): string {
  return [rule, level, ...ids.slice(0, 2), ...(where ?? []).map((value) => value.toFixed(1))].join("~");
}

export type Edit = NonNullable<Finding["fix"]>["changes"][number];

export interface Batch {
  edits: Edit[];
  findings: Finding[];
  /** Number of repairs that touch a feature that is already repaired: they come after these. */
  later: number;
}

/** Joins repairs that touch no common feature: later ones are found anew on the result. */
export function combineFixes(findings: readonly Finding[]): Batch {
  const touched = new Set<string>();
  const batch: Batch = { edits: [], findings: [], later: 0 };
  for (const finding of findings) {
    if (!finding.fix) continue;
    const ids = finding.fix.changes.map(targetOf);
    const involved = [...new Set([...ids, ...finding.ids.map((id) => `${finding.layer}/${id}`)])];
    if (involved.some((id) => touched.has(id))) {
      batch.later += 1;
      continue;
    }
    for (const id of involved) touched.add(id);
    batch.edits.push(...finding.fix.changes);
    batch.findings.push(finding);
  }
  return batch;
}

function targetOf(edit: Edit): string {
  if (edit.op === "put") return `${edit.layer}/${String(edit.feature.id)}`;
  if (edit.op === "delete") return `${edit.layer}/${edit.id}`;
  return `cells/${edit.level ?? ""}/${edit.grid ?? ""}`;
}
