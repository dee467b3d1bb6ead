/** Select, move, merge by dropping, drag corners. */
import {
  type Box,
  boxOf,
  distanceTo,
  type Feature,
  isArea,
  linesOf,
  type Position,
  pointsOf,
} from "../../../map/features";
import { isHidden } from "../../../map/site-map";
import { type Command, isEdge, isNode, keyOf } from "../draft";
import { closed, crossesItself, distance, movedTo, outlinesOf } from "../geometry";
import { joinInto, mergeInto } from "../operations";
import { type Handle, handlesOf, mark, marksOf } from "../sketch";
import type { Snapped } from "../snap";
import { Transaction } from "../transaction";
import { type Press, Tool } from "./tool";

type Drag =
  | { kind: "box"; from: Position }
  | { kind: "move"; from: Position; anchor: Position; keys: string[]; without: Set<string>; node: Feature | null }
  | { kind: "handle"; from: Position; feature: Feature; handle: Handle };

export class SelectTool extends Tool {
  private taken: Drag | null = null;
  private started = false;
  private offset: Position = [0, 0];
  private onto: Snapped | null = null;

  override down(press: Press): boolean {
    const { editor } = this;
    this.started = false;
    this.taken = null;
    const selected = editor.selected.peek();
    const handle = nearestHandle(selected, press);
    const feature = selected[0];
    const nodeHit = press.hits.find(isNode);
    if (handle && feature && !(nodeHit && handle.middle)) {
      this.taken = { kind: "handle", from: press.at, feature, handle };
      return true;
    }
    if (press.shift || editor.options.peek().box) {
      this.taken = { kind: "box", from: press.at };
      return true;
    }
    const chosen = editor.selection.peek();
    const grip =
      press.hits.find((hit) => chosen.has(keyOf(hit)) && this.isGrip(hit, press)) ??
      (press.touch ? undefined : press.hits.find((hit) => hit.layer === "topology" || !isArea(hit.geometry)));
    if (!grip) return false;
    const keys = chosen.has(keyOf(grip)) ? [...chosen] : editor.wholeOf(grip);
    const node = isNode(grip) ? grip : null;
    const anchor = (pointsOf(grip.geometry)[0] as Position | undefined) ?? press.at;
    this.taken = { kind: "move", from: press.at, anchor, keys, without: new Set(keys), node };
    return true;
  }

  /** Large areas are taken at their outline only: inside, the map is moved. */
  private isGrip(feature: Feature, press: Press): boolean {
    if (!isArea(feature.geometry)) return true;
    const [a, b, c, d] = boxOf(feature.geometry);
    const [width = 0, height = 0] = this.context.map.map.getSize() ?? [];
    const pixel = this.context.map.resolution.peek();
    const isLarge = c - a > (width * pixel) / 2 || d - b > (height * pixel) / 2;
    if (!isLarge && feature.layer !== "location") return true;
    return linesOf(feature.geometry).some(
      (line) => distanceTo({ type: "LineString", coordinates: line }, press.at) <= press.reach,
    );
  }

  override drag(press: Press): void {
    const drag = this.taken;
    if (!drag) return;
    if (!this.started) this.start(drag);
    if (drag.kind === "box") {
      this.context.sketch.marks.value = [mark("area", boxGeometry(drag.from, press.at))];
    } else if (drag.kind === "move") this.dragFeatures(drag, press);
    else this.dragHandle(drag, press);
  }

  private start(drag: Drag): void {
    this.started = true;
    this.onto = null;
    const { editor, sketch, map } = this.context;
    if (drag.kind === "box") return;
    sketch.hidden.value = true;
    if (drag.kind === "handle") {
      map.hideFeatures(editor.selected.peek().map(({ id }) => id));
      return;
    }
    if (drag.keys.some((key) => !editor.selection.peek().has(key))) editor.select(drag.keys);
    const edits = new Transaction(editor.draft);
    edits.move(drag.keys, 0, 0);
    const touched = edits.edits();
    drag.without = new Set(touched.map(({ key }) => key));
    map.hideFeatures(touched.map(({ to, from }) => (to ?? from)?.id ?? ""));
  }

