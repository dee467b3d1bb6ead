/** The map of a site: OpenLayers' view and gestures, our painted layers. */
import { computed, effect, signal, untracked } from "@preact/signals";
import {
  DoubleClickZoom,
  DragPan,
  DragRotate,
  KeyboardPan,
  KeyboardZoom,
  MouseWheelZoom,
  PinchRotate,
  PinchZoom,
} from "ol/interaction";
import type { Layer } from "ol/layer";
import OlMap from "ol/Map";
import View from "ol/View";
import { go, param } from "../address";
import { type LayerPart, returns } from "../api/client";
import type { Site } from "../site";
import { colour, palette, theme } from "../theme";
import { baseMap, createBaseLayer, isBaseMapShown, loadBaseMap } from "./base-map";
import { FeatureLayer, type FeatureStyle } from "./feature-layer";
import {
  type Box,
  boxOf,
  difference,
  EMPTY_BOX,
  type Feature,
  FeatureIndex,
  joinBoxes,
  type Position,
} from "./features";
import { LOCAL } from "./frame";
import { NamesLayer } from "./names";
import { coloursOf, maskColours } from "./palette";
import { RasterLayer } from "./raster-layer";
import { Streets } from "./streets";
import { tileAddress, Tiles } from "./tiles";
import { zoneClass, zonePaints } from "./zones";

const PICK_PIXELS = 10;
/** Changes beyond which all features are drawn anew. */
const MAX_CHANGES = 2000;
const Z = {
  imagery: 0,
  voxels: 1,
  occupancy: 2,
  masks: 3,
  zones: 10,
  objects: 11,
  topology: 12,
  names: 13,
  overlay: 20,
};

/** Layers switched off, in the address, so that a link shows the same map. */
export function isHidden(key: string): boolean {
  return hidden.value.split(",").includes(key);
}

/** A value of its own: the map is not built anew when something else changes in the address. */
const hidden = computed(() => param("hide") ?? "");

export function toggleHidden(key: string): void {
  const hidden = new Set((param("hide") ?? "").split(",").filter(Boolean));
  if (!hidden.delete(key)) hidden.add(key);
  go({ hide: [...hidden].join(",") }, { replace: true });
}

export function rasterKey(part: { layer: string; name: string }): string {
  return `${part.layer}/${part.name}`;
}

/** Returns whether it took the click. */
export type Picker = (feature: Feature | null, point: Position, event: PointerEvent | MouseEvent) => boolean;

export class SiteMap {
  readonly map: OlMap;
  /** Place of the pointer in local metres. */
  readonly pointer = signal<Position | null>(null);
  readonly selected = signal<Feature | null>(null);
  readonly resolution = signal(1);
  readonly rotation = signal(0);
  /** Opacity of layers by key, 0 to 1. */
  readonly opacity = signal<Record<string, number>>({});
  /** Slice of voxels in metres; null: all heights. */
  readonly slice = signal<[number, number] | null>(null);
  readonly rasterProblems = signal<string[]>([]);
  /** Features shown instead of the version's, such as those of a draft; null: the version's. */
  readonly shown = signal<readonly Feature[] | null>(null);
  index = new FeatureIndex([]);
  readonly pan = new DragPan();

  private readonly layers: Record<"zones" | "objects" | "topology" | "location", FeatureLayer>;
  private readonly selection: FeatureLayer;
  private readonly rasters = new Map<string, RasterLayer>();
  private readonly stops: (() => void)[] = [];
  private pickers: { pick: Picker; isAbove: boolean }[] = [];
  private drawn: { level: string; features: readonly Feature[] } = { level: "", features: [] };
  private streets = new Streets([]);
  private base: Layer | null = null;
  private fitted = "";
  private isFirstPainting = true;

