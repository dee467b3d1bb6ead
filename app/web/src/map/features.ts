/** Features of the vector layers in local metres, and their index by place. */
import RBush from "ol/structs/RBush";

export type LayerName = "topology" | "objects" | "zones" | "location";
export type Position = [number, number];

export type Geometry =
  | { type: "Point"; coordinates: number[] }
  | { type: "MultiPoint" | "LineString"; coordinates: number[][] }
  | { type: "MultiLineString" | "Polygon"; coordinates: number[][][] }
  | { type: "MultiPolygon"; coordinates: number[][][][] }
  | { type: "GeometryCollection"; geometries: Geometry[] };

export interface Feature {
  id: string;
  layer: LayerName | "closures" | "robots" | "drawn";
  level: string;
  part: string;
  geometry: Geometry;
  properties: Record<string, unknown>;
}

/** A feature as the API sends it: `place` holds local metres (JSON-FG), or `geometry` does with `crs=local`. */
export interface WireFeature {
  id: string | number;
  geometry: Geometry | null;
  place?: Geometry | null;
  properties: Record<string, unknown> | null;
  level?: string;
  part?: string;
}

export function fromWire(layer: Feature["layer"], wire: WireFeature): Feature | null {
  const geometry = wire.place ?? wire.geometry;
  if (!geometry) return null;
  return {
    id: String(wire.id),
    layer,
    level: wire.level ?? "ground",
    part: wire.part ?? "",
    geometry,
    properties: wire.properties ?? {},
  };
}

export type Box = [number, number, number, number];

export const EMPTY_BOX: Box = [Infinity, Infinity, -Infinity, -Infinity];

export function boxOf(geometry: Geometry, box: Box = [...EMPTY_BOX]): Box {
  visitPositions(geometry, (x, y) => {
    if (x < box[0]) box[0] = x;
    if (y < box[1]) box[1] = y;
    if (x > box[2]) box[2] = x;
    if (y > box[3]) box[3] = y;
  });
  return box;
}

export function isIn(box: Box, x: number, y: number): boolean {
  return x >= box[0] && x <= box[2] && y >= box[1] && y <= box[3];
}

export function joinBoxes(boxes: Iterable<readonly number[]>): Box | null {
  const out: Box = [...EMPTY_BOX];
  for (const [a = Infinity, b = Infinity, c = -Infinity, d = -Infinity] of boxes) {
    out[0] = Math.min(out[0], a);
    out[1] = Math.min(out[1], b);
    out[2] = Math.max(out[2], c);
    out[3] = Math.max(out[3], d);
  }
  return Number.isFinite(out[0]) ? out : null;
}

export function centreOf(geometry: Geometry): Position {
  if (geometry.type === "Point") return [geometry.coordinates[0] ?? 0, geometry.coordinates[1] ?? 0];
  const box = boxOf(geometry);
  return [(box[0] + box[2]) / 2, (box[1] + box[3]) / 2];
}

export function visitPositions(geometry: Geometry, visit: (x: number, y: number) => void): void {
  if (geometry.type === "GeometryCollection") {
    for (const one of geometry.geometries) visitPositions(one, visit);
    return;
  }
  const walk = (value: unknown): void => {
    const list = value as number[] | unknown[];
    if (typeof list[0] === "number") visit(list[0], list[1] as number);
    else for (const one of list) walk(one);
  };
  if (geometry.coordinates.length) walk(geometry.coordinates);
}

/** Lines of a geometry, rings included; a polygon's are closed. */
export function linesOf(geometry: Geometry): number[][][] {
  switch (geometry.type) {
    case "LineString":
      return [geometry.coordinates];
    case "MultiLineString":
    case "Polygon":
      return geometry.coordinates;
    case "MultiPolygon":
      return geometry.coordinates.flat();
    case "GeometryCollection":
      return geometry.geometries.flatMap(linesOf);
    default:
      return [];
  }
}

export function pointsOf(geometry: Geometry): number[][] {
  switch (geometry.type) {
    case "Point":
      return [geometry.coordinates];
    case "MultiPoint":
      return geometry.coordinates;
    case "GeometryCollection":
      return geometry.geometries.flatMap(pointsOf);
    default:
      return [];
  }
}

export function isArea(geometry: Geometry): boolean {
  return geometry.type === "Polygon" || geometry.type === "MultiPolygon";
}

export function nameOf(feature: Feature): string {
  const name = feature.properties.name;
  return typeof name === "string" && name ? name : feature.id;
}

const MAX_CHANGES = 1000;

/** Index of features by place, built when it is first asked: the map is painted before. */
export class FeatureIndex {
  private tree: RBush<{ feature: Feature }> | null = null;
  /** What has changed since the tree was built. */
  private readonly gone = new Set<Feature>();
  private readonly added = new Set<Feature>();
  private readonly ids: Map<string, Feature>;

  constructor(private features: readonly Feature[]) {
    this.ids = new Map(features.map((feature) => [feature.id, feature]));
  }

