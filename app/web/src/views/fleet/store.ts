/** The fleet of a site as it changes: one signal for each robot, so that 500 that report redraw only their own rows. */
import { batch, effect, type Signal, signal } from "@preact/signals";
import { type ApiError, apiPath, asApiError, isAbort, request, requestJson } from "../../api/client";
import { type FleetEvent, live } from "../../api/events";
import type { Site } from "../../site";
import type { Overlay, Robot } from "./types";

const PAGE = 1000;
const GATHER = 100;
const ROLLOUT_SECONDS = 10;

/** Time now, ticking each second while the view is open. */
export const now = signal(Date.now());

export class FleetStore {
  readonly names = signal<string[]>([]);
  /** Grows with each batch of changes: for what is computed from all robots. */
  readonly round = signal(0);
  readonly overlays = signal<Overlay[]>([]);
  readonly loaded = signal(false);
  readonly problem = signal<ApiError | null>(null);
  private readonly robots = new Map<string, Signal<Robot>>();
  private readonly incoming = new Map<string, Robot>();
  private readonly stops: (() => void)[] = [];
  private control = new AbortController();
  private timer = 0;

  constructor(readonly site: Site) {
    const tick = setInterval(() => {
      now.value = Date.now();
    }, 1000);
    // The ends of roll-outs are no events.
    const watch = setInterval(() => {
      if (site.channels.peek().some(({ rollout }) => rollout && ["waiting", "watching"].includes(rollout.state)))
        void site.refresh();
    }, ROLLOUT_SECONDS * 1000);
    this.stops.push(
      () => clearInterval(tick),
      () => clearInterval(watch),
      site.events.subscribe((event) => this.receive(event)),
      // Statuses are not kept for those who were away: read them each time the stream has opened.
      effect(() => {
        if (live.value || !this.loaded.peek()) void this.load();
      }),
    );
  }

  close(): void {
    this.control.abort();
    clearTimeout(this.timer);
    for (const stop of this.stops) stop();
  }

  load = async (): Promise<void> => {
    this.control.abort();
    this.control = new AbortController();
    const { signal: stop } = this.control;
    try {
      const [robots, overlays] = await Promise.all([
        readRobots(this.site.name, stop),
        requestJson<Overlay[]>(apiPath(this.site.path("overlays")), { signal: stop }),
        this.site.refresh(),
      ]);
      if (stop.aborted) return;
      batch(() => {
        const present = new Set(robots.map(({ robot }) => robot));
        for (const name of this.robots.keys()) if (!present.has(name)) this.robots.delete(name);
        this.names.value = []; // some may be gone
        this.take(robots);
        this.overlays.value = overlays;
        this.loaded.value = true;
        this.problem.value = null;
      });
    } catch (error) {
      if (!stop.aborted && !isAbort(error)) this.problem.value = asApiError(error);
    }
  };

  /** The status of a robot; components that read its value are drawn again when it reports. */
  robot(name: string): Signal<Robot> | undefined {
    return this.robots.get(name);
  }

  /** All robots as they are now, without subscribing to each. */
  all(): Robot[] {
    return this.names.value.flatMap((name) => this.robots.get(name)?.peek() ?? []);
  }

  forget(name: string): void {
    batch(() => {
      this.robots.delete(name);
      this.names.value = this.names.peek().filter((other) => other !== name);
      this.round.value += 1;
    });
  }

  putOverlay(overlay: Overlay): void {
    const others = this.overlays.peek().filter(({ id }) => id !== overlay.id);
    this.overlays.value = [...others, overlay];
  }

  private receive(event: FleetEvent): void {
    if (event.type === "robot.status") {
      const robot = event as unknown as Robot;
      this.incoming.set(robot.robot, robot);
      // Not an animation frame: those pause in a hidden tab while the messages go on.
      this.timer ||= window.setTimeout(() => {
        this.timer = 0;
        const robots = [...this.incoming.values()];
        this.incoming.clear();
        batch(() => this.take(robots));
      }, GATHER);
    } else if (event.type.startsWith("overlay.")) {
      if (event.overlay) this.putOverlay(event.overlay as Overlay);
      void this.site.refresh();
    }
  }

  private take(robots: readonly Robot[]): void {
    for (const robot of robots) {
      const known = this.robots.get(robot.robot);
      if (known) known.value = robot;
      else this.robots.set(robot.robot, signal(robot));
    }
    if (this.robots.size !== this.names.peek().length) {
      this.names.value = [...this.robots.keys()].sort((a, b) => a.localeCompare(b, undefined, { numeric: true }));
    }
    this.round.value += 1;
  }
}

async function readRobots(environment: string, stop: AbortSignal): Promise<Robot[]> {
  const out: Robot[] = [];
  let path: string | null = apiPath(["robots"], { environment, limit: PAGE });
  while (path) {
    const response: Response = await request(path, { signal: stop });
    out.push(...((await response.json()) as Robot[]));
    path = /<([^>]+)>; rel="next"/.exec(response.headers.get("link") ?? "")?.[1] ?? null;
  }
  return out;
}
