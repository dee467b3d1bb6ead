/** Changes on the map: added, changed and deleted features by colour, dashes and sign, and changed cells. */
import { effect } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";
import { isAbort, type Schemas } from "../api/client";
import { colour, theme } from "../theme";
import { type Change, type ChangeKind, cellColours, type Comparison, stateOf } from "./changes";
import type { FeatureLayer, FeatureStyle, Paint } from "./feature-layer";
import { type Feature, FeatureIndex, isArea, linesOf, type Position } from "./features";
import type { RasterLayer } from "./raster-layer";
import type { SiteMap } from "./site-map";
import { describeTiles, tileAddress, Tiles } from "./tiles";

const Z = { cells: 4, before: 20, after: 21 };
/** Resolution from which on each change has its sign; coarser only if there are few. */
const SIGN_RESOLUTION = 0.05;
const FEW = 150;
const SIGNS: Record<ChangeKind, Paint["sign"]> = { added: "plus", changed: "triangle", deleted: "cross" };
/** Lines tell by their dashes what points and areas tell by their signs. */
const DASHES: Record<ChangeKind, number[] | undefined> = { added: undefined, changed: [10, 4], deleted: [3, 4] };

export class ChangeLayer {
  readonly before: FeatureLayer;
  readonly after: FeatureLayer;
  cells: RasterLayer[] = [];
  private index = new FeatureIndex([]);
  private ids: string[] = [];
  private hasSides = false;
  private round = 0;
  private readonly stop: () => void;

  constructor(private readonly map: SiteMap) {
    this.before = map.addLayer(this.style(true), Z.before);
    this.after = map.addLayer(this.style(false), Z.after);
    this.stop = effect(() => {
      theme.value;
      requestAnimationFrame(() => this.repaint());
    });
  }

  close(): void {
    this.stop();
    this.map.removeLayer(this.before);
    this.map.removeLayer(this.after);
    this.clearCells();
    this.map.hideFeatures([]);
  }

  /** Draws changes of a level in place of the version's features. hasSides: both states in full, to swipe or blink. */
  show(changes: readonly Change[], level: string, hasSides = false): void {
    const own = changes.filter((change) => change.level === level);
    const isShown = ({ change, beforeGeometry, afterGeometry }: Change) =>
      hasSides || change === "deleted" || beforeGeometry !== afterGeometry;
    const before = own.filter(isShown).flatMap((change) => stateOf(change, "before") ?? []);
    const after = own.flatMap((change) => stateOf(change, "after") ?? []);
    this.hasSides = hasSides;
    this.ids = own.map(({ id }) => id);
    this.before.setFeatures(before.map(inOneDirection));
    this.after.setFeatures(after.map(inOneDirection));
    this.index = new FeatureIndex([...before, ...after]);
    this.map.hideFeatures(this.ids);
  }

  /** Draws the cells of a level that differ. */
  async showCells({ from, to, rasters }: Comparison, level: string): Promise<void> {
    this.clearCells();
    const round = this.round;
    for (const { layer, name, level: at } of rasters) {
      if (layer !== "occupancy" || at !== level) continue;
      const path = this.map.site.path("diff", "tiles", name);
      try {
        const query = { from, to, level };
        const set = await describeTiles<Schemas["ChangeRasterOut"]>(path, query);
        if (round !== this.round) return;
        const tiles = new Tiles(set, tileAddress(path, query, set));
        tiles.recolour(cellColours(theme.peek()));
        this.cells.push(this.map.addRaster(tiles, Z.cells));
      } catch (error) {
        if (isAbort(error) || round !== this.round) return;
        const text = `Grid ${name}: ${(error as Error).message}`;
        this.map.rasterProblems.value = [...this.map.rasterProblems.peek(), text];
      }
    }
  }

  setVisible(isVisible: boolean): void {
    for (const layer of [this.before, this.after, ...this.cells]) layer.setVisible(isVisible);
    this.map.hideFeatures(isVisible ? this.ids : []);
  }

