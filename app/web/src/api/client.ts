/** Typed calls of the server's API. The types come from its OpenAPI document (`npm run types`). */
import { effect, signal } from "@preact/signals";
import createClient from "openapi-fetch";
import type { components, paths } from "./schema";

export type Schemas = components["schemas"];
export type Environment = Schemas["EnvironmentOut"];
export type Version = Schemas["VersionOut"];
export type DryRun = Schemas["DryRunOut"];
export type Raster = Schemas["RasterOut"];
export type LayerPart = Schemas["LayerOut"];
export type Channel = Schemas["ChannelOut"];
export type Robot = Schemas["RobotOut"];
export type Problem = Schemas["ProblemOut"];
export type Role = "viewer" | "mirror" | "robot" | "editor" | "admin";

/** Whether the server answered the last request. */
export const online = signal(true);

/** Number of 401 responses in the present session, which watches it. */
export const unauthenticated = signal(0);

/** Number of times that the server was back, or a session began: what could not be loaded is loaded again. */
export const returns = signal(0);

const ASK_AGAIN = 3000;
const LONGEST_SILENCE = 10_000; // milliseconds

let wasOnline = true;

effect(() => {
  if (online.value) {
    if (!wasOnline) returns.value = returns.peek() + 1;
    wasOnline = true;
    return;
  }
  wasOnline = false;
  const timer = setInterval(() => {
    void doesAnswer().then((isBack) => {
      if (isBack) online.value = true;
    });
  }, ASK_AGAIN);
  return () => clearInterval(timer);
});

function doesAnswer(signal?: AbortSignal): Promise<boolean> {
  return fetch("/healthz", { cache: "no-store", signal }).then(
    ({ ok }) => ok,
    () => false,
  );
}

export const api = createClient<paths>({ credentials: "same-origin", fetch: watchedFetch });

/** A failed request: the server's problem, or that it did not answer. */
export class ApiError extends Error {
  constructor(readonly problem: Problem) {
    super(problem.detail);
    this.name = "ApiError";
  }

  static offline(): ApiError {
    const detail = "the server does not answer: check the network; nothing is lost";
    return new ApiError({ type: "urn:fleetmap:problem:offline", title: "Offline", status: 0, detail });
  }

  get status(): number {
    return this.problem.status;
  }

  /** Whether there was no answer: the request may be repeated later. */
  get isOffline(): boolean {
    return this.problem.status === 0;
  }
}

/** Waits for a call and returns its body. Throws ApiError. */
export async function ask<T>(call: Promise<{ data?: T; error?: unknown; response: Response }>): Promise<T> {
  const { data, error, response } = await call;
  if (error !== undefined || !response.ok) throw new ApiError(asProblem(error, response));
  return data as T;
}

/** Fetches a path that OpenAPI gives no JSON type, such as a map. Throws ApiError. */
export async function request(path: string, init: RequestInit = {}): Promise<Response> {
  const response = await watchedFetch(new Request(path, { credentials: "same-origin", ...init }));
  if (!response.ok) throw new ApiError(asProblem(await response.json().catch(() => undefined), response));
  return response;
}

export async function requestJson<T>(path: string, init: RequestInit = {}): Promise<T> {
  return (await request(path, init)).json() as Promise<T>;
}

/** Builds a path below the API; parts are quoted, empty values of the query left out. */
export function apiPath(
  parts: (string | number)[],
  query: Record<string, string | number | boolean | null | undefined> = {},
) {
  const search = new URLSearchParams();
  for (const [name, value] of Object.entries(query)) {
    if (value !== null && value !== undefined && value !== "") search.set(name, String(value));
  }
  const text = search.toString();
  return `/api/v1/${parts.map((part) => encodeURIComponent(part)).join("/")}${text ? `?${text}` : ""}`;
}

export function asApiError(error: unknown): ApiError {
  if (error instanceof ApiError) return error;
  const detail = error instanceof Error ? error.message : String(error);
  return new ApiError({ type: "about:blank", title: "The page failed", status: -1, detail });
}

export function isAbort(error: unknown): boolean {
  return error instanceof DOMException && error.name === "AbortError";
}

/** Whether a proxy says that the server does not answer: errors of the server itself are problem documents.
 *
 * A proxy also gives up single slow requests (504) of a server that answers others. */
export async function isSilent(status: number, mediaType: string | null): Promise<boolean> {
  if (![502, 503, 504].includes(status) || mediaType?.startsWith("application/problem+json")) return false;
  return status !== 504 || !(await doesAnswer(AbortSignal.timeout(LONGEST_SILENCE)));
}

/** Counts a 401 response, unless a session began after its request was sent. since: `returns` at that time. */
export function countRefusal(status: number, since: number): void {
  if (status === 401 && returns.peek() === since) unauthenticated.value += 1;
}

async function watchedFetch(input: Request): Promise<Response> {
  const since = returns.peek();
  const response = await fetch(input).catch((error) => {
    if (isAbort(error)) throw error;
    return null;
  });
  if (!response || (await isSilent(response.status, response.headers.get("content-type")))) {
    online.value = false;
    throw ApiError.offline();
  }
  countRefusal(response.status, since);
  online.value = response.headers.get("fleetmap-offline") === null; // the service worker marks what it kept
  return response;
}

export function asProblem(body: unknown, response: { status: number; statusText: string }): Problem {
  if (typeof body === "object" && body !== null && "detail" in body) return body as Problem;
  const text = response.statusText || `HTTP status ${response.status}`;
  const detail =
    response.status === 504 ? "it took longer than the proxy waits; the server may still be at work" : text;
  return { type: "about:blank", title: text, status: response.status, detail };
}
