/** Events of the server. The browser resumes at the last one received; what may be missed is read again. */
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

/** Stream of an environment's events (null: of all). Ends with `close`.
 *
 * onReturn: called when the stream is open again. A stream that the server has refused begins with new events: the log may
 * be another one, from a backup, in which its place does not exist. */
export class EventStream {
  private source: EventSource | null = null;
  private timer = 0;
  private pause = 1000;
  private wasLost = false;
  private readonly listeners = new Set<Listener>();

  constructor(
    private readonly environment: string | null,
    private readonly onReturn: () => void,
  ) {
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
    const { environment } = this;
    const source = new EventSource(apiPath(["events"], { environment, robots: environment ? true : null }));
    this.source = source;
    source.onopen = () => {
      live.value = true;
      this.pause = 1000;
      if (this.wasLost) this.onReturn();
      this.wasLost = false;
    };
    source.onerror = () => {
      live.value = false;
      this.wasLost = true;
      if (source.readyState !== EventSource.CLOSED) return; // the browser tries again by itself
      void request("/api/v1/session").catch(() => undefined); // has the session ended, or does the server not answer?
      this.timer = window.setTimeout(() => this.open(), this.pause);
      this.pause = Math.min(this.pause * 2, MAX_PAUSE);
    };
    for (const type of TYPES) {
      source.addEventListener(type, (message: MessageEvent<string>) => {
        const event = { ...JSON.parse(message.data), type } as FleetEvent; // a robot's status has no type
        for (const listener of this.listeners) listener(event);
      });
    }
  }
}
