/** Two versions on the map: what differs, and the rasters of both sides to swipe or blink. */
import type { EventsKey } from "ol/events";
import { unByKey } from "ol/Observable";
import type { LayerPart } from "../../api/client";
import { ChangeLayer } from "../../map/change-layer";
import { type Change, type Comparison, type RasterChange, stateOf } from "../../map/changes";
import type { FeatureLayer } from "../../map/feature-layer";
import { coloursOf, maskColours } from "../../map/palette";
import type { RasterLayer } from "../../map/raster-layer";
import { isMask, rasterKey, type SiteMap } from "../../map/site-map";
import { describeTiles, tileAddress, Tiles } from "../../map/tiles";
import { colour, palette, theme } from "../../theme";

export type Mode = "overlay" | "swipe" | "blink";

const Z = { chosen: 24, oldRaster: 2 };

export class CompareMap {
  private readonly changes: ChangeLayer;
  private readonly chosen: FeatureLayer;
  private readonly oldRasters = new Map<string, RasterLayer>();
  private readonly newLayers: EventsKey;
  private mode: Mode = "overlay";
  private share = 0.5;
  private phase: "before" | "after" = "after";
  private shownCells = true;
  private closed = false;
  private shown = "";
  private comparison: Comparison | null = null;

  constructor(private readonly map: SiteMap) {
    this.changes = new ChangeLayer(map);
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
    this.changes.close();
    this.map.removeLayer(this.chosen);
    this.clearRasters();
    for (const layer of this.siteRasters()) {
      layer.clip(0, 1);
      layer.setVisible(true);
    }
  }

  /** Draws the changes of a level that pass the filter. */
  show(comparison: Comparison, changes: readonly Change[], level: string, mode: Mode): void {
    this.mode = mode;
    this.changes.show(changes, level, mode !== "overlay");
    if (comparison !== this.comparison || level !== this.shown) {
      this.comparison = comparison;
      this.shown = level;
      this.clearRasters();
      void this.changes.showCells(comparison, level).then(() => this.arrange());
      for (const raster of comparison.rasters) {
        if (raster.level === level && raster.before) void this.showOld(comparison, raster, raster.before);
      }
    }
    this.arrange();
  }

  choose(change: Change | null): void {
    const states = change ? [stateOf(change, "before"), stateOf(change, "after")] : [];
    this.chosen.setFeatures(states.filter((state) => state !== null));
  }

  /** Places the handle of swiping, the side that blinks, and whether changed cells are drawn. */
  set(share: number, phase: "before" | "after", shownCells: boolean): void {
    Object.assign(this, { share, phase, shownCells });
    this.arrange();
  }

  repaint(): void {
    this.chosen.repaint();
    for (const layer of this.oldRasters.values()) colourTiles(layer.get("part") as LayerPart, layer.tiles);
  }

  /** Returns the key of the change at a place. */
  pick(point: [number, number], reach: number): string | null {
    return this.changes.pick(point, reach);
  }

  /** Clips or hides both sides, as the mode has it. */
  private arrange(): void {
    if (this.closed) return;
    const { mode, share, phase } = this;
    const place = (layer: FeatureLayer | RasterLayer, side: "before" | "after" | "both") => {
      layer.setVisible(mode !== "blink" || side === "both" || side === phase);
      if (mode !== "swipe" || side === "both") layer.clip(0, 1);
      else if (side === "before") layer.clip(0, share);
      else layer.clip(share, 1);
    };
    place(this.changes.before, "before");
    place(this.changes.after, "after");
    const changed = new Set(this.oldRasters.keys());
    for (const layer of this.oldRasters.values()) {
      place(layer, "before");
      if (mode === "overlay") layer.setVisible(false);
    }
    for (const layer of this.siteRasters()) {
      const part = layer.get("part") as LayerPart;
      place(layer, changed.has(`${part.level}/${rasterKey(part)}`) ? "after" : "both");
    }
    for (const layer of this.changes.cells) layer.setVisible(mode === "overlay" && this.shownCells);
  }

  /** Rasters of the version shown, which the site's map draws. */
  private siteRasters(): RasterLayer[] {
    const old = new Set(this.oldRasters.values());
    const layers = this.map.map.getLayers().getArray() as unknown as RasterLayer[];
    return layers.filter((layer) => layer.get("part") && !old.has(layer));
  }

  private clearRasters(): void {
    for (const raster of this.oldRasters.values()) this.map.removeRaster(raster);
    this.oldRasters.clear();
  }

  private async showOld(comparison: Comparison, change: RasterChange, part: LayerPart): Promise<void> {
    const { site } = this.map;
    const { layer, name, level } = change;
    const isCurrent = () => !this.closed && this.comparison === comparison && this.shown === level;
    try {
      const path = site.path("versions", comparison.from, "tiles", layer, name);
      const set = await describeTiles(path, { level });
      if (!isCurrent()) return;
      const tiles = new Tiles(set, tileAddress(path, { level }, set));
      colourTiles(part, tiles);
      const raster = this.map.addRaster(tiles, layer === "imagery" ? 0 : isMask(change) ? 3 : Z.oldRaster);
      raster.set("part", part);
      this.oldRasters.set(`${level}/${layer}/${name}`, raster);
      this.arrange();
    } catch (error) {
      if (!isCurrent()) return;
      const text = `${layer} ${name}: ${(error as Error).message}`;
      this.map.rasterProblems.value = [...this.map.rasterProblems.peek(), text];
    }
  }
}

function colourTiles(part: LayerPart, tiles: Tiles): void {
  if (part.layer === "imagery") tiles.recolour(null);
  else if (isMask(part)) tiles.recolour(maskColours(part.name.includes("speed") ? [214, 137, 16] : [196, 43, 68]));
  else tiles.recolour(coloursOf(palette.value, theme.value, part.layer !== "voxels"));
}
