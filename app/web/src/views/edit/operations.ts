/** What can be done to selected features. Each function returns one command, or a text that says why it cannot. */
import { type Feature, linesOf, nearestOnSegment, type Position, pointsOf } from "../../map/features";
import { type Command, type Draft, isEdge, isNode, keyOf } from "./draft";
import { distance, farthest, movedTo, outlinesOf, projected, round } from "./geometry";
import { placeOf, Transaction } from "./transaction";

export type Outcome = Command | string;

export function remove(draft: Draft, features: Feature[]): Outcome {
  const edits = new Transaction(draft);
  for (const feature of features) edits.remove(feature);
  return edits.command(features.length === 1 ? `Delete ${features[0]?.id}` : `Delete ${features.length} features`);
}

export function move(draft: Draft, features: Feature[], dx: number, dy: number): Outcome {
  const edits = new Transaction(draft);
  edits.move(features.map(keyOf), dx, dy);
  return edits.command("Move");
}

/** Moves a point to exact metres. */
export function place(draft: Draft, feature: Feature, x: number, y: number): Outcome {
  const edits = new Transaction(draft);
  edits.place(feature, x, y);
  return edits.command(`Move ${feature.id}`);
}

/** Makes a straight edge so many metres long: its target moves, or its source if `fixed` is the target. */
export function setLength(draft: Draft, edge: Feature, length: number): Outcome {
  if (!(length > 0)) return "A length is more than 0 metres";
  const edits = new Transaction(draft);
  const [source, target] = [edits.endOf(edge, "source"), edits.endOf(edge, "target")];
  if (!source || !target) return "One end of this lane is on another level";
  const [a, b] = [placeOf(source), placeOf(target)];
  const now = distance(a, b);
  if (!now) return "Both ends are at the same place: move one first";
  const [ax = 0, ay = 0, bx = 0, by = 0] = [a[0], a[1], b[0], b[1]];
  edits.place(target, ax + ((bx - ax) / now) * length, ay + ((by - ay) / now) * length);
  return edits.command(`Set the length of ${edge.id}`);
}

/** Splits lanes at a place: both directions get the same new node. */
export function split(draft: Draft, edges: Feature[], at?: Position): Outcome {
  const edits = new Transaction(draft);
  const node = splitInto(edits, edges, at);
  return typeof node === "string" ? node : edits.command("Split");
}

/** Splits lanes inside a transaction and returns the new node. */
export function splitInto(edits: Transaction, edges: Feature[], at?: Position): Feature | string {
  const first = edges.find(isEdge);
  if (!first || first.geometry.type !== "LineString") return "Choose a lane to split";
  const node = edits.addNode(at ?? middleOf(first.geometry.coordinates), first);
  joinInto(edits, node, edges);
  return node;
}

/** Joins a node into lanes: each is split there. */
export function joinInto(edits: Transaction, node: Feature, edges: Feature[]): void {
  const point = placeOf(node) as Position;
  for (const edge of edges) {
    if (edge.geometry.type !== "LineString") continue;
    const [source, target] = [edits.endOf(edge, "source"), edits.endOf(edge, "target")];
    if (!source || !target) continue;
    const line = edge.geometry.coordinates;
    const segment = nearestSegment(line, point);
    const { bends: _, ...properties } = withoutIndex(edge.properties);
    edits.remove(edge);
    if (!edits.edgesBetween(source, node).length) edits.addEdge(source, node, properties, line.slice(1, segment + 1));
    if (!edits.edgesBetween(node, target).length) edits.addEdge(node, target, properties, line.slice(segment + 1, -1));
  }
}

/** Merges nodes into the first: their lanes end there, and lanes between them go. */
export function merge(draft: Draft, nodes: Feature[]): Outcome {
  const edits = new Transaction(draft);
  const [keep, ...others] = nodes.filter(isNode);
  if (!keep || !others.length) return "Choose two nodes or more to merge";
  mergeInto(edits, keep, others);
  return edits.command(`Merge into ${keep.id}`);
}

