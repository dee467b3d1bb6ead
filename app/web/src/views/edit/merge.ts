/** Three-way merge of a draft with a version that was saved in the meantime, feature by feature. */
import type { Feature } from "../../map/features";
import { type Change, type Command, core, Draft, isEdge, isNode, keyOf, same } from "./draft";
import { Transaction } from "./transaction";

/** A feature that both have changed. */
export interface Conflict {
  key: string;
  before: Feature | null;
  /** Mine, with what only they have changed; and theirs with what only I have. */
  mine: Feature | null;
  theirs: Feature | null;
  /** What both have changed: names of properties, or the shape. Empty: one of them has deleted it. */
  fields: string[];
}

type Side = "mine" | "theirs";

export type Choice = Side | "both";

export interface Merge {
  /** Changes that touch nothing of theirs. */
  clean: Change[];
  conflicts: Conflict[];
  /** Features that both have changed, in different fields: they hold the changes of both. */
  joined: Feature[];
}

/** Compares a draft's changes with the features of the newer version. */
export function compare(changes: readonly Change[], theirs: ReadonlyMap<string, Feature>): Merge {
  const clean: Change[] = [];
  const conflicts: Conflict[] = [];
  const joined: Feature[] = [];
  for (const { key, before, after } of changes) {
    const their = theirs.get(key) ?? null;
    const [base, ours, other] = [core(before), core(after), core(their)];
    if (same(base, other)) {
      // Only the ends of a lane may differ: they follow its nodes.
      if (!same(base, ours) || after === null) clean.push({ key, before: their, after });
      continue;
    }
    if (same(base, ours) || same(ours, other)) continue; // theirs, or the same as ours
    if (!before || !after || !their) {
      conflicts.push({ key, before, mine: after, theirs: their, fields: [] });
      continue;
    }
    const both = byField(before, after, their);
    if (both.fields.length) conflicts.push({ key, before, ...both });
    else {
      joined.push(both.mine);
      clean.push({ key, before: their, after: both.mine });
    }
  }
  return { clean, conflicts, joined };
}

/** Stands among the names of fields for where something is and how it is bent or turned. */
export const SHAPE = "(shape)";
const SHAPED = ["bends", "pose"];

/** Returns what can differ of a feature, by name. */
function fieldsOf(feature: Feature): Map<string, unknown> {
  const { geometry, inner } = core(feature) as { geometry?: unknown; inner?: unknown };
  const shape = [geometry ?? inner, ...SHAPED.map((name) => feature.properties[name] ?? null)];
  const others = Object.entries(feature.properties).filter(([name]) => !SHAPED.includes(name));
  return new Map<string, unknown>([[SHAPE, shape], ...others]);
}

/** Returns the fields in which two forms of a feature differ. */
export function changedFields(one: Feature, other: Feature): string[] {
  const [left, right] = [fieldsOf(one), fieldsOf(other)];
  return [...new Set([...left.keys(), ...right.keys()])].filter((name) => !same(left.get(name), right.get(name)));
}

/** Joins two forms of a feature, field by field. Where both changed the same, each keeps its own. */
function byField(before: Feature, mine: Feature, theirs: Feature): Pick<Conflict, "fields"> & Record<Side, Feature> {
  const [ours, others] = [changedFields(before, mine), changedFields(before, theirs)];
  const differing = new Set(changedFields(mine, theirs));
  const fields = ours.filter((name) => others.includes(name) && differing.has(name));
  const isOnlyMine = (name: string) => ours.includes(name) && !fields.includes(name);
  const isOnlyTheirs = (name: string) => others.includes(name) && !fields.includes(name);
  return {
    fields,
    mine: withFields(mine, theirs, others.filter(isOnlyTheirs)),
    theirs: withFields(theirs, mine, ours.filter(isOnlyMine)),
  };
}

/** Returns a feature with some fields of another form of it. */
function withFields(feature: Feature, other: Feature, names: readonly string[]): Feature {
  const properties = { ...feature.properties };
  for (const name of names.flatMap((one) => (one === SHAPE ? SHAPED : one))) {
    if (name in other.properties) properties[name] = other.properties[name];
    else delete properties[name];
  }
  return { ...feature, properties, geometry: names.includes(SHAPE) ? other.geometry : feature.geometry };
}

/** Returns the conflict of the other direction of the same street, if it is one of the same fields. */
export function twinOf(conflict: Conflict, all: readonly Conflict[]): Conflict | undefined {
  const own = conflict.mine ?? conflict.theirs;
  if (!isEdge(own)) return undefined;
  return all.find((other) => {
    const edge = other.mine ?? other.theirs;
    const isBack =
      isEdge(edge) &&
      edge.properties.source === own.properties.target &&
      edge.properties.target === own.properties.source;
    const isAlike = same(other.fields, conflict.fields) && !other.mine === !conflict.mine;
    return isBack && isAlike && edge.level === own.level && edge.part === own.part;
  });
}

