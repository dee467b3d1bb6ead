/** What robots' reports mean: standing, lag in plain words, how far a channel has converged. No DOM. */
import type { Channel } from "../../api/client";
import { ago, count } from "../../ui/text";
import { percent } from "../history/when";
import type { Robot } from "./types";

/** Every robot has one standing: what an operator wants to tell apart at a glance. */
export type Standing = "current" | "behind" | "failed" | "silent";

export const STANDINGS: Standing[] = ["failed", "silent", "behind", "current"];

export const STANDING_NAMES: Record<Standing, string> = {
  current: "up to date",
  behind: "behind",
  failed: "failed",
  silent: "silent",
};

export function standingOf(robot: Robot): Standing {
  if (!robot.online) return "silent";
  if (robot.lag && !robot.lag.differs) return "current";
  if (robot.state === "failed") return "failed";
  return robot.lag ? "behind" : "current";
}

/** Lag in plain words, such as "2 changes behind since 5 min". */
export function lagText(robot: Robot, channels: readonly Channel[], now = Date.now()): string {
  const { lag } = robot;
  if (!lag) return "its channel has no version";
  if (!lag.differs) return "up to date";
  const channel = channels.find((one) => one.channel === robot.channel);
  if (channel && robot.holds?.root === channel.root && lag.since)
    return `closures not taken since ${lasting(lag.since, now)}`;
  const behind = lag.events ? `${count(lag.events, "change")} behind` : "not the map of its channel";
  return lag.since ? `${behind} since ${lasting(lag.since, now)}` : behind;
}

/** A duration as people say it: "5 min". */
export function lasting(since: string, now = Date.now()): string {
  const seconds = Math.max(0, (now - Date.parse(since)) / 1000);
  if (seconds < 60) return `${Math.round(seconds)} s`;
  if (seconds < 3600) return `${Math.round(seconds / 60)} min`;
  if (seconds < 86_400) return `${Math.round(seconds / 3600)} h`;
  return count(Math.round(seconds / 86_400), "day");
}

/** Time left, ticking: "4:09", "1 h 20 min", "3 days". */
export function remaining(until: string, now: number): string {
  const seconds = Math.max(0, Math.round((Date.parse(until) - now) / 1000));
  if (seconds < 3600) return `${Math.floor(seconds / 60)}:${String(seconds % 60).padStart(2, "0")}`;
  if (seconds < 86_400) return `${Math.floor(seconds / 3600)} h ${Math.floor((seconds % 3600) / 60)} min`;
  return count(Math.round(seconds / 86_400), "day");
}

export function clock(time: string): string {
  const at = new Date(time);
  const today = at.toDateString() === new Date().toDateString();
  return at.toLocaleString(
    "en-GB",
    today
      ? { hour: "2-digit", minute: "2-digit" }
      : { day: "numeric", month: "short", hour: "2-digit", minute: "2-digit" },
  );
}

/** State in words, with what it is about. */
export function stateText(robot: Robot): string {
  switch (robot.state) {
    case "downloading":
      return `downloading v${robot.version}`;
    case "ready":
      return `has v${robot.version}, not running it yet`;
    case "failed":
      return `v${robot.version} failed`;
    default:
      return `runs v${robot.version}`;
  }
}

/** Whether a robot runs a channel's map with the closures in force. */
export function holds(robot: Robot, channel: Channel): boolean {
  return robot.holds?.root === channel.root && digestOf(robot, channel) === channel.overlays?.digest;
}

/** Digest of the closures in a robot's map; one that names none has no closures. */
function digestOf(robot: Robot, channel: Channel): string | undefined {
  return robot.holds?.overlays ?? (channel.overlays?.count === 0 ? channel.overlays.digest : undefined);
}

/** Robots with one and the same map: equal root and equal closures. */
export interface Group {
  key: string;
  version: number | null;
  root: string | null;
  closures: string | null;
  robots: string[];
  /** Whether this is the channel's map. */
  isCurrent: boolean;
}

export interface Convergence {
  total: number;
  online: number;
  holding: number;
  failed: number;
  lagging: number;
  ready: number;
  /** Time since which all robots run the channel's map, or null. */
  since: string | null;
  groups: Group[];
  silent: Robot[];
}

