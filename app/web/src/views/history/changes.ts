/** Changed features of two versions: lists, search, both states, and edits that restore. No DOM. */
import type { Schemas } from "../../api/client";
import type { Change, ChangeKind } from "../../map/changes";
import type { Geometry, LayerName } from "../../map/features";

export type Edit = Schemas["EditsBody"]["changes"][number];

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
