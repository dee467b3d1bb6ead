/** Where a pointer's place snaps to: nodes, edges, 45° and a grid of metres. */
import { type Feature, linesOf, nearestOnSegment, type Position, pointsOf } from "../../map/features";
import { keyOf } from "./draft";
import { distance } from "./geometry";

export interface SnapOptions {
  nodes: boolean;
  edges: boolean;
  angles: boolean;
  grid: boolean;
  /** Metres between the lines of the grid. */
  step: number;
}

export interface Snapped {
  at: Position;
  kind: "node" | "edge" | "vertex" | "angle" | "grid" | "free";
  /** The node or edge it lies on. */
  feature?: Feature;
}

interface Around {
  /** Features near the place, from the map's index. */
  near: readonly Feature[];
  /** Metres within which something attracts. */
  reach: number;
  /** The last place, from which directions count; and the direction in which it was reached. */
  from?: Position;
  before?: Position;
  /** Features that do not attract, because they are being moved. */
  without?: ReadonlySet<string>;
}

export function snap(at: Position, options: SnapOptions, around: Around): Snapped {
  const near = around.near.filter((feature) => !around.without?.has(keyOf(feature)));
  if (options.nodes) {
    const node = nearestPoint(at, near, around.reach * 1.2);
    if (node) return node;
  }
  const direction = options.angles ? alongAngle(at, around) : null;
  if (options.edges) {
    const edge = nearestLine(at, near, around.reach);
    if (edge) return edge;
  }
  if (direction) return { at: options.grid ? stepped(direction, around.from, options.step) : direction, kind: "angle" };
  if (options.grid && options.step > 0) {
    return { at: [toStep(at[0], options.step), toStep(at[1], options.step)], kind: "grid" };
  }
  return { at, kind: "free" };
}

function nearestPoint(at: Position, near: readonly Feature[], reach: number): Snapped | null {
  let best: Snapped | null = null;
  let least = reach;
  for (const feature of near) {
    for (const point of pointsOf(feature.geometry)) {
      const off = distance(at, point);
      if (off > least) continue;
      least = off;
      best = { at: [point[0] ?? 0, point[1] ?? 0], kind: "node", feature };
    }
    if (feature.properties.kind === "edge") continue;
    for (const line of linesOf(feature.geometry)) {
      for (const point of line) {
        const off = distance(at, point);
        if (off >= least) continue;
        least = off;
        best = { at: [point[0] ?? 0, point[1] ?? 0], kind: "vertex", feature };
      }
    }
  }
  return best;
}

function nearestLine(at: Position, near: readonly Feature[], reach: number): Snapped | null {
  let best: Snapped | null = null;
  let least = reach;
  for (const feature of near) {
    for (const line of linesOf(feature.geometry)) {
      for (let index = 1; index < line.length; index++) {
        const found = nearestOnSegment(line[index - 1] as Position, line[index] as Position, at);
        if (found.distance > least) continue;
        least = found.distance;
        best = { at: found.at, kind: "edge", feature };
      }
    }
  }
  return best;
}

/** Returns the place on the nearest multiple of 45° from the last place, relative to the axes or the last leg. */
function alongAngle(at: Position, { from, before, reach }: Around): Position | null {
  if (!from) return null;
  const length = distance(from, at);
  if (length < reach) return null;
  const angle = Math.atan2(at[1] - from[1], at[0] - from[0]);
  const zeros = [0];
  if (before && distance(before, from) > 0) zeros.push(Math.atan2(from[1] - before[1], from[0] - before[0]));
  let best: Position | null = null;
  let least = reach;
  for (const zero of zeros) {
    const wanted = zero + (Math.round((angle - zero) / (Math.PI / 4)) * Math.PI) / 4;
    const off = Math.abs(Math.sin(angle - wanted)) * length;
    if (off >= least) continue;
    least = off;
    const along = Math.cos(angle - wanted) * length;
    best = [from[0] + Math.cos(wanted) * along, from[1] + Math.sin(wanted) * along];
  }
  return best;
}

/** Rounds the distance from the last place to steps of the grid. */
function stepped(at: Position, from: Position | undefined, step: number): Position {
  if (!from || !(step > 0)) return at;
  const length = distance(from, at);
  const rounded = Math.max(step, toStep(length, step));
  return [from[0] + ((at[0] - from[0]) / length) * rounded, from[1] + ((at[1] - from[1]) / length) * rounded];
}

function toStep(value: number, step: number): number {
  return Math.round(value / step) * step;
}
