/** Changes to the features of a version, as commands that can be undone and done again.
 *
 * Features are never changed in place: a command names the feature before and after, so that undoing is exact. */
import type { Feature, LayerName } from "../../map/features";

export interface Edit {
  key: string;
  from: Feature | null;
  to: Feature | null;
}

/** Cells of a grid that get a value: those whose centres are in one of the polygons. */
export interface CellEdit {
  id: string;
  grid: string;
  level: string;
  polygons: number[][][][];
  value: number;
}

export interface Command {
  title: string;
  edits: Edit[];
  cells?: CellEdit[];
  /** Ids of earlier cell edits that are taken back. */
  dropCells?: string[];
}

export interface Change {
  key: string;
  before: Feature | null;
  after: Feature | null;
}

/** What a person decides of a feature: a lane's ends follow from its nodes. */
export function core(feature: Feature | null): unknown {
  if (!feature) return null;
  const { id, layer, level, part, geometry, properties } = feature;
  if (isEdge(feature) && geometry.type === "LineString") {
    return { id, layer, level, part, properties, inner: geometry.coordinates.slice(1, -1) };
  }
  return { id, layer, level, part, properties, geometry };
}

/** A change as `POST …/edits` takes it. */
export type WireChange = Record<string, unknown>;

export const EDITED_LAYERS: readonly LayerName[] = ["topology", "objects", "zones", "location"];

export function keyOf(feature: Pick<Feature, "layer" | "level" | "part" | "id">): string {
  return `${feature.layer}\u001f${feature.level}\u001f${feature.part}\u001f${feature.id}`;
}

/** A node or an edge. */
export interface NetworkFeature extends Feature {
  layer: "topology";
}

export function isNode(feature: Feature | null | undefined): feature is NetworkFeature {
  return feature?.layer === "topology" && feature.properties.kind !== "edge";
}

export function isEdge(feature: Feature | null | undefined): feature is NetworkFeature {
  return feature?.layer === "topology" && feature.properties.kind === "edge";
}

/** Whether two values of JSON are equal; the order of an object's members does not matter. */
export function same(a: unknown, b: unknown): boolean {
  if (Object.is(a, b)) return true;
  if (typeof a !== "object" || typeof b !== "object" || a === null || b === null) return false;
  if (Array.isArray(a) || Array.isArray(b)) {
    return (
      Array.isArray(a) && Array.isArray(b) && a.length === b.length && a.every((one, index) => same(one, b[index]))
    );
  }
  const [left, right] = [a as Record<string, unknown>, b as Record<string, unknown>];
  const names = Object.keys(left);
  return (
    names.length === Object.keys(right).length && names.every((name) => name in right && same(left[name], right[name]))
  );
}

export class Draft {
  log: Command[] = [];
  /** Number of commands of the log that are in force; those behind it can be done again. */
  position = 0;
  /** Stands in new ids where not all features are loaded, so that none is taken twice. */
  idMark = "";
  private readonly base = new Map<string, Feature>();
  private readonly current = new Map<string, Feature>();
  private readonly edges = new Map<string, Set<string>>();
  private readonly nodes = new Map<string, Set<string>>();
  /** Ids of the version: a deleted one is not given to something else. */
  private readonly baseIds = new Set<string>();
  /** How many features have an id now. */
  private readonly ids = new Map<string, number>();
  private list: Feature[] | null = null;

  constructor(features: Iterable<Feature>, commands: Command[] = [], position = commands.length) {
    this.addBase(features);
    this.log = commands;
    for (const command of commands.slice(0, position)) this.apply(command.edits, "to");
    this.position = position;
  }

  /** Adds features of the version that are loaded later; those known stay as they are. */
  addBase(features: Iterable<Feature>): void {
    for (const feature of features) {
      if (!EDITED_LAYERS.includes(feature.layer as LayerName)) continue;
      const key = keyOf(feature);
      if (this.base.has(key)) continue;
      this.base.set(key, feature);
      this.baseIds.add(feature.id);
      this.set(key, feature);
    }
  }

  get(key: string): Feature | undefined {
    return this.current.get(key);
  }

  before(key: string): Feature | undefined {
    return this.base.get(key);
  }

  features(): readonly Feature[] {
    this.list ??= [...this.current.values()];
    return this.list;
  }

  isIdUsed(id: string): boolean {
    return this.baseIds.has(id) || this.ids.has(id);
  }

  /** Returns an id that is not in use: `n1`, `n2`, … */
  freshId(prefix: string, taken: ReadonlySet<string> = new Set()): string {
    const start = `${prefix}${this.idMark}`;
    let number = 1;
    while (this.isIdUsed(`${start}${number}`) || taken.has(`${start}${number}`)) number += 1;
    return `${start}${number}`;
  }

  /** Returns the node an edge starts or ends at: that of its own part, else of another (a lift's lane). */
  endOf(edge: Feature, end: "source" | "target"): Feature | undefined {
    const id = String(edge.properties[end]);
    const own = this.current.get(keyOf({ ...edge, id }));
    if (isNode(own)) return own;
    for (const key of this.nodes.get(id) ?? []) {
      const node = this.current.get(key);
      if (isNode(node)) return node;
    }
    return undefined;
  }