export function mergeInto(edits: Transaction, keep: Feature, others: Feature[]): void {
  const gone = new Set(others.map(({ id }) => id));
  for (const other of others) {
    for (const edge of edits.edgesOf(other)) {
      const [source, target] = [edits.endOf(edge, "source"), edits.endOf(edge, "target")];
      edits.remove(edge);
      if (!source || !target) continue;
      const [from, to] = [source, target].map((end) => (gone.has(end.id) ? keep : end)) as [Feature, Feature];
      if (from.id === to.id || edits.edgesBetween(from, to).length) continue;
      const line = edge.geometry.type === "LineString" ? edge.geometry.coordinates.slice(1, -1) : [];
      edits.addEdge(from, to, withoutIndex(edge.properties), line);
    }
    edits.remove(other);
  }
}

export function reverse(draft: Draft, edges: Feature[]): Outcome {
  const edits = new Transaction(draft);
  const chosen = new Set(edges.filter(isEdge).map(keyOf));
  if (!chosen.size) return "Choose lanes to reverse";
  let count = 0;
  for (const edge of edges.filter(isEdge)) {
    const twin = draft.twinOf(edge);
    if (twin && chosen.has(keyOf(twin))) continue; // both directions turned are the same street
    if (twin) continue;
    if (edge.geometry.type !== "LineString") continue;
    const [source, target] = [edits.endOf(edge, "source"), edits.endOf(edge, "target")];
    if (!source || !target) continue;
    edits.remove(edge);
    edits.addEdge(target, source, withoutIndex(edge.properties), edge.geometry.coordinates.slice(1, -1).reverse());
    count += 1;
  }
  return count ? edits.command("Reverse") : "A two-way street has no direction: make it one-way first";
}

/** Leaves only the chosen direction of streets. */
export function makeOneWay(draft: Draft, edges: Feature[]): Outcome {
  const edits = new Transaction(draft);
  const done = new Set<string>();
  for (const edge of edges.filter(isEdge)) {
    const twin = draft.twinOf(edge);
    if (!twin || done.has(keyOf(edge))) continue;
    edits.remove(twin);
    done.add(keyOf(twin));
  }
  return done.size ? edits.command("Make one-way") : "These lanes are one-way already";
}

export function makeTwoWay(draft: Draft, edges: Feature[]): Outcome {
  const edits = new Transaction(draft);
  let count = 0;
  for (const edge of edges.filter(isEdge)) {
    if (draft.twinOf(edge) || edge.geometry.type !== "LineString") continue;
    const [source, target] = [edits.endOf(edge, "source"), edits.endOf(edge, "target")];
    if (!source || !target) continue;
    edits.addEdge(target, source, withoutIndex(edge.properties), edge.geometry.coordinates.slice(1, -1).reverse());
    count += 1;
  }
  return count ? edits.command("Make two-way") : "These lanes are two-way already";
}

/** Takes the bends out of lanes; the nodes inside a chain of lanes go onto the line between its ends. */
export function straighten(draft: Draft, edges: Feature[]): Outcome {
  const edits = new Transaction(draft);
  const lanes = edges.filter(isEdge);
  if (!lanes.length) return "Choose lanes to straighten";
  const nodes = nodesOf(draft, lanes);
  if (nodes.length > 2) alignInto(edits, nodes);
  for (const lane of lanes) {
    const now = edits.get(keyOf(lane));
    if (!now || now.geometry.type !== "LineString" || now.geometry.coordinates.length < 3) continue;
    const line = now.geometry.coordinates;
    const { bends: _, ...properties } = now.properties;
    edits.put({
      ...now,
      properties,
      geometry: { type: "LineString", coordinates: [line[0] ?? [], line.at(-1) ?? []] },
    });
  }
  return edits.command("Straighten");
}

