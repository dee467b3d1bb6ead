/** Features drawn by class: all lines of a class are one path, so that ten thousand cost as much as ten. */
import { apply } from "ol/transform";
import { centreOf, type Feature, type Geometry, isArea, isIn, linesOf, pointsOf } from "./features";
import { writeNames } from "./names";
import { PaintedLayer, type PaintedView } from "./painted";

/** How a class of features is drawn. Sizes are in CSS pixels. */
export interface Paint {
  stroke?: string;
  width?: number;
  dash?: number[];
  fill?: string;
  /** Diameter of points. */
  dot?: number;
  /** Colour of points; default: that of lines. */
  dotColour?: string;
  /** Sign of points for those who cannot tell colours: drawn at any zoom. */
  sign?: "plus" | "cross" | "triangle" | "square" | "ring";
  /** Colour of a rim around lines, so that they are seen on pictures. */
  rim?: string;
  arrows?: boolean;
  labels?: boolean;
  /** Coarsest resolution, in metres per pixel, at which points are drawn. Default: any. */
  dotsBelow?: number;
}

export interface FeatureStyle {
  /** Name of a feature's class; empty: not drawn. */
  classOf: (feature: Feature) => string;
  /** Classes in the order in which they are drawn. Called at each painting, so that a theme may change. */
  paints: () => Record<string, Paint>;
}

interface Paths {
  lines: Path2D;
  areas: Path2D;
  dots: Path2D;
  hasLines: boolean;
  hasAreas: boolean;
  hasDots: boolean;
}

/** Some features of a class: what hides one of them traces only these anew. */
interface Chunk extends Paths {
  features: Feature[];
}

interface Group extends Chunk {
  chunks: Chunk[];
}

const CHUNK = 1000;
const ARROW = 5;
const MIN_ARROW_EDGE = 22;
const MAX_ARROWS = 3000;

export class FeatureLayer extends PaintedLayer {
  private groups = new Map<string, Group>();
  /** Paths are float32: they are drawn from here, so that millimetres last. */
  private anchor: [number, number] = [0, 0];
  private hidden = new Set<string>();
  /** Whether another layer writes the names, above this one. */
  isNamedAbove = false;

  constructor(
    private readonly style: FeatureStyle,
    zIndex: number,
  ) {
    super({ zIndex });
  }

  /** Returns the features in a view whose names are written. */
  named(view: PaintedView): Feature[] {
    return Object.entries(this.style.paints()).flatMap(([name, paint]) => {
      if (!paint.labels || !isNear(paint, view)) return [];
      const features = this.groups.get(name)?.features ?? [];
      return features.filter(({ geometry }) => isIn(view.extent, ...centreOf(geometry)));
    });
  }

  setFeatures(features: readonly Feature[]): void {
    this.groups = new Map();
    const first = features[0];
    this.anchor = first ? centreOf(first.geometry) : [0, 0];
    this.redo(this.place(features));
  }

  /** Draws some features no more, and others too: this costs less than setting all anew. */
  change(removed: ReadonlySet<Feature>, added: readonly Feature[]): void {
    if (!removed.size && !added.length) return;
    if (this.isEmpty()) {
      this.setFeatures(added);
      return;
    }
    const touched = new Set<Chunk>();
    for (const { chunks } of this.groups.values()) {
      for (const chunk of removed.size ? chunks : []) {
        const left = chunk.features.filter((feature) => !removed.has(feature));
        if (left.length === chunk.features.length) continue;
        chunk.features = left;
        touched.add(chunk);
      }
    }
    for (const chunk of this.place(added)) touched.add(chunk);
    this.redo(touched);
  }

  /** Leaves features out, because something else draws them (while they are dragged). */
  hide(ids: Iterable<string>): void {
    const before = this.hidden;
    this.hidden = new Set(ids);
    if (!before.size && !this.hidden.size) return;
    const touched = [...this.groups.values()].flatMap(({ chunks }) =>
      chunks.filter(({ features }) => features.some(({ id }) => before.has(id) !== this.hidden.has(id))),
    );
    this.redo(new Set(touched));
  }

  protected override isEmpty(): boolean {
    return [...this.groups.values()].every(({ chunks }) => chunks.every(({ features }) => !features.length));
  }