/** Computes what the server's `/channels` counts, from the robots' statuses as they arrive. */
export function convergence(channel: Channel, robots: Iterable<Robot>): Convergence {
  const out: Convergence = {
    total: 0,
    online: 0,
    holding: 0,
    failed: 0,
    lagging: 0,
    ready: 0,
    since: null,
    groups: [],
    silent: [],
  };
  const groups = new Map<string, Group>();
  const planned = channel.planned?.root as string | undefined;
  let since = channel.time;
  for (const robot of robots) {
    if (robot.channel !== channel.channel) continue;
    out.total += 1;
    if (robot.online) out.online += 1;
    else out.silent.push(robot);
    const isCurrent = holds(robot, channel);
    if (isCurrent) {
      out.holding += 1;
      if (robot.holds && robot.holds.since > since) since = robot.holds.since;
    } else if (robot.state === "failed") out.failed += 1;
    else out.lagging += 1;
    if (planned && robot.vouched && isReady(robot, planned)) out.ready += 1;
    addToGroup(groups, robot, channel, isCurrent);
  }
  if (out.total && out.holding === out.total) out.since = since;
  out.groups = [...groups.values()].sort(
    (a, b) => Number(b.isCurrent) - Number(a.isCurrent) || b.robots.length - a.robots.length,
  );
  return out;
}

function isReady(robot: Robot, root: string): boolean {
  return (["ready", "active"].includes(robot.state) && robot.root === root) || robot.holds?.root === root;
}

function addToGroup(groups: Map<string, Group>, robot: Robot, channel: Channel, isCurrent: boolean): void {
  const closures = digestOf(robot, channel) ?? null;
  const key = robot.holds ? `${robot.holds.root}/${closures}` : "none";
  const group = groups.get(key) ?? {
    key,
    version: robot.holds?.version ?? null,
    root: robot.holds?.root ?? null,
    closures,
    robots: [],
    isCurrent,
  };
  groups.set(key, group);
  group.robots.push(robot.robot);
}

/** Names the first few: "mower-1, mower-2 and 3 more". */
export function some(names: readonly string[], shown = 4): string {
  if (names.length <= shown + 1) return names.join(", ");
  return `${names.slice(0, shown).join(", ")} and ${names.length - shown} more`;
}

export interface Rollout {
  state: string;
  version: number;
  ready: number | null;
  failed: number | null;
  activate_at: string | null;
  deadline: string | null;
  window: number;
  before: number | null;
  moved: string | null;
  detail: string;
}

/** What a channel is about to do, in plain words; null: nothing. */
export function plannedText(channel: Channel, found: Convergence): string | null {
  const planned = channel.planned as { version: number; activate_at: string | null } | null | undefined;
  const rollout = channel.rollout as Rollout | null | undefined;
  if (rollout?.state === "waiting") {
    const parts = [`Roll-out of v${rollout.version}:`];
    if (rollout.ready !== null)
      parts.push(`${found.ready} of ${found.total} have it, it starts at ${percent(rollout.ready)} of those online`);
    if (rollout.activate_at) parts.push(`not before ${clock(rollout.activate_at)}`);
    if (rollout.deadline) parts.push(`given up at ${clock(rollout.deadline)}`);
    return parts.join(" ");
  }
  if (rollout?.state === "watching") {
    const end = rollout.moved ? new Date(Date.parse(rollout.moved) + rollout.window * 1000).toISOString() : null;
    const back = rollout.failed !== null ? `: goes back to v${rollout.before} if ${percent(rollout.failed)} fail` : "";
    return `Watching v${rollout.version}${end ? ` until ${clock(end)}` : ""}${back}`;
  }
  if (!planned) return null;
  return `Moves to v${planned.version}${planned.activate_at ? ` at ${clock(planned.activate_at)}, ${ago(planned.activate_at)}` : ""}`;
}

/** How the last roll-out ended, when an operator should know. */
export function endedText(channel: Channel): string | null {
  const rollout = channel.rollout as Rollout | null | undefined;
  if (!rollout || !["failed", "rolled_back", "expired"].includes(rollout.state)) return null;
  const words: Record<string, string> = { failed: "cancelled", rolled_back: "rolled back", expired: "given up" };
  return `Roll-out of v${rollout.version} ${words[rollout.state]}: ${rollout.detail}`;
}

/** What a robot ran at a time: its last `active` report received before; null if there is none. */
export function reportAt<T extends { state: string; received: string }>(history: readonly T[], time: string): T | null {
  const at = Date.parse(time);
  return history.find(({ state, received }) => state === "active" && Date.parse(received) <= at) ?? null;
}