/** Puts nodes onto the line through the two that are farthest apart. */
export function align(draft: Draft, features: Feature[]): Outcome {
  const edits = new Transaction(draft);
  const nodes = features.some(isEdge) ? nodesOf(draft, features) : features.filter(isPoint);
  if (nodes.length < 3) return "Choose three nodes or more to put in line";
  alignInto(edits, nodes);
  return edits.command("Align in line");
}

function alignInto(edits: Transaction, nodes: Feature[]): void {
  const ends = farthest(nodes.map(placeOf));
  if (!ends) return;
  for (const node of nodes) {
    const at = placeOf(node);
    if (at === ends[0] || at === ends[1]) continue;
    const [x, y] = projected(at, ...ends);
    edits.place(edits.get(keyOf(node)) ?? node, x, y);
  }
}

/** Spaces nodes evenly along the line through the two that are farthest apart. */
export function distribute(draft: Draft, features: Feature[]): Outcome {
  const edits = new Transaction(draft);
  const nodes = features.some(isEdge) ? nodesOf(draft, features) : features.filter(isPoint);
  const ends = farthest(nodes.map(placeOf));
  if (nodes.length < 3 || !ends) return "Choose three nodes or more to space evenly";
  const [[ax = 0, ay = 0], [bx = 0, by = 0]] = ends;
  const along = (node: Feature) => distance(projected(placeOf(node), ...ends), [ax, ay]);
  const sorted = [...nodes].sort((one, other) => along(one) - along(other));
  sorted.forEach((node, index) => {
    const share = index / (sorted.length - 1);
    edits.place(edits.get(keyOf(node)) ?? node, ax + (bx - ax) * share, ay + (by - ay) * share);
  });
  return edits.command("Space evenly");
}

/** Makes the corners of areas right angles that are nearly so: sides turn to the grid of the longest side. */
export function squareUp(draft: Draft, features: Feature[]): Outcome {
  const edits = new Transaction(draft);
  let count = 0;
  for (const feature of features) {
    const outline = outlinesOf(feature.geometry).find(({ closed }) => closed);
    if (!outline || outline.points.length < 4) continue;
    edits.put({ ...feature, geometry: outline.replace(squared(outline.points)) });
    count += 1;
  }
  return count ? edits.command("Square up") : "Choose an area with four corners or more";
}

function squared(points: number[][]): number[][] {
  const at = (index: number) => points[(index + points.length) % points.length] ?? [];
  const longest = points.reduce((best, point, index) => {
    return distance(point, at(index + 1)) > distance(at(best), at(best + 1)) ? index : best;
  }, 0);
  const [ax = 0, ay = 0] = at(longest);
  const [bx = 0, by = 0] = at(longest + 1);
  const angle = Math.atan2(by - ay, bx - ax);
  const [cos, sin] = [Math.cos(angle), Math.sin(angle)];
  const turned = points.map(([x = 0, y = 0]) => [(x - ax) * cos + (y - ay) * sin, (y - ay) * cos - (x - ax) * sin]);
  const flat = turned.map(([x = 0, y = 0], index) => {
    const [nx = 0, ny = 0] = turned[(index + 1) % turned.length] ?? [];
    return Math.abs(nx - x) >= Math.abs(ny - y);
  });
  // Along a flat side y is shared, along an upright one x: each corner takes the means of its two sides.
  return points.map((point, index) => {
    const previous = (index + points.length - 1) % points.length;
    const [x = 0, y = 0] = turned[index] ?? [];
    const mean = (side: number, axis: 0 | 1) =>
      ((turned[side]?.[axis] ?? 0) + (turned[(side + 1) % turned.length]?.[axis] ?? 0)) / 2;
    const sides = [previous, index];
    const level = sides.find((side) => flat[side]);
    const upright = sides.find((side) => !flat[side]);
    const [u, v] = [upright === undefined ? x : mean(upright, 0), level === undefined ? y : mean(level, 1)];
    return movedTo(point, ax + u * cos - v * sin, ay + u * sin + v * cos);
  });
}

