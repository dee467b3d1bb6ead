/** Closures: both directions of a street as one, what they are called, where they are, which were in force. No DOM. */
import { batch } from "@preact/signals";
import { api, apiPath, asApiError, ask, request, requestJson } from "../../api/client";
import type { Feature, Geometry } from "../../map/features";
import { nameOf } from "../../map/features";
import type { Frame } from "../../map/frame";
import type { Site } from "../../site";
import { remaining } from "./status";
import type { FleetStore } from "./store";
import type { Overlay } from "./types";

/** One closure for people: an area, or a street with its one or two directions. */
export interface Closure {
  /** Id of the first overlay: that of the closure in links and on the map. */
  id: string;
  overlays: Overlay[];
  first: Overlay;
  state: Overlay["state"];
  title: string;
  isTwoWay: boolean;
}

const TOGETHER = 10_000; // milliseconds between the reports of both directions

/** Joins the overlays of both directions of a street that were reported together and share their state and end. */
export function closuresOf(overlays: readonly Overlay[], byId: ReadonlyMap<string, Feature>): Closure[] {
  const out: Closure[] = [];
  const ways = new Map<string, Closure>();
  for (const overlay of overlays) {
    const ends = overlay.edge ? endsOf(byId.get(overlay.edge)) : null;
    if (ends) {
      const key = [...ends]
        .sort()
        .concat(overlay.state, overlay.reporter, overlay.detail ?? "")
        .join("\n");
      const other = ways.get(key);
      if (
        other &&
        other.overlays.length === 1 &&
        other.first.edge !== overlay.edge &&
        areTogether(other.first, overlay)
      ) {
        other.overlays.push(overlay);
        other.isTwoWay = true;
        other.title = titleOf(overlay, byId, true);
        continue;
      }
      const closure = newClosure(overlay, byId);
      ways.set(key, closure);
      out.push(closure);
    } else out.push(newClosure(overlay, byId));
  }
  return out;
}

function newClosure(overlay: Overlay, byId: ReadonlyMap<string, Feature>): Closure {
  return {
    id: overlay.id,
    overlays: [overlay],
    first: overlay,
    state: overlay.state,
    title: titleOf(overlay, byId, false),
    isTwoWay: false,
  };
}

function areTogether(one: Overlay, other: Overlay): boolean {
  const gap = (a: string, b: string) => Math.abs(Date.parse(a) - Date.parse(b));
  return gap(one.created, other.created) < TOGETHER && gap(one.expires, other.expires) < TOGETHER;
}

export function endsOf(edge: Feature | undefined): [string, string] | null {
  const { source, target } = edge?.properties ?? {};
  return typeof source === "string" && typeof target === "string" ? [source, target] : null;
}

/** The edge that leads back, if the street is two-way. */
export function reverseOf(edge: Feature, features: readonly Feature[]): Feature | null {
  const { source, target } = edge.properties;
  return (
    features.find(
      ({ layer, level, properties }) =>
        layer === "topology" && level === edge.level && properties.source === target && properties.target === source,
    ) ?? null
  );
}

function titleOf(overlay: Overlay, byId: ReadonlyMap<string, Feature>, isTwoWay: boolean): string {
  if (!overlay.edge) return "Area";
  const ends = endsOf(byId.get(overlay.edge));
  if (!ends) return `Edge ${overlay.edge}`;
  const [from, to] = ends.map((id) => nameOf(byId.get(id) ?? ({ id, properties: {} } as Feature)));
  return `${from} ${isTwoWay ? "⇄" : "→"} ${to}`;
}

/** Where a closure is on the map of a version; null if that version has no such edge, or has no datum yet. */
export function geometryOf(overlay: Overlay, byId: ReadonlyMap<string, Feature>, frame: Frame | null): Geometry | null {
  if (overlay.edge) return byId.get(overlay.edge)?.geometry ?? null;
  const geometry = overlay.polygon as Geometry | null | undefined;
  if (!geometry) return null;
  if (overlay.crs !== "wgs84") return geometry;
  return frame && project(geometry, frame);
}

function project(geometry: Geometry, frame: Frame): Geometry {
  const walk = (value: unknown): unknown => {
    const list = value as number[] | unknown[];
    return typeof list[0] === "number" ? frame.toLocal(list as [number, number]) : list.map(walk);
  };
  return { ...geometry, coordinates: walk((geometry as { coordinates: unknown }).coordinates) } as Geometry;
}

