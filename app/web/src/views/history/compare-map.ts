/** Two versions on the map: what was added, changed and deleted, by shape and colour, and changed cells. */
import type { EventsKey } from "ol/events";
import { unByKey } from "ol/Observable";
import { apiPath, type LayerPart, requestJson, type Schemas } from "../../api/client";
import type { FeatureLayer, FeatureStyle, Paint } from "../../map/feature-layer";
import { type Box, type Feature, FeatureIndex, joinBoxes, boxOf, linesOf, pointsOf } from "../../map/features";
import { coloursOf, maskColours } from "../../map/palette";
import type { RasterLayer } from "../../map/raster-layer";
import { isMask, rasterKey, type SiteMap } from "../../map/site-map";
import { Tiles } from "../../map/tiles";
import { colour, palette, theme } from "../../theme";
import { cellWords } from "./cells";
import { type Change, stateOf } from "./changes";
import type { Comparison, RasterChange } from "./loads";

export type Mode = "overlay" | "swipe" | "blink";

const Z = { before: 14, after: 15, chosen: 24, oldRaster: 2, cells: 4 };
/** Resolution from which on each change has its sign; coarser only if there are few. */
const SIGN_RESOLUTION = 0.05;
const FEW = 150;

export class CompareMap {
  private readonly before: FeatureLayer;
  private readonly after: FeatureLayer;
  private readonly chosen: FeatureLayer;
  private readonly cells = new Map<string, RasterLayer>();
  private readonly oldRasters = new Map<string, RasterLayer>();
  private readonly newLayers: EventsKey;
  private mode: Mode = "overlay";
  private share = 0.5;
  private phase: "before" | "after" = "after";
  private shownCells = true;
  private count = 0;
  private closed = false;
  private index = new FeatureIndex([]);
  private comparison: Comparison | null = null;

  constructor(private readonly map: SiteMap) {
    this.before = map.addLayer(this.style("before"), Z.before);
    this.after = map.addLayer(this.style("after"), Z.after);
    this.chosen = map.addLayer(
      {
        classOf: () => "chosen",
        paints: () => ({
          chosen: { stroke: colour("accent"), width: 2, dash: [2, 3], sign: "square", fill: "transparent" },
        }),
      },
      Z.chosen,
    );
    // Rasters of the shown version are added when their tiles are known.
    this.newLayers = map.map.getLayers().on("add", () => queueMicrotask(() => this.arrange()));
  }

  close(): void {
    this.closed = true;
    unByKey(this.newLayers);
    for (const layer of [this.before, this.after, this.chosen]) this.map.removeLayer(layer);
    for (const raster of [...this.cells.values(), ...this.oldRasters.values()]) this.map.removeRaster(raster);
    for (const layer of this.siteRasters()) layer.clip(0, 1);
    for (const layer of this.siteRasters()) layer.setVisible(true);
    this.map.hideFeatures([]);
  }

  /** Draws the changes of a level that pass the filter. */
  show(comparison: Comparison, changes: readonly Change[], level: string): void {
    const own = changes.filter((change) => change.level === level);
    const states = (when: "before" | "after") => own.map((one) => stateOf(one, when)).filter((one) => one !== null);
    const [before, after] = [states("before"), states("after")];
    this.count = own.length;
    this.before.setFeatures(before);
    this.after.setFeatures(after);
    this.index = new FeatureIndex([...before, ...after]);
    const drawn = new Set(own.map(({ key }) => key));
    const hidden = comparison.changes.filter(
      ({ change, level: at, key }) => change !== "deleted" && at === level && drawn.has(key),
    );
    this.map.hideFeatures(hidden.map(({ id }) => id));
    if (comparison !== this.comparison) {
      this.comparison = comparison;
      this.clearRasters();
      for (const raster of comparison.rasters.filter((one) => one.level === level))
        void this.showRaster(comparison, raster);
    }
    this.arrange();
  }

  choose(change: Change | null): void {
    const states = change ? [stateOf(change, "before"), stateOf(change, "after")] : [];
    this.chosen.setFeatures(states.filter((state) => state !== null));
  }

  setMode(mode: Mode, share: number, phase: "before" | "after", shownCells: boolean): void {
    const isOther = mode !== this.mode;
    Object.assign(this, { mode, share, phase, shownCells });
    this.arrange();
    if (isOther) this.repaint();
  }

  repaint(): void {
    for (const layer of [this.before, this.after, this.chosen]) layer.repaint();
    for (const layer of this.cells.values()) layer.tiles.recolour(cellWords.colours(theme.value));
    for (const layer of this.oldRasters.values()) colourTiles(layer.get("part") as LayerPart, layer.tiles);
  }

  /** Returns the key of the change at a place. */
  pick(point: [number, number], reach: number): string | null {
    const found = this.index.near(point, reach)[0];
    return found ? String(found.properties.key) : null;
  }

  /** Box of some changes, in both states. */
  static boxOf(changes: readonly Change[]): Box | null {
    const states = changes.flatMap((change) => [change.beforeGeometry, change.afterGeometry]);
    return joinBoxes(states.filter((geometry) => geometry !== null).map((geometry) => boxOf(geometry)));
  }

