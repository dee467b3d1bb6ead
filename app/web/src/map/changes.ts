/** What differs between two versions, or is lost in a format: changed features, grids and rasters. No DOM. */
import { api, apiPath, ask, type LayerPart, requestJson, type Schemas } from "../api/client";
import type { Site } from "../site";
import { type Box, boxOf, type Feature, type Geometry, joinBoxes, type LayerName } from "./features";

export type WireChange = Schemas["FeatureChangeOut"];
export type ChangeKind = "added" | "changed" | "deleted";

export interface Change {
  /** Unique in a comparison: layer, level, part and id. */
  key: string;
  id: string;
  name: string;
  layer: LayerName;
  kind: string;
  change: ChangeKind;
  level: string;
  part: string;
  before: Record<string, unknown> | null;
  after: Record<string, unknown> | null;
  /** The same object as the geometry after, if it did not move. */
  beforeGeometry: Geometry | null;
  afterGeometry: Geometry | null;
  /** Names of the properties that differ. */
  fields: string[];
}

export const KINDS: ChangeKind[] = ["added", "changed", "deleted"];

const PAGE = 10_000;
/** Changed features above which the rest is only counted. */
export const MAX_CHANGES = 50_000;

export function changeOf(wire: WireChange): Change {
  const { layer, change, before, after, before_geometry, fields, kind } = wire.properties;
  const geometry = (wire.place ?? wire.geometry ?? null) as Geometry | null;
  const old = (before_geometry ?? null) as Geometry | null;
  const name = (after ?? before)?.name;
  return {
    key: [layer, wire.level, wire.part, wire.id].join("/"),
    id: wire.id,
    name: typeof name === "string" && name ? name : wire.id,
    layer,
    kind: kind ?? layer,
    change,
    level: wire.level,
    part: wire.part,
    before: (before ?? null) as Change["before"],
    after: (after ?? null) as Change["after"],
    beforeGeometry: change === "added" ? null : (old ?? geometry),
    afterGeometry: change === "deleted" ? null : geometry,
    fields,
  };
}

/** Returns the feature as it was or is, to be drawn; null if there is none. */
export function stateOf(change: Change, when: "before" | "after"): Feature | null {
  const geometry = when === "before" ? change.beforeGeometry : change.afterGeometry;
  if (!geometry) return null;
  const { id, layer, level, part, name, kind } = change;
  return { id, layer, level, part, geometry, properties: { name, kind, change: change.change, key: change.key } };
}

/** Box of some changes, in both states. */
export function boxOfChanges(changes: readonly Change[]): Box | null {
  const states = changes.flatMap((change) => [change.beforeGeometry, change.afterGeometry]);
  return joinBoxes(states.filter((geometry) => geometry !== null).map((geometry) => boxOf(geometry)));
}

export interface Changes {
  changes: Change[];
  /** Number of changed features, of which at most MAX_CHANGES are loaded. */
  total: number;
}

interface ChangePage {
  features: WireChange[];
  next?: string;
  numberMatched?: number;
}

/** Reads changed features, page by page. read: returns a page by its cursor. */
export async function readChanges(
  read: (query: { crs: string; limit: number; cursor?: string }) => Promise<ChangePage>,
): Promise<Changes> {
  const changes: Change[] = [];
  let total = 0;
  let cursor: string | undefined;
  do {
    const page = await read({ crs: "local", limit: PAGE, cursor });
    for (const wire of page.features) changes.push(changeOf(wire));
    total = page.numberMatched ?? changes.length;
    cursor = page.next;
  } while (cursor && changes.length < MAX_CHANGES);
  return { changes, total };
}

export function loadChanges(site: Site, from: string | number, to: string, signal: AbortSignal): Promise<Changes> {
  const address = site.path("diff");
  return readChanges((query) => requestJson(apiPath(address, { from, to, format: "geojson", ...query }), { signal }));
}

export interface RasterChange {
  layer: "occupancy" | "imagery" | "voxels";
  name: string;
  level: string;
  before: LayerPart | null;
  after: LayerPart | null;
}

