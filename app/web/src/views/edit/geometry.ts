/** Plane geometry of edits, in local metres. */
import type { Geometry, Position } from "../../map/features";

export type Ring = number[][];

/** Rounds to what the server stores: a nanometre. */
export function round(value: number): number {
  return Math.round(value * 1e9) / 1e9;
}

export function distance(a: readonly number[], b: readonly number[]): number {
  return Math.hypot((b[0] ?? 0) - (a[0] ?? 0), (b[1] ?? 0) - (a[1] ?? 0));
}

/** Returns a position moved to x, y; a height stays. */
export function movedTo(position: readonly number[], x: number, y: number): number[] {
  return [round(x), round(y), ...position.slice(2)];
}

/** Changes all positions of a geometry; a closed ring stays closed. */
export function mapPositions(geometry: Geometry, change: (position: number[]) => number[]): Geometry {
  if (geometry.type === "GeometryCollection") {
    return { type: geometry.type, geometries: geometry.geometries.map((one) => mapPositions(one, change)) };
  }
  const walk = (value: unknown): unknown => {
    const list = value as number[] | unknown[];
    return typeof list[0] === "number" ? change(list as number[]) : list.map(walk);
  };
  return { type: geometry.type, coordinates: walk(geometry.coordinates) } as Geometry;
}

export function translate(geometry: Geometry, dx: number, dy: number): Geometry {
  return mapPositions(geometry, (at) => movedTo(at, (at[0] ?? 0) + dx, (at[1] ?? 0) + dy));
}

/** A line or ring of a geometry whose vertices can be moved one by one. */
export interface Outline {
  points: number[][];
  closed: boolean;
  /** Returns the geometry with other vertices. */
  replace: (points: number[][]) => Geometry;
}

/** Lists the lines and rings of a geometry; rings without their repeated last vertex. */
export function outlinesOf(geometry: Geometry): Outline[] {
  if (geometry.type === "LineString") {
    return [
      {
        points: geometry.coordinates,
        closed: false,
        replace: (points) => ({ type: "LineString", coordinates: points }),
      },
    ];
  }
  if (geometry.type !== "Polygon") return [];
  return geometry.coordinates.map((ring, index) => ({
    points: ring.slice(0, -1),
    closed: true,
    replace: (points) => ({
      type: "Polygon",
      coordinates: geometry.coordinates.map((other, at) => (at === index ? closed(points) : other)),
    }),
  }));
}

export function closed(points: number[][]): number[][] {
  return points[0] ? [...points, points[0]] : points;
}

/** Returns the foot of a point on the line through two others. */
export function projected(point: readonly number[], a: readonly number[], b: readonly number[]): Position {
  const [ax = 0, ay = 0] = a;
  const [dx, dy] = [(b[0] ?? 0) - ax, (b[1] ?? 0) - ay];
  const squared = dx * dx + dy * dy;
  if (!squared) return [ax, ay];
  const share = (((point[0] ?? 0) - ax) * dx + ((point[1] ?? 0) - ay) * dy) / squared;
  return [ax + share * dx, ay + share * dy];
}

/** Returns the two points that are farthest apart. Many points: those at the ends of the main directions. */
export function farthest<T extends readonly number[]>(points: readonly T[]): [T, T] | null {
  const first = points[0];
  if (!first || points.length < 2) return null;
  const candidates = points.length <= 200 ? points : extremes(points);
  let best: [T, T] = [first, points[1] ?? first];
  let reach = -1;
  for (const a of candidates) {
    for (const b of candidates) {
      const length = distance(a, b);
      if (length > reach) [reach, best] = [length, [a, b]];
    }
  }
  return best;
}

function extremes<T extends readonly number[]>(points: readonly T[]): T[] {
  return Array.from({ length: 16 }, (_, index) => {
    const angle = (index / 16) * 2 * Math.PI;
    const along = (point: T) => (point[0] ?? 0) * Math.cos(angle) + (point[1] ?? 0) * Math.sin(angle);
    return points.reduce((best, point) => (along(point) > along(best) ? point : best));
  });
}

