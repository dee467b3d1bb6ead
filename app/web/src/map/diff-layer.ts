/** What differs between two versions, drawn by colour and by sign: added, changed and deleted features, and cells. */
import { computed, effect, signal } from "@preact/signals";
import { type ApiError, apiPath, asApiError, type Raster, requestJson, type Schemas } from "../api/client";
import { colour, theme } from "../theme";
import type { FeatureLayer, FeatureStyle, Paint } from "./feature-layer";
import { type Feature, fromWire, type Geometry, isArea, joinBoxes, linesOf, boxOf, type WireFeature } from "./features";
import type { RasterLayer } from "./raster-layer";
import type { SiteMap } from "./site-map";
import { Tiles } from "./tiles";

export type Change = "added" | "changed" | "deleted";

/** A feature that differs, at its place after the change, or before it if it was deleted. */
export interface DiffFeature extends Feature {
  change: Change;
  before: Record<string, unknown> | null;
  after: Record<string, unknown> | null;
  /** Geometry before the change; null: the same. */
  beforeGeometry: Geometry | null;
  /** Names of the properties that differ. */
  fields: string[];
}

/** A grid of which cells differ, with their numbers as the API gives them. */
export interface DiffGrid {
  key: string;
  name: string;
  level: string;
  freed: number;
  blocked: number;
  unknown: number;
  other: number;
  bbox: number[] | null;
  /** Tiles of the cells; null: they cannot be drawn. */
  set: Raster | null;
}

interface Options {
  /** Versions as addresses name them: numbers, channels, `latest` or `dry:…`. */
  from: string | number;
  to: string | number;
  /** Level that is drawn. Default: the one shown. */
  level?: string;
}

const PAGE = 10_000;
const MAX_FEATURES = 50_000;
const MAX_SIGNS = 400;
const Z = { cells: 4, before: 20, features: 21 };

/** Colours of changed cells, as 0xAABBGGRR: value 1 blocked, 2 freed, 3 unknown now, 4 known and free, 5 known and
 * occupied, 6 another change. */
const CELLS: Record<number, [number, number, number, number]> = {
  1: [207, 34, 46, 235],
  2: [26, 127, 55, 190],
  3: [110, 110, 130, 200],
  4: [86, 180, 110, 120],
  5: [176, 60, 90, 225],
  6: [214, 150, 20, 200],
};

/** Names of the changes of cells, with the number of a grid's diff that counts them, for a legend. */
export const CELL_NAMES: [number, string, "blocked" | "freed" | "unknown" | "other"][] = [
  [1, "blocked", "blocked"],
  [5, "new, occupied", "blocked"],
  [2, "freed", "freed"],
  [4, "new, free", "freed"],
  [3, "unknown now", "unknown"],
  [6, "other value", "other"],
];

export function cellColour(value: number): string {
  const [red, green, blue, alpha] = CELLS[value] ?? [0, 0, 0, 0];
  return `rgb(${red} ${green} ${blue} / ${alpha / 255})`;
}

export class DiffLayer {
  readonly features = signal<DiffFeature[]>([]);
  readonly grids = signal<DiffGrid[]>([]);
  readonly loading = signal(true);
  readonly problem = signal<ApiError | null>(null);
  readonly visible = signal(true);
  /** Number of features beyond those that are drawn. */
  readonly left = signal(0);
  readonly level = computed(() => this.options.level ?? this.map.site.level.value);
  private readonly shown = computed(() => this.features.value.filter(({ level }) => level === this.level.value));

  private readonly drawn: FeatureLayer;
  private readonly beforeLayer: FeatureLayer;
  private readonly rasters: RasterLayer[] = [];
  private readonly control = new AbortController();
  private readonly stops: (() => void)[] = [];
  /** Resolves when everything has been loaded, or has failed. */
  readonly done: Promise<void>;