  constructor(
    readonly site: Site,
    target: HTMLElement,
  ) {
    this.map = new OlMap({
      target,
      controls: [],
      interactions: [
        this.pan,
        new DoubleClickZoom(),
        new PinchRotate({ threshold: 0.6 }),
        new PinchZoom(),
        new MouseWheelZoom(),
        new DragRotate(),
        new KeyboardPan(),
        new KeyboardZoom(),
      ],
      view: new View({
        projection: LOCAL,
        center: [0, 0],
        resolution: 0.1,
        minResolution: 0.001,
        maxResolution: 2000,
        constrainRotation: false,
      }),
    });
    this.layers = {
      zones: this.addLayer(this.style("zones"), Z.zones),
      location: this.addLayer(this.style("location"), Z.zones),
      objects: this.addLayer(this.style("objects"), Z.objects),
      topology: this.addLayer(this.style("topology"), Z.topology),
    };
    const { topology, objects, zones, location } = this.layers;
    this.map.addLayer(new NamesLayer([topology, objects, zones, location], Z.names));
    this.selection = this.addLayer(
      {
        classOf: () => "selected",
        paints: () => ({ selected: { stroke: colour("accent"), width: 4, dot: 14, fill: "transparent" } }),
      },
      Z.overlay + 5,
    );
    this.listen();
    void loadBaseMap();
    this.stops.push(
      effect(() => void this.showBase()),
      effect(() => this.showFeatures()),
      effect(() => this.showRasters()),
      effect(() => this.paintAgain()),
      effect(() => this.showOpacity()),
      effect(() => {
        if (returns.value) for (const layer of this.rasters.values()) layer.tiles.retry();
      }),
      effect(() => this.selection.setFeatures(this.selected.value ? [this.selected.value] : [])),
    );
  }

  close(): void {
    for (const stop of this.stops) stop();
    this.map.setTarget(undefined);
    this.map.dispose();
  }

  /** Adds a layer of features above those of the version. */
  addLayer(style: FeatureStyle, zIndex: number = Z.overlay, { prompt = false } = {}): FeatureLayer {
    const layer = new FeatureLayer(style, zIndex);
    layer.prompt = prompt;
    this.map.addLayer(layer);
    return layer;
  }

  removeLayer(layer: FeatureLayer): void {
    this.map.removeLayer(layer);
    layer.dispose();
  }

  /** Adds a raster, such as the changed cells of two versions. */
  addRaster(tiles: Tiles, zIndex: number = Z.masks): RasterLayer {
    const layer = new RasterLayer(tiles, zIndex);
    this.map.addLayer(layer);
    return layer;
  }

  removeRaster(layer: RasterLayer): void {
    this.map.removeLayer(layer);
    layer.tiles.clear();
    layer.dispose();
  }

  /** Leaves features of the version out, because a view draws them itself. */
  hideFeatures(ids: Iterable<string>): void {
    const list = [...ids];
    this.layers.topology.hide(list);
    this.layers.objects.hide(list);
    this.layers.zones.hide(list);
    this.layers.location.hide(list);
  }

  /** Switches the version's features off as a whole, for a view that shows others. */
  showVersion(isShown: boolean): void {
    for (const layer of Object.values(this.layers)) layer.setVisible(isShown);
  }

  fit(box: Box | null = this.site.bounds.peek(), duration = 250): void {
    if (!box) return;
    const least = 2; // metres
    const [a, b, c, d] = box;
    const grown = [
      Math.min(a, (a + c - least) / 2),
      Math.min(b, (b + d - least) / 2),
      Math.max(c, (a + c + least) / 2),
      Math.max(d, (b + d + least) / 2),
    ];
    const isCalm = matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.map.getView().fit(grown, { padding: [48, 48, 48, 48], duration: isCalm ? 0 : duration });
  }

  fitFeatures(features: readonly Feature[]): void {
    this.fit(joinBoxes(features.map(({ geometry }) => boxOf(geometry))));
  }

  select(feature: Feature | null, { show = false } = {}): void {
    this.selected.value = feature;
    go({ feature: feature?.id ?? null }, { replace: true });
    if (feature && show) this.reveal(feature);
  }