/** Features of closures for the map, labelled with the time left. */
export function featuresOf(
  closures: readonly Closure[],
  byId: ReadonlyMap<string, Feature>,
  frame: Frame | null,
  time: number | null,
): Feature[] {
  return closures.flatMap((closure) => {
    const { first, state } = closure;
    const geometry = geometryOf(first, byId, frame);
    if (!geometry) return [];
    const left = time === null ? "" : ` ${remaining(first.expires, time)}`;
    const name = `${state === "pending" ? "reported" : "closed"}${left}`;
    const level = first.edge ? (byId.get(first.edge)?.level ?? first.level) : first.level;
    return { id: closure.id, layer: "closures", level, part: "", geometry, properties: { name, state } };
  });
}

export type Decision = "accept" | "reject" | "end" | "keep";

/** Decides on all directions of a closure, one after the other. Throws ApiError. */
export async function decide(store: FleetStore, closure: Closure, decision: Decision): Promise<Overlay[]> {
  const out: Overlay[] = [];
  for (const { id } of closure.overlays) {
    const path = apiPath(store.site.path("overlays", id, decision));
    out.push(await requestJson<Overlay>(path, { method: "POST" }));
  }
  batch(() => {
    for (const overlay of out) store.putOverlay(overlay);
  });
  return out;
}

/** Changes when a closure ends, in all its directions. Throws ApiError. */
export async function moveEnd(store: FleetStore, closure: Closure, expires: string): Promise<void> {
  const out: Overlay[] = [];
  for (const { id } of closure.overlays) out.push(await patchEnd(store, id, expires));
  batch(() => {
    for (const overlay of out) store.putOverlay(overlay);
  });
}

function patchEnd(store: FleetStore, id: string, expires: string): Promise<Overlay> {
  const params = { path: { env: store.site.name, id } };
  return ask(api.PATCH("/api/v1/environments/{env}/overlays/{id}", { params, body: { expires } }));
}

export interface NewClosure {
  edges?: string[];
  polygon?: Geometry;
  level?: string;
  detail: string;
  expires: string;
  /** Kept by the caller over a failure, so that a repetition reports only what is missing, and gives all the same end. */
  done: Map<string, Overlay>;
}

/** Closes edges or an area for all robots at once. Throws ApiError. */
export async function close(store: FleetStore, wanted: NewClosure): Promise<Overlay[]> {
  const { detail, expires, done } = wanted;
  const common = { kind: "blocked", state: "accepted", expires, ...(detail ? { detail } : {}) };
  const bodies: [string, object][] = wanted.polygon
    ? [["area", { ...common, polygon: wanted.polygon, crs: "local", level: wanted.level }]]
    : (wanted.edges ?? []).map((edge) => [edge, { ...common, edge }]);
  for (const [key, body] of bodies) {
    const reported = done.get(key);
    const moved = reported ? await patchEnd(store, reported.id, expires).catch(nullIfOver) : null;
    const overlay = moved ?? (await report(store, body));
    done.set(key, overlay);
    store.putOverlay(overlay);
  }
  return [...done.values()];
}

function report(store: FleetStore, body: object): Promise<Overlay> {
  return requestJson<Overlay>(apiPath(store.site.path("overlays")), {
    method: "POST",
    headers: { "content-type": "application/json" },
    body: JSON.stringify(body),
  });
}

/** For a closure that has ended, or is no longer stored: its end cannot be changed. Other errors are thrown. */
function nullIfOver(error: unknown): null {
  if ([404, 409].includes(asApiError(error).status)) return null;
  throw error;
}

interface LoggedEvent {
  type: string;
  time: string;
  overlay?: Overlay;
  overlays_digest?: string;
}

/** The closures that a robot had in its map: those after the last event with its digest, before a time.
 *
 * The log of events holds every change of closures with the digest that resulted. Returns null for an unknown digest.
 */
export function closuresAt(log: readonly LoggedEvent[], digest: string | undefined, time: string): Overlay[] | null {
  const force = new Map<string, Overlay>();
  let found: Overlay[] | null = digest === undefined ? [] : null;
  let any = false;
  for (const { type, overlay, overlays_digest, time: at } of log) {
    if (!overlay || !overlays_digest || Date.parse(at) > Date.parse(time)) continue;
    if (type === "overlay.accepted") force.set(overlay.id, overlay);
    else if (type === "overlay.ended") force.delete(overlay.id);
    else continue;
    any = true;
    if (overlays_digest === digest) found = [...force.values()];
  }
  if (!any && found === null) return []; // before the first closure, robots send the digest of none
  return found ?? (force.size === 0 ? [] : null);
}

export async function readLog(site: Site, stop: AbortSignal): Promise<LoggedEvent[]> {
  const path = apiPath(["events"], { environment: site.name, since: 0, follow: "false" });
  const text = await (await request(path, { signal: stop })).text();
  return text
    .split("\n")
    .filter((line) => line.startsWith("data: ") && line.includes('"overlay'))
    .map((line) => JSON.parse(line.slice(6)) as LoggedEvent);
}