export interface Comparison extends Changes {
  from: string;
  to: string;
  layers: Record<string, Record<string, unknown>>;
  rasters: RasterChange[];
}

export async function loadComparison(site: Site, from: string, to: string, signal: AbortSignal): Promise<Comparison> {
  const at = (v: string) =>
    ask(api.GET("/api/v1/environments/{env}/versions/{v}/layers", { params: { path: { env: site.name, v } }, signal }));
  const [diff, before, after, features] = await Promise.all([
    requestJson<Schemas["DiffOut"]>(apiPath(site.path("diff"), { from, to }), { signal }),
    at(from),
    at(to),
    loadChanges(site, from, to, signal),
  ]);
  const layers = diff.layers as Comparison["layers"];
  return { from, to, ...features, layers, rasters: rasterChanges(before as LayerPart[], after as LayerPart[]) };
}

function rasterChanges(before: LayerPart[], after: LayerPart[]): RasterChange[] {
  const out = new Map<string, RasterChange>();
  for (const [when, parts] of [
    ["before", before],
    ["after", after],
  ] as const) {
    for (const part of parts) {
      if (part.layer !== "occupancy" && part.layer !== "imagery" && part.layer !== "voxels") continue;
      const key = [part.layer, part.level, part.name].join("/");
      const { layer, name, level } = part;
      const change = out.get(key) ?? { layer, name, level, before: null, after: null };
      out.set(key, { ...change, [when]: part });
    }
  }
  return [...out.values()].filter(({ before: old, after: now }) => old?.hash !== now?.hash);
}

/** A grid of which cells differ, with the numbers of its cells. */
export interface GridChange {
  /** Name in the server's summary: with the level, if several levels have the name. */
  key: string;
  level: string;
  freed: number;
  blocked: number;
  unknown: number;
  other: number;
  bbox: Box | null;
}

export function gridsOf({ layers, rasters }: Comparison): GridChange[] {
  const summary = (layers.occupancy ?? {}) as Record<string, Partial<GridChange>>;
  return Object.entries(summary).map(([key, counts]) => {
    const own = rasters.find(
      ({ layer, level, name }) => layer === "occupancy" && (name === key || `${level}/${name}` === key),
    );
    const { freed = 0, blocked = 0, unknown = 0, other = 0, bbox = null } = counts;
    return { key, level: own?.level ?? "ground", freed, blocked, unknown, other, bbox };
  });
}

type Rgb = [number, number, number];

interface CellWord {
  /** Value in tiles of changed cells. */
  value: number;
  /** Number of a grid's summary that counts such cells. */
  count: "blocked" | "freed" | "unknown" | "other";
  title: string;
  light: Rgb;
  dark: Rgb;
}

/** Meanings and colours of changed cells. Red and blue are told apart with any colour vision. */
export const CELL_WORDS: CellWord[] = [
  { value: 1, count: "blocked", title: "blocked now", light: [203, 36, 49], dark: [255, 110, 100] },
  { value: 2, count: "freed", title: "free now", light: [22, 112, 214], dark: [86, 172, 255] },
  { value: 5, count: "blocked", title: "blocked, unknown before", light: [139, 30, 107], dark: [226, 120, 196] },
  { value: 4, count: "freed", title: "free, unknown before", light: [92, 168, 214], dark: [60, 130, 176] },
  { value: 3, count: "unknown", title: "unknown now", light: [128, 136, 140], dark: [150, 158, 162] },
  { value: 6, count: "other", title: "other value", light: [196, 140, 10], dark: [228, 184, 66] },
];

/** RGBA of the 256 values of tiles of changed cells, as 0xAABBGGRR. */
export function cellColours(theme: "light" | "dark"): Uint32Array {
  const out = new Uint32Array(256);
  for (const word of CELL_WORDS) {
    const [red, green, blue] = word[theme];
    out[word.value] = ((165 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
  }
  return out;
}