  /** Puts features into the chunks of their classes, and returns these. */
  private place(features: readonly Feature[]): Set<Chunk> {
    const touched = new Set<Chunk>();
    for (const feature of features) {
      const name = this.style.classOf(feature);
      if (!name) continue;
      const group = this.groups.get(name) ?? { ...newPaths(), features: [], chunks: [] };
      this.groups.set(name, group);
      let chunk = group.chunks.at(-1);
      if (!chunk || chunk.features.length >= CHUNK) {
        chunk = { ...newPaths(), features: [] };
        group.chunks.push(chunk);
      }
      chunk.features.push(feature);
      touched.add(chunk);
    }
    return touched;
  }

  /** Traces chunks anew. */
  private redo(touched: ReadonlySet<Chunk>): void {
    for (const chunk of touched) this.trace(chunk);
    for (const group of this.groups.values()) {
      if (group.chunks.some((chunk) => touched.has(chunk))) this.compose(group);
    }
    this.repaint();
  }

  /** Puts the features of a chunk into its paths. */
  private trace(chunk: Chunk): void {
    const [x0, y0] = this.anchor;
    Object.assign(chunk, newPaths());
    for (const feature of chunk.features) {
      if (this.hidden.has(feature.id)) continue;
      const isFilled = isArea(feature.geometry);
      const lines = isFilled ? wound(feature.geometry) : linesOf(feature.geometry);
      for (const line of lines) {
        const path = isFilled ? chunk.areas : chunk.lines;
        if (isFilled) chunk.hasAreas = true;
        else chunk.hasLines = true;
        line.forEach(([x = 0, y = 0], index) => {
          if (index) path.lineTo(x - x0, y - y0);
          else path.moveTo(x - x0, y - y0);
        });
        if (isFilled) path.closePath();
      }
      for (const [x = 0, y = 0] of pointsOf(feature.geometry)) {
        chunk.hasDots = true;
        chunk.dots.moveTo(x - x0, y - y0);
        chunk.dots.lineTo(x - x0 + 1e-3, y - y0); // a line of no length would not be drawn
      }
    }
  }

  /** Joins the chunks of a class: it is drawn at once. */
  private compose(group: Group): void {
    Object.assign(group, newPaths());
    group.features = group.chunks.flatMap(({ features }) =>
      this.hidden.size ? features.filter(({ id }) => !this.hidden.has(id)) : features,
    );
    for (const chunk of group.chunks) {
      if (chunk.hasLines) group.lines.addPath(chunk.lines);
      if (chunk.hasAreas) group.areas.addPath(chunk.areas);
      if (chunk.hasDots) group.dots.addPath(chunk.dots);
      group.hasLines ||= chunk.hasLines;
      group.hasAreas ||= chunk.hasAreas;
      group.hasDots ||= chunk.hasDots;
    }
  }

  protected override paint(context: CanvasRenderingContext2D, view: PaintedView): void {
    const pixel = view.resolution; // metres in a CSS pixel
    const paints = this.style.paints();
    context.lineJoin = "round";
    for (const [name, paint] of Object.entries(paints)) {
      const group = this.groups.get(name);
      if (!group) continue;
      this.toLocal(context, view);
      context.setLineDash((paint.dash ?? []).map((length) => length * pixel));
      context.lineCap = "butt";
      context.lineWidth = (paint.width ?? 1) * pixel;
      if (group.hasAreas && paint.fill) {
        context.fillStyle = paint.fill;
        context.fill(group.areas);
      }
      if (paint.rim && group.hasLines) {
        context.strokeStyle = paint.rim;
        context.lineWidth = ((paint.width ?? 1) + 2) * pixel;
        context.stroke(group.lines);
        context.lineWidth = (paint.width ?? 1) * pixel;
      }
      if (paint.stroke) {
        context.strokeStyle = paint.stroke;
        if (group.hasAreas) context.stroke(group.areas);
        if (group.hasLines) context.stroke(group.lines);
      }
      context.setLineDash([]);
      if (paint.arrows && group.hasLines) this.drawArrows(context, view, group, paint);
      if (group.hasDots && paint.dot && isNear(paint, view)) {
        context.lineCap = "round";
        context.lineWidth = paint.dot * pixel;
        context.strokeStyle = paint.dotColour ?? paint.stroke ?? "#000";
        context.stroke(group.dots);
      }
      if (paint.sign) this.drawSigns(context, view, group, paint);
    }
    context.setTransform(1, 0, 0, 1, 0, 0);
    if (!this.isNamedAbove) writeNames(context, view, this.named(view));
  }

  private toLocal(context: CanvasRenderingContext2D, view: PaintedView): void {
    const [a = 1, b = 0, c = 0, d = 1] = view.transform;
    const [x, y] = apply(view.transform, [...this.anchor]);
    context.setTransform(a, b, c, d, x ?? 0, y ?? 0);
  }