  constructor(
    private readonly map: SiteMap,
    private readonly options: Options,
  ) {
    this.beforeLayer = map.addLayer({ classOf: () => "before", paints: () => ({ before: paintOfBefore() }) }, Z.before);
    this.drawn = map.addLayer(
      diffStyle(() => this.shown.peek().length <= MAX_SIGNS),
      Z.features,
    );
    this.done = this.load();
    this.stops.push(
      effect(() => {
        const features = this.shown.value;
        this.drawn.setFeatures(features.map(inOneDirection));
        this.beforeLayer.setFeatures(
          features.flatMap((feature) =>
            feature.beforeGeometry ? [{ ...feature, geometry: feature.beforeGeometry }] : [],
          ),
        );
      }),
      effect(() => this.showCells(this.grids.value, this.level.value)),
      effect(() => {
        theme.value;
        requestAnimationFrame(() => {
          this.drawn.repaint();
          this.beforeLayer.repaint();
        });
      }),
    );
  }

  /** Moves the map to all that differs on the level. */
  fit(): void {
    const boxes: number[][] = this.shown
      .peek()
      .flatMap(({ geometry, beforeGeometry }) => [boxOf(geometry), ...(beforeGeometry ? [boxOf(beforeGeometry)] : [])]);
    for (const { level, bbox } of this.grids.peek()) if (level === this.level.peek() && bbox) boxes.push(bbox);
    this.map.fit(joinBoxes(boxes));
  }

  setVisible(isVisible: boolean): void {
    this.visible.value = isVisible;
    for (const layer of [this.drawn, this.beforeLayer, ...this.rasters]) layer.setVisible(isVisible);
  }

  close(): void {
    this.control.abort();
    for (const stop of this.stops) stop();
    this.map.removeLayer(this.drawn);
    this.map.removeLayer(this.beforeLayer);
    this.clearCells();
  }

  private async load(): Promise<void> {
    const { from, to } = this.options;
    const path = this.map.site.path("diff");
    const { signal: stop } = this.control;
    try {
      const summary = await requestJson<Schemas["DiffOut"]>(apiPath(path, { from, to }), { signal: stop });
      this.grids.value = await Promise.all(gridsOf(summary.layers).map((grid) => this.findGrid(grid)));
      let cursor: string | undefined;
      do {
        const query = { from, to, format: "geojson", crs: "local", limit: PAGE, cursor };
        const page = await requestJson<Schemas["DiffFeaturesOut"]>(apiPath(path, query), { signal: stop });
        const features = page.features.map(toDiffFeature).filter((feature) => feature !== null);
        this.features.value = [...this.features.peek(), ...features];
        cursor = page.next;
        if (cursor && this.features.peek().length >= MAX_FEATURES) {
          this.left.value = (page.numberMatched ?? 0) - this.features.peek().length;
          break;
        }
      } while (cursor);
    } catch (error) {
      if (!stop.aborted) this.problem.value = asApiError(error);
    } finally {
      if (!stop.aborted) this.loading.value = false;
    }
  }

  /** Finds the level and the tiles of a grid: a name that several levels have is written `L2/map`. */
  private async findGrid(grid: DiffGrid): Promise<DiffGrid> {
    const cut = grid.key.indexOf("/");
    const ways: { name: string; level?: string }[] = [{ name: grid.key }];
    if (cut > 0) ways.unshift({ name: grid.key.slice(cut + 1), level: grid.key.slice(0, cut) });
    else ways.push({ name: grid.key, level: this.level.peek() });
    const { from, to } = this.options;
    for (const { name, level } of ways) {
      const path = apiPath(this.map.site.path("diff", "tiles", name), { from, to, level });
      const set = await requestJson<Schemas["ChangeRasterOut"]>(path, { signal: this.control.signal }).catch(
        (error) => {
          if (asApiError(error).status < 400) throw error; // aborted, or offline
          return null;
        },
      );
      if (set) return { ...grid, name, level: set.level, set: set as unknown as Raster };
    }
    return grid;
  }

