/** A proxy that answers in the server's place counts as no answer, but not if one request was too slow for it.
 *
 * Run by tests/web/test_modules.py. */
import { listeners, require } from "../in-node";
import "../../public/service-worker.js";
import { asApiError, online, request, returns } from "./client";
import { sendForm } from "./upload";

const ENVIRONMENTS = "http://page/api/v1/environments";

/** What the server or the proxy before it answers; null: the connection fails. */
let answer: (() => Response) | null = null;

/** Whether `/healthz` answers. */
let isAlive = false;
let requests = 0;

globalThis.fetch = async (input) => {
  if (input === "/healthz") return new Response("", { status: isAlive ? 200 : 504 });
  requests += 1;
  if (!answer) throw new TypeError("no connection");
  return answer();
};

const kept = new Map<string, Response>();
const cache = {
  match: async ({ url }: Request) => kept.get(url)?.clone(),
  put: async ({ url }: Request, response: Response) => void kept.set(url, response),
  keys: async () => [],
};
Object.assign(globalThis, { caches: { open: async () => cache } });

const ofServer = () => new Response("content");
const ofProxy = () => new Response("", { status: 502 });
const tooSlow = () => new Response("<html>", { status: 504, headers: { "content-type": "text/html" } });
const overloaded = () =>
  new Response('{"status": 503, "detail": "busy"}', {
    status: 503,
    headers: { "content-type": "application/problem+json" },
  });

/** Asks the service worker. Returns undefined for what it leaves alone. */
function ask(url: string): Promise<Response> | undefined {
  let response: Promise<Response> | undefined;
  const respondWith = (given: Promise<Response>) => {
    response = given;
  };
  listeners.get("fetch")?.({ request: { method: "GET", mode: "cors", url }, respondWith } as never);
  return response;
}

async function checkWorker(): Promise<void> {
  const url = `${ENVIRONMENTS}/yard/versions/latest/layers/topology`;
  answer = ofServer;
  await ask(url);
  while (!kept.has(url)) await new Promise((resolve) => setTimeout(resolve));
  for (const failing of [null, ofProxy, tooSlow]) {
    answer = failing;
    const response = await ask(url);
    require(response?.headers.get("fleetmap-offline") === "1", `kept is read at ${failing?.name}`);
    require((await response.text()) === "content", "with its content");
  }
  answer = ofProxy;
  require((await ask(`${url}2`))?.status === 502, "what is not kept is the proxy's error");
  answer = overloaded;
  require((await ask(url))?.status === 503, "the server's own error is shown");
  [answer, isAlive] = [tooSlow, true];
  require((await ask(url))?.status === 504, "a server that answers others is not away");
  [answer, isAlive] = [null, false];
  const failure = await ask(`${url}2`)?.catch((error) => error);
  require(failure instanceof TypeError, "without a connection and what is kept it fails");
}

/** Maps and files are large, and are not kept; environments may have any name. */
function checkKept(): void {
  const isKept = (path: string) => ask(`${ENVIRONMENTS}/${path}`) !== undefined;
  answer = ofServer;
  for (const name of ["yard", "maps", "sources", "reports", "manifest-hall"]) {
    require(isKept(`${name}/versions/latest`), `the environment ${name} is kept`);
    for (const path of ["maps/kml", "sources/a.pgm", "manifest", "reports/kml"])
      require(!isKept(`${name}/versions/latest/${path}`), `${path} is not kept`);
  }
}

async function checkPage(): Promise<void> {
  const problemOf = async () => asApiError(await request("/api/v1/environments").catch((error) => error));
  for (const failing of [null, ofProxy, tooSlow]) {
    answer = failing;
    require((await problemOf()).isOffline && !online.value, `the server does not answer at ${failing?.name}`);
    answer = overloaded;
    require((await problemOf()).status === 503 && online.value, "the server's own error is no silence");
  }
}

/** Were it taken as silence, the page would load all again when the server answers: the slow request, too, without end. */
async function checkSlow(): Promise<void> {
  [answer, isAlive, requests] = [tooSlow, true, 0];
  const before = returns.value;
  const problem = asApiError(await request("/api/v1/environments").catch((error) => error));
  require(problem.status === 504 && online.value, `a slow request fails alone: ${problem.status}`);
  require(requests === 1 && returns.value === before, "and is not repeated");
  require(problem.message.includes("may still be at work"), problem.message);
}

async function checkSlowUpload(): Promise<void> {
  class SlowCall {
    upload = {};
    status = 504;
    statusText = "Gateway Time-out";
    onload = (): void => undefined;
    open = (): void => undefined;
    getResponseHeader = () => "text/html";
    send = () => this.onload();
  }
  Object.assign(globalThis, { XMLHttpRequest: SlowCall });
  const problemOf = async () => asApiError(await sendForm("/api/v1/uploads", new FormData()).catch((error) => error));
  isAlive = false;
  require((await problemOf()).isOffline && !online.value, "the server is away");
  isAlive = true;
  require((await problemOf()).status === 504 && online.value, "an upload that takes long is not sent again by itself");
}

await checkWorker();
checkKept();
await checkPage();
await checkSlow();
await checkSlowUpload();
