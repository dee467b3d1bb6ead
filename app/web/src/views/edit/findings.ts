/** Mistakes that the server finds in a draft, and its repairs as commands. */
import { apiPath, requestJson } from "../../api/client";
import {
  type Feature,
  fromWire,
  type Geometry,
  type LayerName,
  type Position,
  type WireFeature,
} from "../../map/features";
import type { Frame } from "../../map/frame";
import { type Command, type Draft, keyOf, toWire } from "./draft";
import type { Editor } from "./editor";
import { mapPositions } from "./geometry";
import { Transaction } from "./transaction";

export interface FixChange {
  op: "put" | "delete" | "cells";
  layer?: LayerName;
  level?: string;
  name?: string;
  id?: string;
  crs?: "local" | "wgs84";
  feature?: WireFeature;
}

export interface Finding {
  rule: string;
  severity: "error" | "warning" | "info";
  level: string;
  ids: string[];
  where: [number, number] | null;
  detail: string;
  fix?: { title: string; changes: FixChange[] } | null;
}

export interface Findings {
  /** What the draft brings. */
  found: Finding[];
  /** What the version had before. */
  old: Finding[];
}

const MAX_CHANGES = 10_000;

interface Answer {
  items: Finding[];
}

let known: { key: string; items: Finding[] } | null = null;

/** Returns null for a draft too large to be checked while it is drawn. Throws ApiError. */
export async function check(editor: Editor, signal: AbortSignal): Promise<Findings | null> {
  const version = editor.target.draft === null ? (editor.base.peek() ?? 0) : editor.target.ref;
  const level = editor.site.level.peek();
  const changes = toWire(editor.draft.changes(), editor.draft.cells());
  if (!changes.length || changes.length > MAX_CHANGES) return null;
  const path = apiPath(editor.site.path("versions", version, "checks"), { level });
  const key = `${editor.site.name}/${version}/${editor.base.peek()}/${level}`;
  if (known?.key !== key) known = { key, items: (await requestJson<Answer>(path, { signal })).items };
  const before = new Set(known.items.map(identity));
  const { items } = await requestJson<Answer>(path, {
    method: "POST",
    headers: { "content-type": "application/json" },
    body: JSON.stringify({ changes }),
    signal,
  });
  return {
    found: items.filter((item) => !before.has(identity(item))),
    old: items.filter((item) => before.has(identity(item))),
  };
}

function identity({ rule, ids }: Finding): string {
  return `${rule}\u001f${[...ids].sort().join("\u001f")}`;
}

/** Returns a repair as a command on the draft. */
export function fixCommand(draft: Draft, finding: Finding, frame: Frame | null): Command | string {
  const edits = new Transaction(draft);
  for (const change of finding.fix?.changes ?? []) {
    const { layer, level = "ground", name = "", op } = change;
    if (!layer) return "This repair is not possible here";
    if (op === "delete") {
      const feature = edits.get(keyOf({ layer, level, part: name, id: change.id ?? "" }));
      if (feature) edits.remove(feature);
      continue;
    }
    const feature = change.feature && fromWire(layer, { ...change.feature, level, part: name });
    if (!feature) return "This repair is not possible here";
    const geometry =
      change.crs === "wgs84" && !change.feature?.place ? toLocal(feature.geometry, frame) : feature.geometry;
    if (!geometry) return "This repair is not possible without a location";
    edits.put({ ...feature, geometry });
  }
  edits.tie();
  return edits.command(finding.fix?.title ?? "Repair");
}

function toLocal(geometry: Geometry, frame: Frame | null): Geometry | null {
  if (!frame) return null;
  return mapPositions(geometry, (at) => [...frame.toLocal(at as Position), ...at.slice(2)]);
}

export function featuresOf(draft: Draft, finding: Finding): Feature[] {
  const ids = new Set(finding.ids);
  return draft.features().filter(({ id, level }) => ids.has(id) && level === finding.level);
}