  private showCells(grids: DiffGrid[], level: string): void {
    this.clearCells();
    const { from, to } = this.options;
    for (const { name, set } of grids.filter((one) => one.level === level)) {
      if (!set) continue;
      const path = this.map.site.path("diff", "tiles", name);
      const address = (z: number, row: number, column: number) =>
        apiPath([...path, z, row, `${column}.png`], { from, to, level });
      const tiles = new Tiles(set, address);
      tiles.recolour(cellColours());
      const layer = this.map.addRaster(tiles, Z.cells);
      layer.setVisible(this.visible.peek());
      this.rasters.push(layer);
    }
  }

  private clearCells(): void {
    for (const layer of this.rasters.splice(0)) this.map.removeRaster(layer);
  }
}

export function toDiffFeature(wire: Schemas["FeatureChangeOut"]): DiffFeature | null {
  const { layer, kind, change, before, after, before_geometry, fields } = wire.properties;
  const feature = fromWire(layer, wire as unknown as WireFeature);
  if (!feature) return null;
  const properties = { ...(after ?? before ?? {}), kind: kind ?? layer };
  const beforeGeometry = (before_geometry ?? null) as Geometry | null;
  return { ...feature, properties, change, before, after, beforeGeometry, fields } as DiffFeature;
}

/** Turns lines the same way: the dashes of the two edges of a street would fill each other's gaps. */
function inOneDirection<T extends Feature>(feature: T): T {
  const { geometry } = feature;
  if (geometry.type !== "LineString") return feature;
  const [[ax = 0, ay = 0] = [], [bx = 0, by = 0] = []] = [geometry.coordinates[0], geometry.coordinates.at(-1)];
  if (ax < bx || (ax === bx && ay <= by)) return feature;
  return { ...feature, geometry: { type: "LineString", coordinates: [...geometry.coordinates].reverse() } };
}

/** Returns the grids of a diff, with the numbers of their cells. Their levels are found by `findGrid`. */
export function gridsOf(layers: Record<string, unknown>): DiffGrid[] {
  const grids = (layers.occupancy ?? {}) as Record<string, Partial<DiffGrid>>;
  return Object.entries(grids)
    .filter(([, value]) => typeof value === "object" && value !== null)
    .map(([key, { freed = 0, blocked = 0, unknown = 0, other = 0, bbox = null }]) => ({
      key,
      name: key,
      level: "ground",
      freed,
      blocked,
      unknown,
      other,
      bbox,
      set: null,
    }));
}

/** How changes are drawn. Lines tell by their dashes what points tell by their signs. */
export function diffStyle(hasSigns: () => boolean): FeatureStyle {
  const classOf = (feature: Feature): string => {
    const { change } = feature as DiffFeature;
    const shape = isArea(feature.geometry) ? "area" : linesOf(feature.geometry).length ? "line" : "point";
    return `${change} ${shape}`;
  };
  const paints = (): Record<string, Paint> => {
    const out: Record<string, Paint> = {};
    for (const [change, sign, dash] of [
      ["changed", "triangle", [10, 4]],
      ["added", "plus", undefined],
      ["deleted", "cross", [3, 4]],
    ] as const) {
      const stroke = colour(change);
      const fill = `color-mix(in srgb, ${stroke} 16%, transparent)`;
      const signs = hasSigns() ? sign : undefined;
      out[`${change} area`] = { stroke, fill, width: 2.5, dash: dash && [...dash], sign: signs };
      out[`${change} line`] = { stroke, width: 3.5, dash: dash && [...dash] };
      out[`${change} point`] = { stroke, dot: signs && change !== "added" ? 3 : 9, sign: signs };
    }
    return out;
  };
  return { classOf, paints };
}

function paintOfBefore(): Paint {
  const stroke = `color-mix(in srgb, ${colour("changed")} 45%, transparent)`;
  return { stroke, width: 1.5, dash: [2, 4], dot: 5 };
}

function cellColours(): Uint32Array {
  const out = new Uint32Array(256);
  for (const [value, [red, green, blue, alpha]] of Object.entries(CELLS)) {
    out[Number(value)] = ((alpha << 24) | (blue << 16) | (green << 8) | red) >>> 0;
  }
  return out;
}