/** Whether a ring (without its repeated last vertex) crosses itself. */
export function crossesItself(ring: readonly (readonly number[])[]): boolean {
  const count = ring.length;
  for (let i = 0; i < count; i++) {
    for (let j = i + 1; j < count; j++) {
      const areNeighbours = j === i + 1 || (i === 0 && j === count - 1);
      if (areNeighbours) continue;
      if (cross(ring[i], ring[(i + 1) % count], ring[j], ring[(j + 1) % count])) return true;
    }
  }
  return false;
}

type Point = readonly number[] | undefined;

function cross(a: Point, b: Point, c: Point, d: Point): boolean {
  if (!a || !b || !c || !d) return false;
  return side(a, b, c) * side(a, b, d) <= 0 && side(c, d, a) * side(c, d, b) <= 0;
}

function side(a: readonly number[], b: readonly number[], c: readonly number[]): number {
  const [ax = 0, ay = 0] = a;
  return Math.sign(((b[0] ?? 0) - ax) * ((c[1] ?? 0) - ay) - ((b[1] ?? 0) - ay) * ((c[0] ?? 0) - ax));
}

export function areaOf(ring: readonly (readonly number[])[]): number {
  let sum = 0;
  ring.forEach(([x = 0, y = 0], index) => {
    const [nx = 0, ny = 0] = ring[(index + 1) % ring.length] ?? [];
    sum += x * ny - nx * y;
  });
  return Math.abs(sum / 2);
}

export function lengthOf(line: readonly (readonly number[])[]): number {
  return line.slice(1).reduce((sum, point, index) => sum + distance(line[index] ?? point, point), 0);
}

/** Returns the area within `radius` of a segment: what a round brush covers between two places. */
export function capsule(a: Position, b: Position, radius: number, steps = 10): Ring {
  const along = Math.atan2(b[1] - a[1], b[0] - a[0]);
  const ring: number[][] = [];
  for (const [centre, turn] of [
    [b, along - Math.PI / 2],
    [a, along + Math.PI / 2],
  ] as const) {
    for (let step = 0; step <= steps; step++) {
      const angle = turn + (step / steps) * Math.PI;
      ring.push([round(centre[0] + radius * Math.cos(angle)), round(centre[1] + radius * Math.sin(angle))]);
    }
  }
  const distinct = ring.filter((point, index) => index === 0 || distance(point, ring[index - 1] ?? []) > 1e-6);
  if (distance(distinct[0] ?? [], distinct.at(-1) ?? []) <= 1e-6) distinct.pop();
  return closed(distinct);
}

/** Leaves out the points of a line that change it by less than a tolerance (Douglas and Peucker). */
export function simplified(line: Position[], tolerance: number): Position[] {
  const keep = new Set([0, line.length - 1]);
  const stack: [number, number][] = [[0, line.length - 1]];
  for (let span = stack.pop(); span; span = stack.pop()) {
    const [from, to] = span;
    const [a, b] = [line[from], line[to]];
    if (!a || !b) continue;
    let [worst, at] = [tolerance, -1];
    for (let index = from + 1; index < to; index++) {
      const point = line[index];
      if (!point) continue;
      const off = distance(a, b) < 1e-9 ? distance(point, a) : offSegment(point, a, b);
      if (off > worst) [worst, at] = [off, index];
    }
    if (at > 0) {
      keep.add(at);
      stack.push([from, at], [at, to]);
    }
  }
  return line.filter((_, index) => keep.has(index));
}

function offSegment(point: Position, a: Position, b: Position): number {
  const length = distance(a, b);
  const share = ((point[0] - a[0]) * (b[0] - a[0]) + (point[1] - a[1]) * (b[1] - a[1])) / (length * length);
  const limited = Math.max(0, Math.min(1, share));
  return distance(point, [a[0] + limited * (b[0] - a[0]), a[1] + limited * (b[1] - a[1])]);
}
