/** The open environment: which version is shown, its parts and features. */
import { batch, computed, effect, signal } from "@preact/signals";
import { param } from "./address";
import {
  type ApiError,
  api,
  apiPath,
  asApiError,
  ask,
  type Channel,
  type DryRun,
  type Environment,
  type LayerPart,
  type Raster,
  requestJson,
  returns,
  type Version,
} from "./api/client";
import { EventStream } from "./api/events";
import { type Box, type Feature, fromWire, joinBoxes, type LayerName, type WireFeature } from "./map/features";
import { createFrame, type Frame } from "./map/frame";
import { describeTiles } from "./map/tiles";

export const VECTOR_LAYERS: LayerName[] = ["zones", "objects", "topology", "location"];

/** Features above which a layer is loaded by extent only. */
export const MAX_FEATURES = 60_000;
const PAGE = 10_000;
/** Ids that are read at once; the address of the request must not be too long. */
const MAX_IDS = 100;

type Query = Parameters<typeof apiPath>[1];

/** A version as addresses name it. */
export function refOf(version: Version | DryRun): string {
  return version.version === null ? version.id : String(version.version);
}

export class Site {
  readonly environment = signal<Environment | null>(null);
  readonly channels = signal<Channel[]>([]);
  readonly version = signal<Version | DryRun | null>(null);
  readonly parts = signal<LayerPart[]>([]);
  readonly features = signal<Feature[]>([]);
  readonly frame = signal<Frame | null>(null);
  readonly problem = signal<ApiError | null>(null);
  readonly loading = signal(true);
  /** Layers with too many features, which are shown by extent. */
  readonly partial = signal<LayerName[]>([]);
  /** Extent of the map, when something is loaded by extent. */
  readonly extent = signal<Box | null>(null);
  readonly events: EventStream;

  /** The version in the address: a number, channel, or `latest`; else production, else the head. */
  readonly ref = computed(() => {
    const asked = param("version");
    if (asked) return asked;
    return this.channels.value.some(({ channel, version }) => channel === "production" && version !== null)
      ? "production"
      : "latest";
  });

  readonly levels = computed(() => {
    const names = new Set(this.parts.value.map(({ level }) => level));
    return names.size ? [...names].sort((a, b) => a.localeCompare(b, undefined, { numeric: true })) : ["ground"];
  });

  readonly level = computed(() => {
    const asked = param("level");
    if (asked && this.levels.value.includes(asked)) return asked;
    const counts = new Map<string, number>();
    for (const { level, count } of this.parts.value) counts.set(level, (counts.get(level) ?? 0) + count);
    return [...counts].sort((a, b) => b[1] - a[1])[0]?.[0] ?? this.levels.value[0] ?? "ground";
  });

  readonly bounds = computed<Box | null>(() =>
    joinBoxes(
      this.parts.value
        .filter(({ level }) => level === this.level.value)
        .map(({ bounds }) => bounds.local)
        .filter((box) => box !== null && box !== undefined),
    ),
  );

  readonly rasters = computed(() =>
    this.parts.value.filter(
      ({ layer, level }) => ["occupancy", "imagery", "voxels"].includes(layer) && level === this.level.value,
    ),
  );

  private readonly stops: (() => void)[] = [];
  private control = new AbortController();
  private extentControl = new AbortController();

  constructor(readonly name: string) {
    this.events = new EventStream(name, () => void this.refresh());
    this.stops.push(
      this.events.subscribe((event) => {
        if (event.type.startsWith("version.") || event.type.startsWith("channel.")) this.refresh();
      }),
    );
    void this.loadEnvironment().then(() => {
      this.stops.push(effect(() => void this.loadVersion(this.ref.value)));
      this.stops.push(effect(() => void this.loadByExtent(this.extent.value)));
    });
    const since = returns.peek();
    this.stops.push(
      effect(() => {
        if (returns.value > since) void this.refresh().then(() => this.loadByExtent(this.extent.peek()));
      }),
    );
  }

  close(): void {
    this.control.abort();
    this.extentControl.abort();
    this.events.close();
    for (const stop of this.stops) stop();
  }

  /** Path of the environment, for calls. */
  path(...parts: (string | number)[]): (string | number)[] {
    return ["environments", this.name, ...parts];
  }

  /** Number of the version shown; null for a dry run, and before it is loaded. */
  get number(): number | null {
    return this.version.value?.version ?? null;
  }

  /** The version shown, as addresses name it: its number, or `dry:…`. */
  get exact(): string {
    const version = this.version.value;
    return version ? refOf(version) : "latest";
  }

  channelsAt(version: number): string[] {
    return this.channels.value.filter((one) => one.version === version).map(({ channel }) => channel);
  }

  tilePath(part: LayerPart): (string | number)[] {
    return this.path("versions", this.exact, "tiles", part.layer, part.name);
  }