  /** Clips or hides both sides, as the mode has it. */
  private arrange(): void {
    const { mode, share, phase } = this;
    const place = (layer: FeatureLayer | RasterLayer, side: "before" | "after" | "both") => {
      layer.setVisible(mode !== "blink" || side === "both" || side === phase);
      if (mode !== "swipe" || side === "both") layer.clip(0, 1);
      else if (side === "before") layer.clip(0, share);
      else layer.clip(share, 1);
    };
    place(this.before, "before");
    place(this.after, "after");
    const changed = new Set(this.oldRasters.keys());
    for (const layer of this.oldRasters.values()) {
      place(layer, "before");
      if (mode === "overlay") layer.setVisible(false);
    }
    for (const layer of this.siteRasters()) {
      const part = layer.get("part") as LayerPart;
      place(layer, changed.has(`${part.level}/${rasterKey(part)}`) ? "after" : "both");
    }
    for (const layer of this.cells.values()) layer.setVisible(mode === "overlay" && this.shownCells);
  }

  /** Rasters of the version shown, which the site's map draws. */
  private siteRasters(): RasterLayer[] {
    const old = new Set(this.oldRasters.values());
    const layers = this.map.map.getLayers().getArray() as unknown as RasterLayer[];
    return layers.filter((layer) => layer.get("part") && !old.has(layer));
  }

  private clearRasters(): void {
    for (const raster of [...this.cells.values(), ...this.oldRasters.values()]) this.map.removeRaster(raster);
    this.cells.clear();
    this.oldRasters.clear();
  }

  private async showRaster(comparison: Comparison, change: RasterChange): Promise<void> {
    const { site } = this.map;
    const { from, to } = comparison;
    const { layer, name, level } = change;
    const key = `${level}/${layer}/${name}`;
    const isCurrent = () => !this.closed && this.comparison === comparison;
    try {
      if (layer === "occupancy") {
        const path = site.path("diff", "tiles", name);
        const set = await requestJson<Schemas["ChangeRasterOut"]>(apiPath(path, { from, to, level }));
        if (!isCurrent()) return;
        const tiles = new Tiles(set, (z, row, column) =>
          apiPath([...path, z, row, `${column}.png`], { from, to, level }),
        );
        tiles.recolour(cellWords.colours(theme.value));
        this.cells.set(key, this.map.addRaster(tiles, Z.cells));
      }
      if (change.before) {
        const path = site.path("versions", from, "tiles", layer, name);
        const set = await requestJson<Schemas["RasterOut"]>(apiPath(path, { level }));
        if (!isCurrent()) return;
        const tiles = new Tiles(set, (z, row, column) => apiPath([...path, z, row, `${column}.png`], { level }));
        colourTiles(change.before, tiles);
        const raster = this.map.addRaster(tiles, layer === "imagery" ? 0 : isMask(change) ? 3 : Z.oldRaster);
        raster.set("part", change.before);
        this.oldRasters.set(key, raster);
      }
      this.arrange();
    } catch (error) {
      if (isCurrent()) {
        const text = `${layer} ${name}: ${(error as Error).message}`;
        this.map.rasterProblems.value = [...this.map.rasterProblems.peek(), text];
      }
    }
  }

  private style(side: "before" | "after"): FeatureStyle {
    return {
      classOf: (feature) => `${String(feature.properties.change)} ${shapeOf(feature)}`,
      paints: (): Record<string, Paint> => {
        const near = this.map.resolution.peek() < SIGN_RESOLUTION || this.count < FEW;
        const tint = (name: string, share: number) => `color-mix(in srgb, ${colour(name)} ${share}%, transparent)`;
        if (side === "after") {
          return {
            "changed line": {
              stroke: colour("changed"),
              width: 3.5,
              fill: tint("changed", 20),
              sign: near ? "triangle" : undefined,
            },
            "added line": {
              stroke: colour("added"),
              width: 3.5,
              fill: tint("added", 20),
              sign: near ? "plus" : undefined,
            },
            "changed point": { stroke: colour("changed"), dot: 7, sign: near ? "triangle" : undefined },
            "added point": { stroke: colour("added"), dot: 7, sign: near ? "plus" : undefined, labels: near },
          };
        }
        const isFaint = this.mode === "overlay";
        const was = isFaint ? tint("changed", 55) : colour("changed");
        return {
          "changed line": { stroke: was, width: isFaint ? 2 : 3.5, dash: isFaint ? [2, 4] : undefined },
          "deleted line": {
            stroke: colour("deleted"),
            width: 3,
            dash: [7, 5],
            fill: tint("deleted", 12),
            sign: near ? "cross" : undefined,
          },
          "changed point": { stroke: was, dot: 7, sign: near && isFaint ? "ring" : undefined },
          "deleted point": { stroke: colour("deleted"), dot: 5, sign: near ? "cross" : undefined },
        };
      },
    };
  }
}

function shapeOf({ geometry }: Feature): "line" | "point" {
  return linesOf(geometry).length || !pointsOf(geometry).length ? "line" : "point";
}

function colourTiles(part: LayerPart, tiles: Tiles): void {
  if (part.layer === "imagery") tiles.recolour(null);
  else if (isMask(part)) tiles.recolour(maskColours(part.name.includes("speed") ? [214, 137, 16] : [196, 43, 68]));
  else tiles.recolour(coloursOf(palette.value, theme.value, part.layer !== "voxels"));
}
