/** Changes in words, for the review. */
import { type Feature, nameOf, type Position } from "../../map/features";
import { count } from "../../ui/text";
import { type CellEdit, type Change, core, isEdge, isNode, same } from "./draft";
import { distance } from "./geometry";
import { placeOf } from "./transaction";

export interface ChangeRow {
  change: Change;
  /** Both directions of a two-way street that changed alike are one row. */
  keys: string[];
  kind: "added" | "changed" | "deleted";
  title: string;
  detail: string;
}

export interface ChangeGroup {
  layer: string;
  rows: ChangeRow[];
}

const LAYERS: Record<string, string> = {
  topology: "Network",
  objects: "Objects",
  zones: "Zones",
  location: "Fence",
};

export function groupsOf(changes: readonly Change[]): ChangeGroup[] {
  const groups = new Map<string, ChangeRow[]>();
  const streets = new Map<string, ChangeRow>();
  for (const change of changes) {
    const feature = (change.after ?? change.before) as Feature;
    if (change.before && change.after && same(core(change.before), core(change.after))) continue; // follows its nodes
    const row = rowOf(change, feature);
    const rows = groups.get(feature.layer) ?? [];
    groups.set(feature.layer, rows);
    if (isEdge(feature)) {
      const ends = [String(feature.properties.source), String(feature.properties.target)];
      const back = streets.get(`${row.kind}/${ends[1]}/${ends[0]}/${row.detail}`);
      if (back && back.keys.length === 1) {
        back.keys.push(change.key);
        back.title = `Two-way street ${ends[1]} – ${ends[0]}`;
        continue;
      }
      streets.set(`${row.kind}/${ends[0]}/${ends[1]}/${row.detail}`, row);
    }
    rows.push(row);
  }
  return [...groups].map(([layer, rows]) => ({ layer: LAYERS[layer] ?? layer, rows }));
}

function rowOf(change: Change, feature: Feature): ChangeRow {
  const kind = !change.before ? "added" : !change.after ? "deleted" : "changed";
  return {
    change,
    keys: [change.key],
    kind,
    title: titleOf(feature),
    detail: kind === "changed" ? detailOf(change) : "",
  };
}

export function titleOf(feature: Feature): string {
  const name = nameOf(feature) === feature.id ? feature.id : `${nameOf(feature)} (${feature.id})`;
  if (isNode(feature)) return `Node ${name}`;
  if (isEdge(feature)) return `Lane ${String(feature.properties.source)} → ${String(feature.properties.target)}`;
  if (feature.layer === "location") return "Fence";
  const kind = String(feature.properties.kind ?? (feature.layer === "zones" ? "zone" : "object"));
  return `${kind[0]?.toUpperCase() ?? ""}${kind.slice(1)} ${name}`;
}

/** Says what differs: how far it moved, which properties. */
function detailOf({ before, after }: Change): string {
  if (!before || !after) return "";
  const parts: string[] = [];
  if (!same(before.geometry, after.geometry)) parts.push(shapeDetail(before, after));
  const names = new Set([...Object.keys(before.properties), ...Object.keys(after.properties)]);
  const changed = [...names].filter((name) => !same(before.properties[name], after.properties[name]));
  for (const name of changed.slice(0, 3)) {
    const [old, now] = [before.properties[name], after.properties[name]].map(short);
    parts.push(
      now === undefined ? `${name} removed` : old === undefined ? `${name}: ${now}` : `${name}: ${old} → ${now}`,
    );
  }
  if (changed.length > 3) parts.push(`${changed.length - 3} more properties`);
  return parts.join(" · ");
}

function shapeDetail(before: Feature, after: Feature): string {
  if (before.geometry.type !== "Point" || after.geometry.type !== "Point") return isEdge(after) ? "course" : "shape";
  const off = distance(placeOf(before) as Position, placeOf(after) as Position);
  return off >= 1 ? `moved by ${off.toFixed(2)} m` : `moved by ${(off * 1000).toFixed(0)} mm`;
}

function short(value: unknown): string | undefined {
  if (value === undefined) return undefined;
  const text = typeof value === "string" ? value : JSON.stringify(value);
  return text.length > 30 ? `${text.slice(0, 29)}…` : text;
}

export function cellTitle({ grid, value }: CellEdit): string {
  return `Cells of “${grid}” ${value === 255 ? "unknown" : value >= 50 ? "occupied" : "free"}`;
}

/** A message for those who write none: "Node Gate changed, 3 lanes deleted". */
export function summary(groups: readonly ChangeGroup[], cells: readonly CellEdit[]): string {
  const rows = groups.flatMap((group) => group.rows);
  const parts: string[] = [];
  const counts = new Map<string, ChangeRow[]>();
  for (const row of rows) {
    const key = `${nounOf(row)}/${row.kind}`;
    counts.set(key, [...(counts.get(key) ?? []), row]);
  }
  for (const [key, list] of counts) {
    const [noun = "", kind = ""] = key.split("/");
    parts.push(list.length === 1 ? `${list[0]?.title} ${kind}` : `${count(list.length, noun)} ${kind}`);
  }
  if (cells.length) parts.push(`cells set in ${count(cells.length, "place")}`);
  return parts.slice(0, 5).join(", ") + (parts.length > 5 ? " …" : "");
}

function nounOf({ change, keys }: ChangeRow): string {
  const feature = change.after ?? change.before;
  if (isNode(feature)) return "node";
  if (isEdge(feature)) return keys.length > 1 ? "street" : "lane";
  return { zones: "zone", location: "fence" }[String(feature?.layer)] ?? "object";
}
