/** Paint cells of a grid with a round brush. */
import type { Position } from "../../../map/features";
import { capsule, simplified } from "../geometry";
import { cellKind, mark } from "../sketch";
import { randomId } from "../storage";
import { type Press, Tool } from "./tool";

export class BrushTool extends Tool {
  private stroke: Position[] = [];

  private get radius(): number {
    return this.editor.options.peek().brush / 2;
  }

  override down(press: Press): boolean {
    this.stroke = [press.at];
    this.draw(press);
    return true;
  }

  override drag(press: Press): void {
    const last = this.stroke.at(-1);
    if (last && Math.hypot(press.at[0] - last[0], press.at[1] - last[1]) > this.radius / 8) this.stroke.push(press.at);
    this.draw(press);
  }

  override drop(): void {
    this.commit();
  }

  override click(press: Press): void {
    this.stroke = [press.at];
    this.commit();
  }

  private commit(): void {
    const { grid, cellValue } = this.editor.options.peek();
    const polygons = this.polygons();
    this.stroke = [];
    this.context.sketch.marks.value = [];
    if (!polygons.length) return;
    const level = this.context.map.site.level.peek();
    const cells = [{ id: randomId(), grid, level, polygons, value: cellValue }];
    this.editor.run({ title: "Paint cells", edits: [], cells });
  }

  /** Convex pieces of the stroke: each is valid by itself. */
  private polygons(): number[][][][] {
    const line = simplified(this.stroke, this.radius / 6);
    const first = line[0];
    if (!first) return [];
    if (line.length === 1) return [[capsule(first, first, this.radius)]];
    return line.slice(1).map((at, index) => [capsule(line[index] ?? first, at, this.radius)]);
  }

  private draw(press: Press): void {
    const kind = cellKind(this.editor.options.peek().cellValue);
    const pieces = this.polygons().map((coordinates, index) =>
      mark(kind, { type: "Polygon", coordinates }, String(index)),
    );
    this.context.sketch.marks.value = [...pieces, this.outline(press.at)];
  }

  private outline(at: Position) {
    return mark("line", { type: "LineString", coordinates: capsule(at, at, this.radius, 24) });
  }

  override move(press: Press): void {
    this.context.sketch.marks.value = [this.outline(press.at)];
  }

  override cancel(): boolean {
    const isUnderWay = this.stroke.length > 0;
    this.stroke = [];
    this.context.sketch.marks.value = [];
    return isUnderWay;
  }
}
