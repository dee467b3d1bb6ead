/** Mistakes found in the version that is shown: for the list of them, and for their number in the rail. */
import { effect, signal } from "@preact/signals";
import { useEffect } from "preact/hooks";
import { type ApiError, api, asApiError, ask, isAbort, online, type Schemas } from "./api/client";
import { refOf, type Site } from "./site";

export type Checks = Schemas["ChecksOut"];
export type Finding = Schemas["FindingOut"];
export type Severity = Finding["severity"];

const PAUSE = 1500;

export class CheckList {
  readonly data = signal<Checks | null>(null);
  readonly problem = signal<ApiError | null>(null);
  readonly loading = signal(false);
  private control = new AbortController();
  private wanted = "";

  constructor(private readonly site: Site) {}

  /** Checks a version, unless that is done or under way. */
  async load(ref: string, isAgain = false): Promise<void> {
    const key = `${ref} ${this.site.version.peek()?.root}`;
    if (key === this.wanted && !isAgain) return;
    this.wanted = key;
    this.control.abort();
    this.control = new AbortController();
    const { signal: stop } = this.control;
    this.loading.value = true;
    this.problem.value = null;
    const params = { path: { env: this.site.name, v: ref } };
    try {
      this.data.value = await ask(api.GET("/api/v1/environments/{env}/versions/{v}/checks", { params, signal: stop }));
    } catch (error) {
      if (isAbort(error) || stop.aborted) return;
      this.problem.value = asApiError(error);
    }
    if (!stop.aborted) this.loading.value = false;
  }

  reload = (): void => void this.load(this.site.exact, true);

  errors(): number {
    return this.data.value?.items.filter(({ severity }) => severity === "error").length ?? 0;
  }
}

const lists = new WeakMap<Site, CheckList>();

export function checksOf(site: Site): CheckList {
  const list = lists.get(site) ?? new CheckList(site);
  lists.set(site, list);
  return list;
}

/** Checks each version that is shown, a little after the map, which comes first. */
export function useChecking(site: Site, pause = PAUSE): CheckList {
  const list = checksOf(site);
  useEffect(() => {
    let timer = 0;
    const stop = effect(() => {
      const version = site.version.value;
      const isBusy = site.loading.value;
      const isOnline = online.value;
      clearTimeout(timer);
      if (version && !isBusy && isOnline) {
        timer = window.setTimeout(() => void list.load(refOf(version), Boolean(list.problem.peek())), pause);
      }
    });
    return () => {
      clearTimeout(timer);
      stop();
    };
  }, [site, list, pause]);
  return list;
}
