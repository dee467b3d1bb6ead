/** Draw areas, lines and points: zones, objects, the fence, cells of a grid. */
import { signal } from "@preact/signals";
import type { Feature, LayerName, Position } from "../../../map/features";
import { notify } from "../../../ui/toast";
import { keyOf } from "../draft";
import { areaOf, closed, crossesItself, distance, movedTo } from "../geometry";
import { mark, marksOf, point } from "../sketch";
import { randomId } from "../storage";
import { Transaction } from "../transaction";
import { type Press, Tool } from "./tool";

export type AreaKind = "zone" | "object" | "fence" | "cells";

const LAYERS: Record<Exclude<AreaKind, "cells">, LayerName> = { zone: "zones", object: "objects", fence: "location" };

export class AreaTool extends Tool {
  readonly points = signal<Position[]>([]);

  constructor(
    context: Tool["context"],
    private readonly kind: AreaKind,
  ) {
    super(context);
  }

  private get shape(): "point" | "line" | "area" {
    return this.kind === "object" ? this.editor.options.peek().objectShape : "area";
  }

  private snapped(press: Press) {
    const points = this.points.peek();
    const first = points[0];
    if (first && points.length > 2 && distance(first, press.at) < press.reach)
      return { at: first, kind: "vertex" as const, closes: true };
    return { ...this.snap(press, { from: points.at(-1), before: points.at(-2) }), closes: false };
  }

  override move(press: Press): void {
    const snapped = this.snapped(press);
    this.draw(snapped.at);
    this.context.sketch.marks.value = [...this.context.sketch.marks.peek(), ...marksOf(snapped)];
  }

  private draw(next?: Position): void {
    const points = this.points.peek();
    const all = next ? [...points, next] : points;
    const marks: Feature[] = points.map((at) => point("corner", at));
    if (this.shape === "area" && all.length > 2)
      marks.push(mark("area", { type: "Polygon", coordinates: [closed(all.map((at) => [...at]))] }));
    else if (all.length > 1) marks.push(mark("line", { type: "LineString", coordinates: all.map((at) => [...at]) }));
    this.context.sketch.marks.value = marks;
  }

  override click(press: Press): void {
    const snapped = this.snapped(press);
    if (snapped.closes) this.finish();
    else this.addAt(snapped.at);
  }

  addAt(at: Position): void {
    const last = this.points.peek().at(-1);
    if ((last && distance(last, at) < 1e-6) || this.editor.refuse()) return;
    this.points.value = [...this.points.peek(), at];
    if (this.shape === "point") this.finish();
    else this.draw();
  }

  override double(): void {
    this.finish();
  }

  override finish(): void {
    const points = this.points.peek();
    const least = { point: 1, line: 2, area: 3 }[this.shape];
    if (!points.length || this.editor.refuse()) return;
    if (points.length < least) {
      notify(`${this.shape === "area" ? "An area" : "A line"} needs ${least} points or more`, { kind: "failed" });
      return;
    }
    if (this.shape === "area" && (crossesItself(points) || areaOf(points) < 1e-6)) {
      notify("The outline crosses itself: take back points with Backspace", { kind: "failed" });
      return;
    }
    this.points.value = [];
    this.context.sketch.marks.value = [];
    if (this.kind === "cells") this.setCells(points);
    else this.addFeature(points, LAYERS[this.kind]);
  }

  private setCells(points: Position[]): void {
    const { grid, cellValue } = this.editor.options.peek();
    const polygons = [[closed(points.map((at) => movedTo([], ...at)))]];
    const level = this.context.map.site.level.peek();
    this.editor.run({
      title: "Set cells",
      edits: [],
      cells: [{ id: randomId(), grid, level, polygons, value: cellValue }],
    });
  }

  private addFeature(points: Position[], layer: LayerName): void {
    const { editor } = this;
    const edits = new Transaction(editor.draft);
    const coordinates = points.map((at) => movedTo([], ...at));
    const geometry: Feature["geometry"] =
      this.shape === "point"
        ? { type: "Point", coordinates: coordinates[0] ?? [] }
        : this.shape === "line"
          ? { type: "LineString", coordinates }
          : { type: "Polygon", coordinates: [closed(coordinates)] };
    const where = editor.placeFor(layer);
    const fence =
      layer === "location"
        ? editor.draft.features().find((one) => one.layer === "location" && one.level === where.level)
        : undefined;
    const feature = edits.put(
      fence
        ? { ...fence, geometry }
        : {
            ...where,
            id: layer === "location" ? edits.freshId("fence") : edits.freshId(this.kind),
            layer,
            geometry,
            properties: this.properties(),
          },
    );
    editor.run(edits.command(fence ? "Move the fence" : `Add ${feature.id}`), [keyOf(feature)]);
  }

  private properties(): Record<string, unknown> {
    const { zoneKind, speed, objectKind, name } = this.editor.options.peek();
    const named = name.trim() ? { name: name.trim() } : {};
    if (this.kind === "fence") return { kind: "fence" };
    if (this.kind === "object") return { kind: objectKind.trim() || "obstacle", ...named };
    return zoneKind === "speed" ? { kind: zoneKind, ...named, value: speed } : { kind: zoneKind, ...named };
  }

  override back(): boolean {
    if (!this.points.peek().length) return false;
    this.points.value = this.points.peek().slice(0, -1);
    this.draw();
    return true;
  }

  override cancel(): boolean {
    const isUnderWay = this.points.peek().length > 0;
    this.points.value = [];
    this.context.sketch.marks.value = [];
    return isUnderWay;
  }
}