  /** Moves the map so that a feature is seen, if it is not. */
  reveal(feature: Feature): void {
    const box = boxOf(feature.geometry);
    const view = this.map.getView();
    const [a = 0, b = 0, c = 0, d = 0] = view.calculateExtent(this.map.getSize());
    const isSeen = box[0] > a && box[1] > b && box[2] < c && box[3] < d;
    const isTiny = Math.max(box[2] - box[0], box[3] - box[1]) < (c - a) / 200;
    if (!isSeen || (isTiny && (view.getResolution() ?? 0) > 0.2))
      this.fit([box[0] - 5, box[1] - 5, box[2] + 5, box[3] + 5]);
  }

  /** Position of a pointer event in local metres. */
  positionOf(event: { clientX: number; clientY: number }): Position {
    return this.map.getEventCoordinate(event as MouseEvent) as Position;
  }

  pick(point: Position, pixels = PICK_PIXELS): Feature[] {
    const reach = pixels * (this.map.getView().getResolution() ?? 1);
    return this.index.near(point, reach).filter((feature) => !isHidden(feature.layer));
  }

  /** Lets a view take clicks instead of selection. Returns the function that ends this; the views may end in any order.
   *
   * isAbove: it acts before all others, however late they begin. */
  takePicks(pick: Picker, { isAbove = false } = {}): () => void {
    const own = { pick, isAbove };
    this.pickers = [...this.pickers, own];
    return () => {
      this.pickers = this.pickers.filter((one) => one !== own);
    };
  }

  /** The one of those that take clicks that acts now. */
  get picker(): Picker | undefined {
    return (this.pickers.findLast(({ isAbove }) => isAbove) ?? this.pickers.at(-1))?.pick;
  }

  private listen(): void {
    const view = this.map.getView();
    this.map.on("pointermove", (event) => {
      this.pointer.value = event.coordinate as Position;
    });
    this.map.getViewport()?.addEventListener("pointerleave", () => {
      this.pointer.value = null;
    });
    this.map.on("singleclick", (event) => {
      const point = event.coordinate as Position;
      const source = event.originalEvent as PointerEvent;
      const feature = this.pick(point, source.pointerType === "touch" ? 22 : PICK_PIXELS)[0] ?? null;
      if (this.picker?.(feature, point, source)) return;
      this.select(feature);
    });
    const showView = () => {
      this.resolution.value = view.getResolution() ?? 1;
      this.rotation.value = view.getRotation();
    };
    view.on("change:resolution", showView);
    view.on("change:rotation", showView);
    this.map.on("moveend", () => {
      const [x = 0, y = 0] = view.getCenter() ?? [];
      const digits = Math.max(0, Math.ceil(-Math.log10(view.getResolution() ?? 1)));
      const turn = Math.round((view.getRotation() * 180) / Math.PI);
      if (this.fitted) {
        go(
          {
            at: `${x.toFixed(digits)},${y.toFixed(digits)},${(view.getResolution() ?? 1).toPrecision(4)}${turn ? `,${turn}` : ""}`,
          },
          { replace: true },
        );
        this.site.extent.value = view.calculateExtent(this.map.getSize()) as Box;
      }
    });
  }

  /** Shows the features of the level; the first time, the place in the address or the whole site. */
  private showFeatures(): void {
    const level = this.site.level.value;
    const features = this.shown.value ?? this.site.features.value;
    const { removed, added } = difference(this.drawn.features, features);
    const isSmall = level === this.drawn.level && removed.size + added.length < MAX_CHANGES;
    this.drawn = { level, features };
    if (isSmall) this.change(removed, added);
    else {
      const onLevel = features.filter((feature) => feature.level === level);
      this.streets = new Streets(features);
      this.index = new FeatureIndex(onLevel);
      for (const [name, layer] of Object.entries(this.layers))
        layer.setFeatures(onLevel.filter((feature) => feature.layer === name));
    }
    for (const [name, layer] of Object.entries(this.layers)) layer.setVisible(!isHidden(name));
    const bounds = this.site.bounds.value;
    const key = `${this.site.name}/${level}`;
    if (this.fitted === key || !bounds) return;
    const isFirst = !this.fitted;
    this.fitted = key;
    untracked(() => {
      const at = isFirst ? param("at")?.split(",").map(Number) : undefined;
      if (at && at.length >= 3 && at.every(Number.isFinite)) {
        const view = this.map.getView();
        view.setCenter([at[0] ?? 0, at[1] ?? 0]);
        view.setResolution(at[2]);
        view.setRotation(((at[3] ?? 0) * Math.PI) / 180);
      } else this.fit(bounds, 0);
      const wanted = isFirst ? this.index.byId.get(param("feature") ?? "") : undefined;
      this.selected.value = wanted ?? null;
    });
  }