  private dragFeatures(drag: Drag & { kind: "move" }, press: Press): void {
    const raw: Position = [drag.anchor[0] + press.at[0] - drag.from[0], drag.anchor[1] + press.at[1] - drag.from[1]];
    const snapped = this.snap({ ...press, at: raw }, { without: drag.without });
    this.onto = snapped;
    this.offset = [snapped.at[0] - drag.anchor[0], snapped.at[1] - drag.anchor[1]];
    const edits = new Transaction(this.editor.draft);
    edits.move(drag.keys, ...this.offset);
    const joined = this.joined(drag)[0];
    const lane = joined ? [mark("edge", joined.geometry)] : [];
    this.context.sketch.marks.value = [...lane, ...drawn(edits.edits().map(({ to }) => to)), ...marksOf(snapped)];
  }

  /** The lanes that a node is dropped onto: a street is both of its directions. */
  private joined({ node, keys }: Drag & { kind: "move" }): Feature[] {
    const lane = this.onto?.kind === "edge" ? this.onto.feature : undefined;
    if (!node || keys.length > 1 || !isEdge(lane) || lane.part !== node.part) return [];
    const { draft } = this.editor;
    return this.editor
      .wholeOf(lane)
      .map((key) => draft.get(key))
      .filter((one) => one !== undefined);
  }

  private dragHandle(drag: Drag & { kind: "handle" }, press: Press): void {
    const whole = new Set(this.editor.selection.peek());
    const before = neighbour(drag);
    const snapped = this.snap(press, { without: whole, from: before });
    this.onto = snapped;
    const edits = this.withHandle(drag, snapped.at);
    this.context.sketch.marks.value = [...drawn(edits.edits().map(({ to }) => to)), ...marksOf(snapped)];
  }

  private withHandle({ feature, handle }: Drag & { kind: "handle" }, at: Position): Transaction {
    const edits = new Transaction(this.editor.draft);
    putVertex(edits, feature, handle, at);
    const twin =
      isEdge(feature) && this.editor.selection.peek().size > 1 ? this.editor.draft.twinOf(feature) : undefined;
    if (twin) {
      const count = outlinesOf(feature.geometry)[0]?.points.length ?? 0;
      const index = handle.middle ? count - handle.index : count - 1 - handle.index;
      if (outlinesOf(twin.geometry)[0]?.points.length === count) putVertex(edits, twin, { ...handle, index }, at);
    }
    return edits;
  }

  override drop(press: Press): void {
    const drag = this.taken;
    const wasStarted = this.started;
    this.end();
    if (!drag || !wasStarted) return;
    if (drag.kind === "box") this.selectBox(drag.from, press);
    else if (drag.kind === "move") this.dropFeatures(drag);
    else this.dropHandle(drag);
  }

  private dropFeatures(drag: Drag & { kind: "move" }): void {
    const { editor } = this;
    const edits = new Transaction(editor.draft);
    edits.move(drag.keys, ...this.offset);
    const target = this.onto?.kind === "node" && isNode(this.onto.feature) ? this.onto.feature : null;
    const dragged = drag.node && edits.get(keyOf(drag.node));
    if (target && dragged && drag.keys.length === 1) {
      mergeInto(edits, target, [dragged]);
      editor.run(edits.command(`Merge ${dragged.id} into ${target.id}`), [keyOf(target)]);
      return;
    }
    const lanes = this.joined(drag);
    if (dragged && lanes[0]) {
      joinInto(edits, dragged, lanes);
      const { source, target } = lanes[0].properties;
      editor.run(edits.command(`Join ${dragged.id} into ${String(source)} – ${String(target)}`));
      return;
    }
    const count = drag.keys.length;
    const name = editor.draft.get(drag.keys[0] ?? "")?.id;
    editor.run(edits.command(count === 1 ? `Move ${name}` : `Move ${count} features`));
  }

  private dropHandle(drag: Drag & { kind: "handle" }): void {
    if (!this.onto) return;
    const edits = this.withHandle(drag, this.onto.at);
    const now = edits.get(keyOf(drag.feature));
    const ring = now && outlinesOf(now.geometry)[drag.handle.outline];
    if (ring?.closed && crossesItself(ring.points)) {
      this.editor.run("The outline would cross itself: the corner stays where it was");
      return;
    }
    if (this.editor.run(edits.command(`Move a corner of ${drag.feature.id}`)))
      this.editor.vertex.value = { key: keyOf(drag.feature), outline: drag.handle.outline, index: drag.handle.index };
  }