/** Sets a property of all features; undefined removes it. */
export function setProperty(draft: Draft, features: Feature[], name: string, value: unknown): Outcome {
  if (!name) return "Give the property a name";
  if (["kind", "source", "target"].includes(name) && features.some(({ layer }) => layer === "topology"))
    return `“${name}” of a network says how it is connected: use the tools for it`;
  const edits = new Transaction(draft);
  for (const feature of features) {
    const { [name]: _, ...others } = feature.properties;
    edits.put({ ...feature, properties: value === undefined ? others : { ...others, [name]: value } });
  }
  return edits.command(value === undefined ? `Remove ${name}` : `Set ${name}`);
}

/** Copies nodes with the lanes between them, objects and zones, moved by some metres. */
export function paste(draft: Draft, copied: Feature[], dx: number, dy: number, level: string): Outcome & object {
  const edits = new Transaction(draft);
  const nodes = new Map<string, Feature>();
  for (const feature of copied) {
    if (isEdge(feature)) continue;
    const prefix = isNode(feature) ? "n" : feature.layer === "zones" ? "zone" : "object";
    const copy = { ...feature, level, id: edits.freshId(prefix), properties: withoutIndex(feature.properties) };
    edits.put(copy);
    edits.move([keyOf(copy)], dx, dy);
    const now = edits.get(keyOf(copy));
    if (now && isNode(feature)) nodes.set(feature.id, now);
  }
  for (const edge of copied.filter(isEdge)) {
    const [source, target] = [nodes.get(String(edge.properties.source)), nodes.get(String(edge.properties.target))];
    if (!source || !target || edge.geometry.type !== "LineString") continue;
    const inner = edge.geometry.coordinates.slice(1, -1).map((at) => movedTo(at, (at[0] ?? 0) + dx, (at[1] ?? 0) + dy));
    edits.addEdge(source, target, withoutIndex(edge.properties), inner);
  }
  return edits.command("Paste");
}

export function nodesOf(draft: Draft, features: Feature[]): Feature[] {
  const out = new Map<string, Feature>();
  for (const feature of features) {
    if (isNode(feature)) out.set(keyOf(feature), feature);
    if (!isEdge(feature)) continue;
    for (const end of ["source", "target"] as const) {
      const node = draft.endOf(feature, end);
      if (node) out.set(keyOf(node), node);
    }
  }
  return [...out.values()];
}

function isPoint(feature: Feature): boolean {
  return feature.geometry.type === "Point";
}

export function middleOf(line: number[][]): Position {
  const total = linesOf({ type: "LineString", coordinates: line }).reduce(
    (sum, points) =>
      sum + points.slice(1).reduce((part, point, index) => part + distance(points[index] ?? [], point), 0),
    0,
  );
  let left = total / 2;
  for (let index = 1; index < line.length; index++) {
    const [a, b] = [line[index - 1] ?? [], line[index] ?? []];
    const length = distance(a, b);
    if (left <= length && length > 0) {
      const share = left / length;
      return [
        round((a[0] ?? 0) + ((b[0] ?? 0) - (a[0] ?? 0)) * share),
        round((a[1] ?? 0) + ((b[1] ?? 0) - (a[1] ?? 0)) * share),
      ];
    }
    left -= length;
  }
  return pointsOf({ type: "Point", coordinates: line[0] ?? [0, 0] })[0] as Position;
}

function nearestSegment(line: number[][], point: Position): number {
  let [best, at] = [Infinity, 0];
  for (let index = 1; index < line.length; index++) {
    const { distance: off } = nearestOnSegment(line[index - 1] as Position, line[index] as Position, point);
    if (off < best) [best, at] = [off, index - 1];
  }
  return at;
}

/** Returns properties for another feature: a format's running number belongs to the old one. */
function withoutIndex(properties: Record<string, unknown>): Record<string, unknown> {
  return Object.fromEntries(
    Object.entries(properties).map(([name, value]) => {
      if (typeof value !== "object" || value === null || Array.isArray(value) || !("index" in value))
        return [name, value];
      const { index: _, ...others } = value as Record<string, unknown>;
      return [name, others];
    }),
  );
}