  /** Shows other features than before in place of some. An edge looks different once another leads back, or none. */
  private change(removed: Set<Feature>, added: Feature[]): void {
    const streets = [...removed, ...added].filter(({ properties }) => properties.kind === "edge");
    const before = new Set(streets.flatMap((edge) => this.streets.twinsOf(edge)));
    for (const edge of streets) if (removed.has(edge)) this.streets.remove(edge);
    for (const feature of added) this.streets.add(feature);
    const twins = new Set([...before, ...streets.flatMap((edge) => this.streets.twinsOf(edge))]);
    const isHere = ({ level }: Feature) => level === this.drawn.level;
    const come = added.filter(isHere);
    this.index.change([...removed].filter(isHere), come);
    const other = [...twins].filter((twin) => isHere(twin) && !removed.has(twin) && !added.includes(twin));
    for (const [name, layer] of Object.entries(this.layers)) {
      const own = [...come, ...other].filter((feature) => feature.layer === name);
      layer.change(new Set([...removed, ...other].filter((feature) => feature.layer === name)), own);
    }
  }

  /** Shows the base map while it is switched on; a site without a datum has no place on it. */
  private async showBase(): Promise<void> {
    const [base, frame, isShown] = [baseMap.value, this.site.frame.value, isBaseMapShown()];
    this.base?.setVisible(isShown);
    if (this.base || !base || !frame || !isShown) return;
    const layer = await createBaseLayer(base, frame);
    if (this.base || !this.map.getTarget()) return;
    this.base = layer;
    layer.setVisible(isBaseMapShown());
    this.map.addLayer(layer);
  }

  private showRasters(): void {
    const wanted = new Map<string, LayerPart>();
    for (const part of this.site.rasters.value) {
      if (!isHidden(rasterKey(part))) wanted.set(`${part.level}/${rasterKey(part)}/${part.hash}`, part);
    }
    for (const [key, layer] of this.rasters) {
      if (wanted.has(key)) continue;
      this.removeRaster(layer);
      this.rasters.delete(key);
    }
    for (const [key, part] of wanted) if (!this.rasters.has(key)) void this.showRaster(key, part);
  }

  private async showRaster(key: string, part: LayerPart): Promise<void> {
    try {
      const set = await this.site.tiles(part);
      if (this.rasters.has(key) || !this.site.rasters.peek().includes(part)) return;
      const path = this.site.tilePath(part);
      const tiles = new Tiles(set, (z, row, column) => {
        const slice = part.layer === "voxels" ? this.slice.peek() : null;
        const query = { level: part.level, z_min: slice?.[0], z_max: slice?.[1] };
        return tileAddress(path, query, set)(z, row, column);
      });
      this.colourTiles(part, tiles);
      const kind = part.layer as "imagery" | "voxels" | "occupancy";
      const layer = this.addRaster(tiles, isMask(part) ? Z.masks : Z[kind]);
      layer.setOpacity(this.opacity.peek()[rasterKey(part)] ?? 1);
      layer.set("part", part);
      this.rasters.set(key, layer);
    } catch (error) {
      this.rasterProblems.value = [
        ...this.rasterProblems.peek(),
        `${part.layer} ${part.name}: ${(error as Error).message}`,
      ];
    }
  }

