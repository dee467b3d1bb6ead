/** Groups of changed features. No DOM. */
import type { Change, ChangeKind } from "../../map/changes";

export interface ChangeGroup {
  key: string;
  change: ChangeKind;
  kind: string;
  fields: string[];
  changes: Change[];
}

/** Groups what has the same kind and fares the same, the biggest first. */
export function groupsOf(changes: readonly Change[]): ChangeGroup[] {
  const groups = new Map<string, ChangeGroup>();
  for (const one of changes) {
    const { change, kind, fields, layer } = one;
    const key = [change, layer, kind, ...fields].join(" ");
    const group = groups.get(key) ?? { key, change, kind, fields, changes: [] };
    groups.set(key, group);
    group.changes.push(one);
  }
  return [...groups.values()].sort((one, other) => other.changes.length - one.changes.length);
}

/** Says a group in words: "24 × edge changed: speed, width". */
export function groupText({ changes, kind, change, fields }: ChangeGroup): string {
  const what = `${changes.length} × ${kind.replaceAll("_", " ")} ${change}`;
  return fields.length ? `${what}: ${fields.join(", ")}` : what;
}