  /** Returns the key of the change at a place. */
  pick(point: Position, reach: number): string | null {
    const found = this.index.near(point, reach)[0];
    return found ? String(found.properties.key) : null;
  }

  private repaint(): void {
    this.before.repaint();
    this.after.repaint();
    for (const layer of this.cells) layer.tiles.recolour(cellColours(theme.peek()));
  }

  private clearCells(): void {
    this.round += 1;
    for (const layer of this.cells.splice(0)) this.map.removeRaster(layer);
  }

  private style(isBefore: boolean): FeatureStyle {
    return {
      classOf: (feature) => `${String(feature.properties.change)} ${shapeOf(feature)}`,
      paints: () => {
        const resolution = this.map.resolution.peek();
        const hasSigns = resolution < SIGN_RESOLUTION || this.ids.length < FEW;
        const out: Record<string, Paint> = {};
        for (const kind of ["changed", "added", "deleted"] as const) {
          if (isBefore && kind === "changed" && !this.hasSides) Object.assign(out, faintPaints());
          else Object.assign(out, paintsOf(kind, hasSigns, resolution < SIGN_RESOLUTION));
        }
        return out;
      },
    };
  }
}

function paintsOf(kind: ChangeKind, hasSigns: boolean, labels: boolean): Record<string, Paint> {
  const stroke = colour(kind);
  const sign = hasSigns ? SIGNS[kind] : undefined;
  const dash = DASHES[kind];
  const fill = `color-mix(in srgb, ${stroke} 16%, transparent)`;
  return {
    [`${kind} area`]: { stroke, fill, width: 2.5, dash, sign },
    [`${kind} line`]: { stroke, width: 3.5, dash },
    [`${kind} point`]: { stroke, dot: sign ? (kind === "added" ? 9 : 3) : 7, sign, labels },
  };
}

/** Where something was that has moved. */
function faintPaints(): Record<string, Paint> {
  const stroke = `color-mix(in srgb, ${colour("changed")} 55%, transparent)`;
  const paint: Paint = { stroke, width: 2, dash: [2, 4], dot: 5 };
  return { "changed area": paint, "changed line": paint, "changed point": paint };
}

function shapeOf({ geometry }: Feature): "area" | "line" | "point" {
  return isArea(geometry) ? "area" : linesOf(geometry).length ? "line" : "point";
}

/** Turns lines the same way: the dashes of the two edges of a street would fill each other's gaps. */
function inOneDirection(feature: Feature): Feature {
  const { geometry } = feature;
  if (geometry.type !== "LineString") return feature;
  const [[ax = 0, ay = 0] = [], [bx = 0, by = 0] = []] = [geometry.coordinates[0], geometry.coordinates.at(-1)];
  if (ax < bx || (ax === bx && ay <= by)) return feature;
  return { ...feature, geometry: { type: "LineString", coordinates: geometry.coordinates.toReversed() } };
}

const NO_CHANGES: readonly Change[] = [];

/** Draws changes of the level shown for as long as the component is there; with a comparison, also changed cells. */
export function useChangeLayer(
  map: SiteMap,
  changes: readonly Change[] = NO_CHANGES,
  comparison?: Comparison,
  isVisible = true,
): void {
  const level = map.site.level.value;
  const [layer, setLayer] = useState<ChangeLayer | null>(null);
  useEffect(() => {
    const made = new ChangeLayer(map);
    setLayer(made);
    return () => made.close();
  }, [map]);
  useEffect(() => layer?.show(changes, level), [layer, changes, level]);
  useEffect(() => {
    if (comparison) void layer?.showCells(comparison, level).then(() => layer.setVisible(isVisible));
  }, [layer, comparison, level]);
  useEffect(() => layer?.setVisible(isVisible), [layer, isVisible, changes, level]);
}