/** Gives new features other ids where theirs took the same: two people who draw both make `n1`. */
export function withFreshIds(changes: readonly Change[], theirs: ReadonlyMap<string, Feature>): Change[] {
  const used = new Set([...theirs.values()].map(({ id }) => id));
  for (const { before, after } of changes) used.add((after ?? before)?.id ?? "");
  const renamed = new Map<string, string>();
  const isTaken = (change: Change) => change.before === null && change.after !== null && theirs.has(change.key);
  const fresh = (wanted: string, separator: string) => {
    let number = 2;
    while (used.has(`${wanted}${separator}${number}`)) number += 1;
    used.add(`${wanted}${separator}${number}`);
    return `${wanted}${separator}${number}`;
  };
  for (const change of changes) {
    if (isTaken(change) && change.after && !isEdge(change.after) && !same(change.after, theirs.get(change.key)))
      renamed.set(change.key, fresh(change.after.id, "-"));
  }
  return changes.map((change) => {
    const { before, after } = change;
    if (!after) return change;
    const id = renamed.get(change.key);
    if (id) return moved({ ...after, id }, before);
    if (!isEdge(after)) return change;
    const end = (name: "source" | "target") => {
      const own = String(after.properties[name]);
      return renamed.get(keyOf({ ...after, id: own })) ?? own;
    };
    const [source, target] = [end("source"), end("target")];
    const isTied = source !== after.properties.source || target !== after.properties.target;
    if (!isTied && !(isTaken(change) && !same(after, theirs.get(change.key)))) return change;
    const properties = { ...after.properties, source, target };
    if (before) return { ...change, after: { ...after, properties } };
    const wanted = `${source}_${target}`;
    const edgeId = used.has(wanted) ? fresh(wanted, "#") : wanted;
    used.add(edgeId);
    return moved({ ...after, id: edgeId, properties }, before);
  });
}

function moved(after: Feature, before: Feature | null): Change {
  return { key: keyOf(after), before, after };
}

/** Whether mine can be kept beside theirs, under a new id. */
export function canKeepBoth({ mine, theirs }: Conflict): boolean {
  return mine !== null && theirs !== null && mine.layer !== "location";
}

export interface Merged {
  command: Command | null;
  /** What was done so that no lane is without its nodes. */
  notes: string[];
}

/** Builds the one command that holds the merged changes, on top of the newer version. */
export function merged(
  theirs: Iterable<Feature>,
  { clean, conflicts }: Merge,
  choices: ReadonlyMap<string, Choice>,
  before: (key: string) => Feature | undefined,
  title: string,
): Merged {
  const draft = new Draft(theirs);
  const edits = new Transaction(draft);
  const notes: string[] = [];
  for (const { key, after } of clean) stage(edits, key, after);
  for (const conflict of conflicts) {
    const choice = choices.get(conflict.key) ?? "mine";
    if (choice !== "both") stage(edits, conflict.key, conflict[choice]);
    else if (conflict.mine) edits.put(copyOf(edits, conflict.mine));
  }
  restoreNodes(edits, before, notes);
  keepNodes(edits, notes);
  edits.tie();
  const command = edits.command(title);
  const changes = command.edits.filter(({ from, to }) => !same(from, to));
  return { command: changes.length ? { ...command, edits: changes } : null, notes };
}

function stage(edits: Transaction, key: string, feature: Feature | null): void {
  if (feature) edits.put(feature);
  else {
    const theirs = edits.get(key);
    if (theirs) edits.erase(theirs);
  }
}

function copyOf(edits: Transaction, feature: Feature): Feature {
  const id = isEdge(feature)
    ? edits.edgeId(String(feature.properties.source), String(feature.properties.target), feature)
    : edits.freshId(`${feature.id}-`);
  return { ...feature, id };
}

/** A lane of mine needs a node that they have deleted: the node comes back. */
function restoreNodes(edits: Transaction, before: (key: string) => Feature | undefined, notes: string[]): void {
  for (const { to } of edits.edits()) {
    if (!isEdge(to)) continue;
    for (const end of ["source", "target"] as const) {
      if (edits.endOf(to, end)) continue;
      const node = before(keyOf({ ...to, id: String(to.properties[end]) }));
      if (node) {
        edits.put(node);
        notes.push(`Node ${node.id} was deleted by the other; it is kept, because your lane ${to.id} ends there`);
      } else {
        edits.erase(to);
        notes.push(`Lane ${to.id} is left out: its node ${String(to.properties[end])} is gone`);
      }
    }
  }
}

/** A lane of theirs needs a node that I have deleted: the node stays. */
function keepNodes(edits: Transaction, notes: string[]): void {
  for (const { from, to } of edits.edits()) {
    if (to !== null || !isNode(from)) continue;
    const lanes = [...edits.draft.edgeKeys(from.id)].filter((edge) => {
      const lane = edits.get(edge);
      return isEdge(lane) && (edits.draft.endOf(lane, "source") === from || edits.draft.endOf(lane, "target") === from);
    });
    if (!lanes.length) continue;
    edits.put(from);
    notes.push(`Node ${from.id}, which you deleted, is kept: the other has connected it anew`);
  }
}