  private drawArrows(context: CanvasRenderingContext2D, view: PaintedView, group: Group, paint: Paint): void {
    const pixel = view.resolution;
    const size = ARROW * pixel;
    const [x0, y0] = this.anchor;
    const path = new Path2D();
    let count = 0;
    for (const feature of group.features) {
      if (count > MAX_ARROWS) break;
      for (const line of linesOf(feature.geometry)) {
        const end = line.at(-1);
        const start = line.at(-2);
        if (!end || !start) continue;
        const [dx, dy] = [(end[0] ?? 0) - (start[0] ?? 0), (end[1] ?? 0) - (start[1] ?? 0)];
        const length = Math.hypot(dx, dy);
        const [x, y] = [(start[0] ?? 0) + dx / 2, (start[1] ?? 0) + dy / 2];
        if (length < MIN_ARROW_EDGE * pixel || !isIn(view.extent, x, y)) continue;
        const [ux, uy] = [(dx / length) * size, (dy / length) * size];
        path.moveTo(x - x0 + ux, y - y0 + uy);
        path.lineTo(x - x0 - ux - uy, y - y0 - uy + ux);
        path.lineTo(x - x0 - ux + uy, y - y0 - uy - ux);
        path.closePath();
        count += 1;
      }
    }
    context.fillStyle = paint.stroke ?? "#000";
    context.fill(path);
  }

  private drawSigns(context: CanvasRenderingContext2D, view: PaintedView, group: Group, paint: Paint): void {
    context.setTransform(1, 0, 0, 1, 0, 0);
    const size = 6 * view.ratio;
    context.lineWidth = 2 * view.ratio;
    context.strokeStyle = context.fillStyle = paint.dotColour ?? paint.stroke ?? "#000";
    for (const feature of group.features) {
      const centre = centreOf(feature.geometry);
      if (!isIn(view.extent, ...centre)) continue;
      const [x = 0, y = 0] = apply(view.transform, centre);
      context.beginPath();
      if (paint.sign === "plus") cross(context, x, y, size, 0);
      else if (paint.sign === "cross") cross(context, x, y, size, Math.PI / 4);
      else if (paint.sign === "triangle") polygon(context, x, y, size, 3);
      else if (paint.sign === "square") polygon(context, x, y, size, 4);
      else context.arc(x, y, size, 0, 2 * Math.PI);
      context.stroke();
    }
  }
}

/** Returns the rings of an area, holes turned the other way: areas that overlap are filled, holes are not. */
function wound(geometry: Geometry): number[][][] {
  if (geometry.type === "MultiPolygon") {
    return geometry.coordinates.flatMap((coordinates) => wound({ type: "Polygon", coordinates }));
  }
  if (geometry.type !== "Polygon") return linesOf(geometry);
  return geometry.coordinates.map((ring, index) =>
    isCounterClockwise(ring) === (index === 0) ? ring : ring.toReversed(),
  );
}

function isCounterClockwise(ring: number[][]): boolean {
  let sum = 0;
  ring.forEach(([x = 0, y = 0], index) => {
    const [nextX = 0, nextY = 0] = ring[(index + 1) % ring.length] ?? [];
    sum += (nextX - x) * (nextY + y);
  });
  return sum < 0;
}

function newPaths(): Paths {
  return {
    lines: new Path2D(),
    areas: new Path2D(),
    dots: new Path2D(),
    hasLines: false,
    hasAreas: false,
    hasDots: false,
  };
}

/** Whether points are drawn at the resolution of a view. */
function isNear(paint: Paint, view: PaintedView): boolean {
  return !paint.dotsBelow || view.resolution < paint.dotsBelow;
}

function cross(context: CanvasRenderingContext2D, x: number, y: number, size: number, turn: number): void {
  for (const angle of [turn, turn + Math.PI / 2]) {
    const [dx, dy] = [Math.cos(angle) * size, Math.sin(angle) * size];
    context.moveTo(x - dx, y - dy);
    context.lineTo(x + dx, y + dy);
  }
}

function polygon(context: CanvasRenderingContext2D, x: number, y: number, size: number, corners: number): void {
  for (let index = 0; index < corners; index++) {
    const angle = (2 * Math.PI * index) / corners - Math.PI / 2 + (corners === 4 ? Math.PI / 4 : 0);
    const [px, py] = [x + Math.cos(angle) * size, y + Math.sin(angle) * size];
    if (index) context.lineTo(px, py);
    else context.moveTo(px, py);
  }
  context.closePath();
}