  private colourTiles(part: LayerPart, tiles: Tiles): void {
    if (part.layer === "imagery") tiles.recolour(null);
    else if (isMask(part)) tiles.recolour(maskColours(part.name.includes("speed") ? [214, 137, 16] : [196, 43, 68]));
    else tiles.recolour(coloursOf(palette.value, theme.value, part.layer === "voxels" || this.hasPicture.value));
  }

  /** Whether a picture or the base map lies below the grids and features. */
  private readonly hasPicture = computed(
    () =>
      (isBaseMapShown() && this.site.frame.value !== null) ||
      this.site.rasters.value.some((part) => part.layer === "imagery" && !isHidden(rasterKey(part))),
  );

  /** Draws anew after a change of theme, palette or slice, or when a picture comes below. */
  private paintAgain(): void {
    theme.value;
    palette.value;
    this.slice.value;
    this.hasPicture.value;
    if (this.isFirstPainting) {
      this.isFirstPainting = false;
      return;
    }
    requestAnimationFrame(() => {
      for (const layer of [...Object.values(this.layers), this.selection]) layer.repaint();
      for (const layer of this.rasters.values()) this.colourTiles(layer.get("part") as LayerPart, layer.tiles);
    });
  }

  private showOpacity(): void {
    const opacity = this.opacity.value;
    for (const layer of this.rasters.values()) {
      layer.setOpacity(opacity[rasterKey(layer.get("part") as LayerPart)] ?? 1);
    }
    for (const [name, layer] of Object.entries(this.layers)) layer.setOpacity(opacity[name] ?? 1);
  }

  private style(layer: "zones" | "objects" | "topology" | "location"): FeatureStyle {
    if (layer === "zones") {
      return { classOf: zoneClass, paints: () => zonePaints(this.resolution.peek() < 0.12) };
    }
    if (layer === "location") {
      return {
        classOf: () => "fence",
        paints: () => ({ fence: { stroke: colour("fence"), width: 1.5, dash: [8, 5] } }),
      };
    }
    if (layer === "objects") {
      return {
        classOf: ({ properties }) => (properties.name ? "named" : "object"),
        paints: () => {
          const object = {
            stroke: colour("object"),
            fill: `color-mix(in srgb, ${colour("object")} 14%, transparent)`,
            width: 1,
            dot: 5,
            dotsBelow: 1,
          };
          // Ids say nothing: only names are written, as soon as they have room.
          return { object, named: { ...object, labels: this.resolution.peek() < 0.12 } };
        },
      };
    }
    return { classOf: (feature) => this.networkClass(feature), paints: () => this.networkPaints() };
  }

  /** A two-way street is one line: of its two edges one is drawn, without arrows. */
  private networkClass(feature: Feature): string {
    if (feature.properties.kind !== "edge") return "node";
    if (!this.streets.isTwoWay(feature)) return "one-way";
    return String(feature.properties.source) < String(feature.properties.target) ? "two-way" : "";
  }

  private networkPaints() {
    const isNear = this.resolution.peek() < 0.06;
    const rim = this.hasPicture.value ? colour("halo") : undefined;
    return {
      "two-way": { stroke: colour("edge"), width: 1.75, rim },
      "one-way": { stroke: colour("edge"), width: 1.75, rim, arrows: true },
      node: { dot: isNear ? 8 : 5, dotColour: colour("node"), dotsBelow: this.nodeResolution(), labels: isNear },
    };
  }

  /** Coarsest resolution at which nodes are drawn: they would cover the edges beyond it. */
  private nodeResolution(): number {
    const nodes = this.index.byId.size || 1;
    const [a, b, c, d] = this.site.bounds.peek() ?? EMPTY_BOX;
    const spacing = Math.sqrt(Math.max(1, (c - a) * (d - b)) / nodes);
    return spacing / 5;
  }
}

export function isMask(part: { layer: string; name: string }): boolean {
  return part.layer === "occupancy" && /keepout|speed|mask/.test(part.name);
}
