/** Events of the server, resumed by the browser at the last one received. */
import { signal } from "@preact/signals";
import { apiPath, request } from "./client";

export interface FleetEvent {
  sequence: number;
  type: string;
  environment: string;
  version: number;
  root: string;
  channel?: string;
  message?: string;
  author?: string;
  time: string;
  [member: string]: unknown;
}

type Listener = (event: FleetEvent) => void;

const TYPES = [
  "environment.created",
  "environment.deleted",
  "version.created",
  "channel.planned",
  "channel.cancelled",
  "channel.moved",
  "overlay.created",
  "overlay.accepted",
  "overlay.rejected",
  "overlay.expired",
  "overlay.ended",
  "robot.status",
];

const MAX_PAUSE = 30_000;

/** Whether events arrive. */
export const live = signal(false);

/** Stream of an environment's events (null: of all). Ends with `close`. */
export class EventStream {
  private source: EventSource | null = null;
  private timer = 0;
  private pause = 1000;
  private last = "";
  private readonly listeners = new Set<Listener>();

  constructor(private readonly environment: string | null) {
    this.open();
  }

  /** Calls a function for each event; returns the function that ends this. */
  subscribe(listener: Listener): () => void {
    this.listeners.add(listener);
    return () => this.listeners.delete(listener);
  }

  close(): void {
    clearTimeout(this.timer);
    this.source?.close();
    this.source = null;
    live.value = false;
  }

  private open(): void {
    const source = new EventSource(
      apiPath(["events"], { environment: this.environment, since: this.last, robots: this.environment ? true : null }),
    );
    this.source = source;
    source.onopen = () => {
      live.value = true;
      this.pause = 1000;
    };
    source.onerror = () => {
      live.value = false;
      if (source.readyState !== EventSource.CLOSED) return; // the browser tries again by itself
      void request("/api/v1/session").catch(() => undefined); // has the session ended, or does the server not answer?
      this.timer = window.setTimeout(() => this.open(), this.pause);
      this.pause = Math.min(this.pause * 2, MAX_PAUSE);
    };
    for (const type of TYPES) {
      source.addEventListener(type, (message: MessageEvent<string>) => {
        if (message.lastEventId) this.last = message.lastEventId;
        const event = { ...JSON.parse(message.data), type } as FleetEvent; // a robot's status has no type
        for (const listener of this.listeners) listener(event);
      });
    }
  }
}
