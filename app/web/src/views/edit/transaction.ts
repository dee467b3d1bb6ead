/** Edits that belong together, before they become one command. Edges stay tied to their nodes. */
import { type Feature, type Geometry, pointsOf, type Position } from "../../map/features";
import { add, type Command, type Draft, type Edit, endsOf, isEdge, isNode, keyOf } from "./draft";
import { movedTo, translate } from "./geometry";

export class Transaction {
  private readonly staged = new Map<string, Feature | null>();
  /** Keys of the edges that were put, by the ids of their ends. */
  private readonly edges = new Map<string, Set<string>>();
  private readonly newIds = new Set<string>();

  constructor(readonly draft: Draft) {}

  get(key: string): Feature | undefined {
    return this.staged.has(key) ? (this.staged.get(key) ?? undefined) : this.draft.get(key);
  }

  put(feature: Feature): Feature {
    const key = keyOf(feature);
    this.staged.set(key, feature);
    if (isEdge(feature)) for (const end of endsOf(feature)) add(this.edges, end, key);
    return feature;
  }

  /** Removes a feature; a node's edges go with it. */
  remove(feature: Feature): void {
    if (isNode(feature)) for (const edge of this.edgesOf(feature)) this.staged.set(keyOf(edge), null);
    this.staged.set(keyOf(feature), null);
  }

  /** Removes a feature alone: what depends on it is looked after by the caller. */
  erase(feature: Feature): void {
    this.staged.set(keyOf(feature), null);
  }

  freshId(prefix: string): string {
    const id = this.draft.freshId(prefix, this.newIds);
    this.newIds.add(id);
    return id;
  }

  /** Returns the id of a new edge: `a_b`, or `a_b#2` where that is taken. A deleted edge that was the same returns. */
  edgeId(source: string, target: string, where: { level: string; part: string }): string {
    const id = `${source}_${target}`;
    for (let number = 1; ; number++) {
      const free = number === 1 ? id : `${id}#${number}`;
      const key = keyOf({ ...where, layer: "topology", id: free });
      const before = this.draft.before(key)?.properties;
      const returns = before?.source === source && before.target === target && !this.get(key);
      if ((this.draft.isIdUsed(free) && !returns) || this.newIds.has(free)) continue;
      this.newIds.add(free);
      return free;
    }
  }

  addNode(at: Position, like: { level: string; part: string }, properties: Record<string, unknown> = {}): Feature {
    return this.put({
      id: this.freshId("n"),
      layer: "topology",
      level: like.level,
      part: like.part,
      geometry: { type: "Point", coordinates: movedTo([], at[0], at[1]) },
      properties: { kind: "node", ...properties },
    });
  }

  addEdge(source: Feature, target: Feature, properties: Record<string, unknown> = {}, inner: number[][] = []): Feature {
    const coordinates = [placeOf(source), ...inner, placeOf(target)];
    return this.put({
      id: this.edgeId(source.id, target.id, source),
      layer: "topology",
      level: source.level,
      part: source.part,
      geometry: { type: "LineString", coordinates },
      properties: { ...properties, kind: "edge", source: source.id, target: target.id },
    });
  }

  endOf(edge: Feature, end: "source" | "target"): Feature | undefined {
    const id = String(edge.properties[end]);
    const own = this.get(keyOf({ ...edge, id }));
    if (isNode(own)) return own;
    const other = this.draft.endOf(edge, end);
    return other && this.get(keyOf(other));
  }

  edgesOf(node: Feature): Feature[] {
    const keys = new Set([...this.draft.edgeKeys(node.id), ...(this.edges.get(node.id) ?? [])]);
    const out: Feature[] = [];
    for (const key of keys) {
      const edge = this.get(key);
      if (!isEdge(edge)) continue;
      const ends = [this.endOf(edge, "source"), this.endOf(edge, "target")];
      if (ends.some((end) => end && keyOf(end) === keyOf(node))) out.push(edge);
    }
    return out;
  }

  edgesBetween(source: Feature, target: Feature): Feature[] {
    return this.edgesOf(source).filter(
      (edge) => edge.properties.source === source.id && edge.properties.target === target.id,
    );
  }

  /** Moves features; edges follow their nodes, bends follow where both ends go along. */
  move(keys: Iterable<string>, dx: number, dy: number): void {
    const nodes = new Map<string, Feature>();
    const moving = new Set<string>();
    for (const key of keys) {
      const feature = this.get(key);
      if (!feature) continue;
      if (isEdge(feature)) {
        moving.add(key);
        for (const end of ["source", "target"] as const) {
          const node = this.endOf(feature, end);
          if (node) nodes.set(keyOf(node), node);
        }
      } else if (isNode(feature)) nodes.set(key, feature);
      else this.put(movedFeature(feature, dx, dy));
    }
    const touched = new Map<string, Feature>();
    for (const node of nodes.values()) for (const edge of this.edgesOf(node)) touched.set(keyOf(edge), edge);
    for (const node of nodes.values()) this.put(movedFeature(node, dx, dy));
    for (const [key, edge] of touched) {
      const ends = [this.endOf(edge, "source"), this.endOf(edge, "target")];
      const goesAlong = moving.has(key) || ends.every((end) => end && nodes.has(keyOf(end)));
      const carried = goesAlong ? { ...edge, geometry: translate(edge.geometry, dx, dy) } : edge;
      this.put(this.tied(carried));
    }
  }

  /** Moves a node to a place, its edges' ends with it. */
  place(node: Feature, x: number, y: number): void {
    const [oldX = 0, oldY = 0] = placeOf(node);
    this.move([keyOf(node)], x - oldX, y - oldY);
  }

  /** Returns an edge whose ends are at its nodes. */
  tied(edge: Feature): Feature {
    if (edge.geometry.type !== "LineString") return edge;
    const line = edge.geometry.coordinates;
    const [source, target] = [this.endOf(edge, "source"), this.endOf(edge, "target")];
    const coordinates = line.map((at, index) => {
      const node = index === 0 ? source : index === line.length - 1 ? target : undefined;
      return node ? movedTo(at, placeOf(node)[0] ?? 0, placeOf(node)[1] ?? 0) : at;
    });
    return { ...edge, geometry: { type: "LineString", coordinates } };
  }

  /** Ties the edges to the nodes that were put, and those that were put to their nodes. */
  tie(): void {
    for (const { to } of this.edits()) {
      if (isNode(to)) for (const edge of this.edgesOf(to)) this.put(this.tied(edge));
      else if (isEdge(to)) this.put(this.tied(to));
    }
  }

  edits(): Edit[] {
    return [...this.staged].map(([key, to]) => ({ key, from: this.draft.get(key) ?? null, to }));
  }

  command(title: string): Command {
    return { title, edits: this.edits() };
  }
}

export function placeOf(node: Feature): number[] {
  return pointsOf(node.geometry)[0] ?? [0, 0];
}

/** Returns a feature moved, its pose with it. */
function movedFeature(feature: Feature, dx: number, dy: number): Feature {
  const geometry: Geometry = translate(feature.geometry, dx, dy);
  const { pose } = feature.properties;
  if (!Array.isArray(pose) || typeof pose[0] !== "number" || typeof pose[1] !== "number")
    return { ...feature, geometry };
  return {
    ...feature,
    geometry,
    properties: { ...feature.properties, pose: movedTo(pose, pose[0] + dx, pose[1] + dy) },
  };
}