  private selectBox(from: Position, press: Press): void {
    const [a, b] = [press.at, from];
    const box: Box = [Math.min(a[0], b[0]), Math.min(a[1], b[1]), Math.max(a[0], b[0]), Math.max(a[1], b[1])];
    const inside = this.context.map.index.inBox(box).filter((feature) => {
      const own = boxOf(feature.geometry);
      const isWhole = own[0] >= box[0] && own[1] >= box[1] && own[2] <= box[2] && own[3] <= box[3];
      return isWhole && feature.layer !== "location" && !isHidden(feature.layer);
    });
    this.editor.select(inside.map(keyOf), { add: press.adds });
    this.editor.set({ box: false });
  }

  private end(): void {
    this.taken = null;
    this.started = false;
    const { sketch, map } = this.context;
    sketch.marks.value = [];
    sketch.hidden.value = false;
    map.hideFeatures([]);
  }

  override click(press: Press): void {
    const { editor } = this;
    const handle = nearestHandle(editor.selected.peek(), press);
    const feature = editor.selected.peek()[0];
    if (handle && !handle.middle && feature) {
      editor.vertex.value = { key: keyOf(feature), outline: handle.outline, index: handle.index };
      return;
    }
    const chosen = editor.selection.peek();
    const at = press.free ? press.hits.findIndex((hit) => chosen.has(keyOf(hit))) + 1 : 0;
    const hit = press.hits[at % Math.max(1, press.hits.length)];
    if (hit) editor.select(editor.wholeOf(hit), { toggle: press.adds });
    else if (!press.adds) editor.select([]);
  }

  override cancel(): boolean {
    if (!this.taken) return false;
    this.end();
    return true;
  }
}

/** Removes the chosen corner of an area or bend of a lane; null: none is chosen, or too few would be left. */
export function withoutVertex(features: Feature[], edits: Transaction, outline: number, index: number): Command | null {
  const feature = features[0];
  const line = feature && outlinesOf(feature.geometry)[outline];
  if (!feature || !line || line.points.length <= (line.closed ? 3 : 2)) return null;
  const removed = line.points[index];
  for (const one of features) {
    const own = outlinesOf(one.geometry)[outline];
    if (!own || !removed) continue;
    const points = own.points.filter((at) => distance(at, removed) > 1e-9);
    const { bends: _, ...properties } = one.properties;
    edits.put({ ...one, properties: isEdge(one) ? properties : one.properties, geometry: own.replace(points) });
  }
  return edits.command(`Remove a corner of ${feature.id}`);
}

function putVertex(edits: Transaction, feature: Feature, handle: Handle, at: Position): void {
  const outline = outlinesOf(feature.geometry)[handle.outline];
  if (!outline) return;
  const points = [...outline.points];
  const old = handle.middle ? (points[handle.index - 1] ?? []).slice(0, 2) : (points[handle.index] ?? []);
  points.splice(handle.index, handle.middle ? 0 : 1, movedTo(old, ...at));
  const { bends: _, ...properties } = feature.properties;
  const kept = isEdge(feature) && handle.middle ? properties : feature.properties;
  edits.put({ ...feature, properties: kept, geometry: outline.replace(points) });
}

function neighbour({ feature, handle }: Drag & { kind: "handle" }): Position | undefined {
  const points = outlinesOf(feature.geometry)[handle.outline]?.points ?? [];
  return points[(handle.index - 1 + points.length) % points.length] as Position | undefined;
}

function nearestHandle(features: readonly Feature[], press: Press): Handle | null {
  let best: Handle | null = null;
  let least = press.reach;
  for (const handle of handlesOf(features)) {
    const off = distance(handle.at, press.at) * (handle.middle ? 1.5 : 1);
    if (off < least) [best, least] = [handle, off];
  }
  return best;
}

/** Draws features that are being moved. */
export function drawn(features: readonly (Feature | null)[]): Feature[] {
  return features
    .filter((feature) => feature !== null)
    .map((feature) => mark(isNode(feature) ? "node" : isEdge(feature) ? "edge" : "area", feature.geometry, feature.id));
}

function boxGeometry(a: Position, b: Position) {
  const ring = closed([
    [a[0], a[1]],
    [b[0], a[1]],
    [b[0], b[1]],
    [a[0], b[1]],
  ]);
  return { type: "Polygon" as const, coordinates: [ring] };
}
