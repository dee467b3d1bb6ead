/** Loading of history, comparisons and impact. */
import { useEffect, useState } from "preact/hooks";
import {
  ApiError,
  apiPath,
  type Channel,
  isAbort,
  request,
  requestJson,
  type Schemas,
  type Version,
} from "../../api/client";
import { type Loaded, useLoaded } from "../../api/loaded";
import { type Change, loadChanges } from "../../map/changes";
import type { Site } from "../../site";
import { attempt } from "../../ui/toast";
import { earlierVersion } from "./earlier";

const PAGE = 50;

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