  edgesOf(node: Feature): Feature[] {
    const out: Feature[] = [];
    for (const key of this.edges.get(node.id) ?? []) {
      const edge = this.current.get(key);
      if (edge && (this.endOf(edge, "source") === node || this.endOf(edge, "target") === node)) out.push(edge);
    }
    return out;
  }

  /** Keys of the edges whose source or target has an id. */
  edgeKeys(id: string): ReadonlySet<string> {
    return this.edges.get(id) ?? new Set();
  }

  /** Returns the edge back along the same street, if there is one. */
  twinOf(edge: Feature): Feature | undefined {
    for (const key of this.edges.get(String(edge.properties.target)) ?? []) {
      const other = this.current.get(key);
      if (
        other &&
        other !== edge &&
        other.level === edge.level &&
        other.part === edge.part &&
        other.properties.source === edge.properties.target &&
        other.properties.target === edge.properties.source
      )
        return other;
    }
    return undefined;
  }

  /** Does a command. Returns false if it changes nothing. */
  execute(command: Command): boolean {
    const edits = command.edits.filter(({ from, to }) => !same(from, to));
    if (!edits.length && !command.cells?.length && !command.dropCells?.length) return false;
    this.log = [...this.log.slice(0, this.position), { ...command, edits }];
    this.position += 1;
    this.apply(edits, "to");
    return true;
  }

  undo(): Command | null {
    const command = this.log[this.position - 1];
    if (!command) return null;
    this.position -= 1;
    this.apply(command.edits, "from");
    return command;
  }

  redo(): Command | null {
    const command = this.log[this.position];
    if (!command) return null;
    this.position += 1;
    this.apply(command.edits, "to");
    return command;
  }

  /** Returns what differs from the version, nodes before edges. */
  changes(): Change[] {
    const keys = new Set<string>();
    for (const command of this.log.slice(0, this.position)) for (const { key } of command.edits) keys.add(key);
    const out: Change[] = [];
    for (const key of keys) {
      const before = this.base.get(key) ?? null;
      const after = this.current.get(key) ?? null;
      if (!same(before, after)) out.push({ key, before, after });
    }
    return out.sort((one, other) => rank(one) - rank(other));
  }

  cells(): CellEdit[] {
    let out: CellEdit[] = [];
    for (const { cells, dropCells } of this.log.slice(0, this.position)) {
      if (cells) out = [...out, ...cells];
      if (dropCells) out = out.filter(({ id }) => !dropCells.includes(id));
    }
    return out;
  }

  get isChanged(): boolean {
    return this.changes().length > 0 || this.cells().length > 0;
  }

  private apply(edits: Edit[], which: "from" | "to"): void {
    for (const edit of which === "to" ? edits : [...edits].reverse()) this.set(edit.key, edit[which]);
  }

  private set(key: string, feature: Feature | null): void {
    const old = this.current.get(key);
    if (old) this.unlink(key, old);
    if (feature) {
      this.current.set(key, feature);
      this.ids.set(feature.id, (this.ids.get(feature.id) ?? 0) + 1);
      if (isEdge(feature)) for (const end of endsOf(feature)) add(this.edges, end, key);
      else if (isNode(feature)) add(this.nodes, feature.id, key);
    } else this.current.delete(key);
    this.list = null;
  }

  private unlink(key: string, feature: Feature): void {
    const count = this.ids.get(feature.id) ?? 0;
    if (count > 1) this.ids.set(feature.id, count - 1);
    else this.ids.delete(feature.id);
    if (isEdge(feature)) for (const end of endsOf(feature)) this.edges.get(end)?.delete(key);
    else this.nodes.get(feature.id)?.delete(key);
  }
}

export function endsOf(edge: Feature): string[] {
  return [String(edge.properties.source), String(edge.properties.target)];
}

export function add(map: Map<string, Set<string>>, id: string, key: string): void {
  const keys = map.get(id);
  if (keys) keys.add(key);
  else map.set(id, new Set([key]));
}

/** Nodes are put before edges, edges deleted before nodes. */
function rank({ before, after }: Change): number {
  if (after) return isEdge(after) ? 1 : 0;
  return isEdge(before) ? 2 : 3;
}

/** Returns changes in the form of `POST …/edits`, everything in local metres. */
export function toWire(changes: readonly Change[], cells: readonly CellEdit[]): WireChange[] {
  const features = changes.map(({ before, after }): WireChange => {
    const feature = (after ?? before) as Feature;
    const where = { layer: feature.layer, level: feature.level, ...(feature.part ? { name: feature.part } : {}) };
    if (!after) return { op: "delete", ...where, id: feature.id };
    const { id, geometry, properties } = after;
    return { op: "put", ...where, feature: { type: "Feature", id, geometry: null, place: geometry, properties } };
  });
  const rasters = cells.flatMap(({ grid, level, polygons, value }) =>
    polygons.map((coordinates): WireChange => {
      return { op: "cells", grid, level, crs: "local", polygon: { type: "Polygon", coordinates }, value };
    }),
  );
  return [...features, ...rasters];
}
