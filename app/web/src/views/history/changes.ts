/** Changed features of two versions: lists, search, both states, and edits that restore. No DOM. */
import type { Schemas } from "../../api/client";
import type { Feature, Geometry, LayerName } from "../../map/features";

export type WireChange = Schemas["FeatureChangeOut"];
export type ChangeKind = "added" | "changed" | "deleted";
export type Edit = Schemas["EditsBody"]["changes"][number];

export interface Change {
  /** Unique in a comparison: layer, level, part and id. */
  key: string;
  id: string;
  name: string;
  layer: LayerName;
  kind: string;
  change: ChangeKind;
  level: string;
  part: string;
  before: Record<string, unknown> | null;
  after: Record<string, unknown> | null;
  beforeGeometry: Geometry | null;
  afterGeometry: Geometry | null;
  fields: string[];
}

export const KINDS: ChangeKind[] = ["added", "changed", "deleted"];

export function changeOf(wire: WireChange): Change {
  const { layer, change, before, after, before_geometry, fields, kind } = wire.properties;
  const geometry = (wire.place ?? wire.geometry ?? null) as Geometry | null;
  const old = (before_geometry ?? null) as Geometry | null;
  const name = (after ?? before)?.name;
  return {
    key: [layer, wire.level, wire.part, wire.id].join("/"),
    id: wire.id,
    name: typeof name === "string" && name ? name : wire.id,
    layer,
    kind: kind ?? layer,
    change,
    level: wire.level,
    part: wire.part,
    before: (before ?? null) as Change["before"],
    after: (after ?? null) as Change["after"],
    beforeGeometry: change === "added" ? null : (old ?? geometry),
    afterGeometry: change === "deleted" ? null : geometry,
    fields,
  };
}

/** Returns the feature as it was or is, to be drawn; null if there is none. */
export function stateOf(change: Change, when: "before" | "after"): Feature | null {
  const geometry = when === "before" ? change.beforeGeometry : change.afterGeometry;
  if (!geometry) return null;
  const { id, layer, level, part, name, kind } = change;
  return { id, layer, level, part, geometry, properties: { name, kind, change: change.change, key: change.key } };
}

export interface Group {
  title: string;
  changes: Change[];
}

const ORDER: LayerName[] = ["topology", "zones", "objects", "location"];
const TITLES: Record<LayerName, string> = {
  topology: "Network",
  zones: "Zones",
  objects: "Objects",
  location: "Fence",
};

export function groupsOf(changes: readonly Change[]): Group[] {
  const groups: Group[] = [];
  for (const layer of ORDER) {
    const own = changes.filter((change) => change.layer === layer);
    if (layer !== "topology") {
      if (own.length) groups.push({ title: TITLES[layer], changes: own });
      continue;
    }
    for (const [kind, title] of [
      ["node", "Nodes"],
      ["edge", "Edges"],
    ]) {
      const some = own.filter((change) => change.kind === kind);
      if (some.length && title) groups.push({ title, changes: some });
    }
  }
  return groups;
}

export function filterChanges(changes: readonly Change[], text: string, kinds: ReadonlySet<ChangeKind>): Change[] {
  const wanted = text.trim().toLowerCase();
  return changes.filter(
    (change) =>
      kinds.has(change.change) &&
      (!wanted ||
        `${change.id} ${change.name} ${change.kind} ${change.fields.join(" ")}`.toLowerCase().includes(wanted)),
  );
}

export interface ValueRow {
  name: string;
  before: string;
  after: string;
  differs: boolean;
}

/** Properties of both states side by side: those that differ first. */
export function valueRows(change: Change): ValueRow[] {
  const names = new Set([...Object.keys(change.before ?? {}), ...Object.keys(change.after ?? {})]);
  const rows = [...names].map((name) => {
    const [before, after] = [textOf(change.before?.[name]), textOf(change.after?.[name])];
    return { name, before, after, differs: before !== after };
  });
  if (change.fields.includes("geometry")) {
    rows.push({
      name: "position",
      before: positionText(change.beforeGeometry),
      after: positionText(change.afterGeometry),
      differs: true,
    });
  }
  return rows.sort((one, other) => Number(other.differs) - Number(one.differs) || one.name.localeCompare(other.name));
}

function textOf(value: unknown): string {
  if (value === undefined) return "";
  return (typeof value === "object" ? JSON.stringify(value) : String(value)).slice(0, 2000);
}

function positionText(geometry: Geometry | null): string {
  if (!geometry || geometry.type === "GeometryCollection") return "";
  if (geometry.type === "Point")
    return geometry.coordinates
      .slice(0, 2)
      .map((value) => value.toFixed(3))
      .join(", ");
  const points = geometry.coordinates.flat(geometry.type === "LineString" || geometry.type === "MultiPoint" ? 0 : 1);
  return `${points.length} ${geometry.type === "LineString" ? "points" : "corners"}`;
}

/** Returns the changes that must be undone with one: an edge needs its nodes, and no edge may lack one. */
export function undoneWith(change: Change, all: readonly Change[]): Change[] {
  const out = [change];
  if (change.layer !== "topology") return out;
  const near = all.filter((other) => other.layer === "topology" && other.level === change.level && other !== change);
  const ends = (other: Change) => {
    const { source, target } = other.before ?? other.after ?? {};
    return [source, target];
  };
  if (change.kind === "edge" && change.before) {
    const own = ends(change);
    out.push(...near.filter((other) => other.kind === "node" && other.change === "deleted" && own.includes(other.id)));
  }
  if (change.kind === "node" && change.change === "added") {
    out.push(
      ...near.filter((other) => other.kind === "edge" && other.change === "added" && ends(other).includes(change.id)),
    );
  }
  return out;
}

/** Edits that put the earlier states of features on the head. */
export function restoreEdits(changes: readonly Change[]): Edit[] {
  const order = (change: Change) => (change.kind === "node" ? 0 : 1);
  return [...changes]
    .sort((one, other) => order(one) - order(other))
    .map((change): Edit => {
      const place = { layer: change.layer, level: change.level, name: change.part || null };
      if (!change.before || !change.beforeGeometry) return { op: "delete", id: change.id, ...place };
      const feature = {
        type: "Feature",
        id: change.id,
        geometry: null,
        place: change.beforeGeometry,
        properties: change.before,
      };
      return { op: "put", feature, crs: "local", ...place };
    });
}