  async tiles(part: LayerPart): Promise<Raster> {
    return describeTiles<Raster>(this.tilePath(part), { level: part.level });
  }

  /** Reads the environment and its channels again, and the version if its channel has moved. */
  refresh = async (): Promise<void> => {
    await this.loadEnvironment();
    await this.loadVersion(this.ref.peek());
  };

  private async loadEnvironment(): Promise<void> {
    const params = { path: { env: this.name } };
    try {
      const [environment, channels] = await Promise.all([
        ask(api.GET("/api/v1/environments/{env}", { params })),
        ask(api.GET("/api/v1/environments/{env}/channels", { params })),
      ]);
      const hadDatum = JSON.stringify(this.environment.peek()?.datum);
      batch(() => {
        this.environment.value = environment;
        this.channels.value = channels;
        this.problem.value = null;
      });
      if (environment.datum && JSON.stringify(environment.datum) !== hadDatum) {
        this.frame.value = await createFrame(environment.datum);
      }
    } catch (error) {
      this.problem.value = asApiError(error);
      this.loading.value = false;
    }
  }

  private async loadVersion(ref: string): Promise<void> {
    const params = { path: { env: this.name, v: ref } };
    this.control.abort();
    this.control = new AbortController();
    const { signal: stop } = this.control;
    try {
      const answer = await ask(api.GET("/api/v1/environments/{env}/versions/{v}", { params, signal: stop }));
      const version = answer as Version | DryRun;
      if (version.root === this.version.peek()?.root) {
        this.version.value = version;
        this.problem.value = null;
        if (this.extentControl.signal.aborted) void this.loadByExtent(this.extent.peek());
        return; // the same content under another number
      }
      this.extentControl.abort();
      this.loading.value = true;
      const shown = refOf(version);
      const exact = { path: { env: this.name, v: shown } };
      const parts = await ask(
        api.GET("/api/v1/environments/{env}/versions/{v}/layers", { params: exact, signal: stop }),
      );
      const counts = new Map<string, number>();
      for (const { layer, count } of parts) counts.set(layer, (counts.get(layer) ?? 0) + count);
      const chosen = VECTOR_LAYERS.filter((layer) => counts.get(layer));
      const small = chosen.filter((layer) => (counts.get(layer) ?? 0) <= MAX_FEATURES);
      const lists = await Promise.all(small.map((layer) => this.loadLayer(shown, layer, stop)));
      if (stop.aborted) return;
      batch(() => {
        this.version.value = version;
        this.parts.value = parts as LayerPart[];
        this.features.value = lists.flat();
        this.partial.value = chosen.filter((layer) => !small.includes(layer));
        this.problem.value = null;
      });
    } catch (error) {
      if (!stop.aborted) this.problem.value = asApiError(error);
    } finally {
      if (!stop.aborted) this.loading.value = false;
    }
  }

  private async loadLayer(version: string, layer: LayerName, stop: AbortSignal, bbox?: Box): Promise<Feature[]> {
    const query = bbox ? { crs: "local", bbox: bbox.join(","), limit: PAGE } : { crs: "local" };
    return this.readLayer(version, layer, query, stop);
  }

  private async readLayer(version: string, layer: LayerName, query: Query, stop?: AbortSignal): Promise<Feature[]> {
    const path = apiPath(this.path("versions", version, "layers", layer), query);
    const { features } = await requestJson<{ features: WireFeature[] }>(path, { signal: stop });
    return features.map((wire) => fromWire(layer, wire)).filter((feature) => feature !== null);
  }

  /** Returns those of the features with some ids that the version shown has, wherever they are. Throws ApiError. */
  async readFeatures(layer: LayerName, ids: readonly string[]): Promise<Feature[]> {
    const out: Feature[] = [];
    for (let at = 0; at < ids.length; at += MAX_IDS) {
      const query = { crs: "local", ids: ids.slice(at, at + MAX_IDS).join(",") };
      out.push(...(await this.readLayer(this.exact, layer, query)));
    }
    return out;
  }

  private async loadByExtent(extent: Box | null): Promise<void> {
    const layers = this.partial.value;
    const version = this.version.peek();
    this.extentControl.abort();
    if (!layers.length || !extent || !version) return;
    this.extentControl = new AbortController();
    const { signal: stop } = this.extentControl;
    try {
      const lists = await Promise.all(layers.map((layer) => this.loadLayer(refOf(version), layer, stop, extent)));
      if (stop.aborted) return;
      const others = this.features.peek().filter(({ layer }) => !layers.includes(layer as LayerName));
      this.features.value = [...others, ...lists.flat()];
    } catch (error) {
      if (!stop.aborted) this.problem.value = asApiError(error);
    }
  }
}

/** The open site; null in the list of sites. */
export const site = signal<Site | null>(null);

effect(() => {
  const name = param("site");
  const open = site.peek();
  if (open?.name === name) return;
  open?.close();
  site.value = name ? new Site(name) : null;
});
