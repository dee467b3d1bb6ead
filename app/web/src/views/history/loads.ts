/** Loading of history, comparisons and impact. */
import { useEffect, useState } from "preact/hooks";
import {
  api,
  ApiError,
  apiPath,
  ask,
  type Channel,
  isAbort,
  type LayerPart,
  request,
  requestJson,
  type Schemas,
  type Version,
} from "../../api/client";
import { type Loaded, useLoaded } from "../../api/loaded";
import type { Site } from "../../site";
import { attempt } from "../../ui/toast";
import { type Change, changeOf, type WireChange } from "./changes";
import { earlierVersion } from "./earlier";

const PAGE = 50;
const FEATURE_PAGE = 5000;
/** Changed features above which the rest is only counted. */
export const MAX_CHANGES = 20_000;

interface VersionPage {
  versions: Version[];
  /** Address of the next page. */
  next: string | null;
}

async function loadPage(address: string, signal?: AbortSignal): Promise<VersionPage> {
  const response = await request(address, signal ? { signal } : {});
  const next = /<([^>]+)>;\s*rel="?next"?/.exec(response.headers.get("link") ?? "")?.[1] ?? null;
  return { versions: (await response.json()) as Version[], next };
}

export interface Versions extends Loaded<VersionPage> {
  more: (() => void) | null;
  loadingMore: boolean;
}

/** Versions, newest first; read again when the head moves, without forgetting the older pages. */
export function useVersions(site: Site): Versions {
  const head = site.environment.value?.version;
  const [older, setOlder] = useState<VersionPage | null>(null);
  const [loadingMore, setLoadingMore] = useState(false);
  const [latest, setLatest] = useState<VersionPage | undefined>(undefined);
  const first = useLoaded(
    (signal) => loadPage(apiPath(site.path("versions"), { limit: PAGE }), signal),
    [site.name, head],
  );
  useEffect(() => {
    if (first.data) setLatest(first.data);
  }, [first.data]);
  const page = first.data ?? latest;
  const seen = new Set<number>();
  const versions = [...(page?.versions ?? []), ...(older?.versions ?? [])].filter(
    ({ version }) => !seen.has(version) && seen.add(version),
  );
  const next = older ? older.next : (page?.next ?? null);
  const more = async (address: string) => {
    setLoadingMore(true);
    const loaded = await attempt(() => loadPage(address));
    if (loaded)
      setOlder((before) => ({ versions: [...(before?.versions ?? []), ...loaded.versions], next: loaded.next }));
    setLoadingMore(false);
  };
  return {
    ...first,
    data: page && { versions, next },
    more: next ? () => void more(next) : null,
    loadingMore,
  };
}

export interface Comparison {
  from: string;
  to: string;
  changes: Change[];
  /** Number of changed features, of which at most MAX_CHANGES are loaded. */
  total: number;
  layers: Record<string, Record<string, unknown>>;
  rasters: RasterChange[];
}

export interface RasterChange {
  layer: "occupancy" | "imagery" | "voxels";
  name: string;
  level: string;
  before: LayerPart | null;
  after: LayerPart | null;
}

export async function loadComparison(site: Site, from: string, to: string, signal: AbortSignal): Promise<Comparison> {
  const query = { from, to };
  const at = (v: string) =>
    api.GET("/api/v1/environments/{env}/versions/{v}/layers", { params: { path: { env: site.name, v } }, signal });
  const [diff, before, after, features] = await Promise.all([
    requestJson<Schemas["DiffOut"]>(apiPath(site.path("diff"), query), { signal }),
    ask(at(from)),
    ask(at(to)),
    loadChanges(site, from, to, signal),
  ]);
  return {
    from,
    to,
    changes: features.changes,
    total: features.total,
    layers: diff.layers as Comparison["layers"],
    rasters: rasterChanges(before as LayerPart[], after as LayerPart[]),
  };
}

export async function loadChanges(site: Site, from: string, to: string, signal: AbortSignal) {
  const wires: WireChange[] = [];
  let cursor: string | null = null;
  let total = 0;
  do {
    const query = { from, to, format: "geojson", crs: "local", limit: FEATURE_PAGE, cursor };
    const page: Schemas["DiffFeaturesOut"] = await requestJson(apiPath(site.path("diff"), query), { signal });
    wires.push(...page.features);
    total = page.numberMatched ?? wires.length;
    cursor = page.next ?? null;
  } while (cursor && wires.length < MAX_CHANGES);
  return { changes: wires.map(changeOf), total };
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

/** The version that a channel had before its present one; null if it had none, undefined while it is sought. */
export function useEarlier(site: Site, channel: Channel): number | null | undefined {
  const { data } = useLoaded(
    async (signal) => {
      if (channel.version === null) return null;
      const { rollout } = channel;
      if (rollout?.version === channel.version && rollout.moved && rollout.before !== null) return rollout.before;
      return readEarlier(site, channel, signal);
    },
    [site.name, channel.channel, channel.version, channel.sequence],
  );
  return data;
}

/** Reads events from the channel's last move on, until it is found. */
async function readEarlier(site: Site, channel: Channel, signal: AbortSignal): Promise<number | null> {
  const query = { environment: site.name, since: Math.max(0, channel.sequence - 1), follow: false };
  try {
    const response = await request(apiPath(["events"], query), { signal });
    const reader = response.body?.pipeThrough(new TextDecoderStream()).getReader();
    let text = "";
    while (reader) {
      const { value, done } = await reader.read();
      text += value ?? "";
      const found = earlierVersion(text, channel.channel, channel.version, done);
      if (found !== undefined || done) {
        void reader.cancel().catch(() => undefined);
        return found ?? null;
      }
    }
  } catch (error) {
    if (isAbort(error) || !(error instanceof ApiError)) throw error;
  }
  return null; // the server keeps those events no more
}

export interface PromoteFacts {
  impact: Schemas["ImpactOut"] | null;
  changes: Change[];
  errors: number;
  warnings: number;
}

export async function loadFacts(
  site: Site,
  from: number | null,
  to: string,
  signal: AbortSignal,
): Promise<PromoteFacts> {
  const { impact: impactPath, checks: checksPath } = {
    impact: apiPath(site.path("impact"), { from, to }),
    checks: apiPath(site.path("versions", to, "checks")),
  };
  const [impact, changes, checks] = await Promise.all([
    from === null ? null : requestJson<Schemas["ImpactOut"]>(impactPath, { signal }),
    from === null ? null : loadChanges(site, String(from), to, signal),
    requestJson<Schemas["ChecksOut"]>(checksPath, { signal }),
  ]);
  const countOf = (severity: string) => checks.items.filter((item) => item.severity === severity).length;
  return { impact, changes: changes?.changes ?? [], errors: countOf("error"), warnings: countOf("warning") };
}
