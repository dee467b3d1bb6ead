/** When a channel moves: the choices of the form, as the API takes them. No DOM. */
import type { Schemas } from "../../api/client";

export interface When {
  kind: "now" | "later" | "rollout";
  /** Local time of a `datetime-local` field. */
  at: string;
  /** Percent of robots. */
  ready: string;
  failed: string;
  deadline: string;
  /** Minutes. */
  window: string;
}

export const NOW: When = { kind: "now", at: "", ready: "90", failed: "20", deadline: "", window: "10" };

export function channelBody(version: number, when: When): Schemas["ChannelBody"] {
  if (when.kind === "later") return { version, activate_at: new Date(when.at).toISOString() };
  if (when.kind === "now") return { version };
  return {
    version,
    rollout: {
      ready: share(when.ready),
      failed: share(when.failed),
      deadline: when.deadline ? new Date(when.deadline).toISOString() : null,
      window: Number(when.window) * 60,
    },
  };
}

/** Returns what is missing, or null. */
export function whenProblem(when: When): string | null {
  if (when.kind === "later" && !when.at) return "Set the time of the move.";
  if (when.kind !== "rollout") return null;
  if (!when.ready && !when.failed) return "Set the share of ready robots, of failures, or both.";
  if (when.deadline && !when.ready) return "A deadline needs a share of ready robots.";
  for (const value of [when.ready, when.failed]) {
    if (value && !(Number(value) > 0 && Number(value) <= 100)) return "Shares are from 1 to 100 %.";
  }
  return Number(when.window) > 0 ? null : "Set the minutes to watch for failures.";
}

/** Shows a share from 0 to 1 with up to two decimals: 0.995 is not all, and 0.004 not none. */
export function percent(value: number): string {
  return `${Number((value * 100).toFixed(2))} %`;
}

export function exactTime(time: string): string {
  return new Date(time).toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "short" });
}

/** Value of a `datetime-local` field some hours ahead, on the full hour. */
export function hoursAhead(hours: number, now = new Date()): string {
  const time = new Date(now.getTime() + hours * 3_600_000);
  time.setMinutes(0, 0, 0);
  const pad = (value: number) => String(value).padStart(2, "0");
  return `${time.getFullYear()}-${pad(time.getMonth() + 1)}-${pad(time.getDate())}T${pad(time.getHours())}:00`;
}

function share(text: string): number | null {
  return text ? Number(text) / 100 : null;
}