  get byId(): ReadonlyMap<string, Feature> {
    return this.ids;
  }

  change(removed: Iterable<Feature>, added: Iterable<Feature>): void {
    for (const feature of removed) {
      if (!this.added.delete(feature)) this.gone.add(feature);
      if (this.ids.get(feature.id) === feature) this.ids.delete(feature.id);
    }
    for (const feature of added) {
      if (!this.gone.delete(feature)) this.added.add(feature);
      this.ids.set(feature.id, feature);
    }
    if (this.gone.size + this.added.size < MAX_CHANGES) return;
    this.features = [...this.features.filter((feature) => !this.gone.has(feature)), ...this.added];
    this.tree = null;
    this.gone.clear();
    this.added.clear();
  }

  inBox(box: Box): Feature[] {
    this.tree ??= treeOf(this.features);
    const found = this.tree.getInExtent(box).map(({ feature }) => feature);
    const more = [...this.added].filter((feature) => intersects(boxOf(feature.geometry), box));
    return [...found.filter((feature) => !this.gone.has(feature)), ...more];
  }

  /** Returns the features within `reach` metres of a point, nearest first; points come before lines, areas last. */
  near(point: Position, reach: number): Feature[] {
    const [x, y] = point;
    const out: { feature: Feature; rank: number }[] = [];
    for (const feature of this.inBox([x - reach, y - reach, x + reach, y + reach])) {
      const distance = distanceTo(feature.geometry, point);
      if (distance > reach) continue;
      const kind = isArea(feature.geometry) ? 2 : linesOf(feature.geometry).length ? 1 : 0;
      out.push({ feature, rank: kind * 1e9 + (kind === 2 ? areaOf(feature.geometry) : distance) });
    }
    return out.sort((one, other) => one.rank - other.rank).map(({ feature }) => feature);
  }
}

/** Features are wrapped: OpenLayers puts a number of its own into what it is given. */
function treeOf(features: readonly Feature[]): RBush<{ feature: Feature }> {
  const tree = new RBush<{ feature: Feature }>(12);
  const boxes = features.map((feature) => boxOf(feature.geometry));
  const isPlaced = (_: unknown, index: number) => Number.isFinite(boxes[index]?.[0]);
  tree.load(
    boxes.filter(isPlaced),
    features.filter(isPlaced).map((feature) => ({ feature })),
  );
  return tree;
}

function intersects(one: Box, other: Box): boolean {
  return one[0] <= other[2] && one[2] >= other[0] && one[1] <= other[3] && one[3] >= other[1];
}

/** What has left a list and what has come into it, by identity. */
export function difference<T>(before: readonly T[], after: readonly T[]): { removed: Set<T>; added: T[] } {
  const least = Math.min(before.length, after.length);
  let start = 0;
  while (start < least && before[start] === after[start]) start += 1;
  let end = 0;
  while (end < least - start && before.at(-1 - end) === after.at(-1 - end)) end += 1;
  const removed = new Set(before.slice(start, before.length - end));
  const added = after.slice(start, after.length - end).filter((one) => !removed.delete(one));
  return { removed, added };
}

/** Distance in metres; 0 inside an area. */
export function distanceTo(geometry: Geometry, point: Position): number {
  if (isArea(geometry) && contains(geometry, point)) return 0;
  let best = Infinity;
  for (const [x = 0, y = 0] of pointsOf(geometry)) best = Math.min(best, Math.hypot(x - point[0], y - point[1]));
  for (const line of linesOf(geometry)) {
    for (let index = 1; index < line.length; index++) {
      best = Math.min(best, nearestOnSegment(line[index - 1] as Position, line[index] as Position, point).distance);
    }
  }
  return best;
}

export function nearestOnSegment(from: Position, to: Position, point: Position) {
  const [dx, dy] = [to[0] - from[0], to[1] - from[1]];
  const squared = dx * dx + dy * dy;
  const along = squared ? ((point[0] - from[0]) * dx + (point[1] - from[1]) * dy) / squared : 0;
  const share = Math.max(0, Math.min(1, along));
  const at: Position = [from[0] + share * dx, from[1] + share * dy];
  return { at, share, distance: Math.hypot(at[0] - point[0], at[1] - point[1]) };
}

function contains(geometry: Geometry, [x, y]: Position): boolean {
  let inside = false;
  for (const ring of linesOf(geometry)) {
    for (let index = 0, before = ring.length - 1; index < ring.length; before = index++) {
      const [ax = 0, ay = 0] = ring[index] ?? [];
      const [bx = 0, by = 0] = ring[before] ?? [];
      if (ay > y !== by > y && x < ((bx - ax) * (y - ay)) / (by - ay) + ax) inside = !inside;
    }
  }
  return inside;
}

function areaOf(geometry: Geometry): number {
  const [a, b, c, d] = boxOf(geometry);
  return (c - a) * (d - b);
}
