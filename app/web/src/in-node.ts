/** What modules of the page expect of a browser, for their checks, which run in Node: import it before them. */

function storage() {
  const kept = new Map<string, string>();
  return {
    getItem: (name: string) => kept.get(name) ?? null,
    setItem: (name: string, value: string) => kept.set(name, value),
    removeItem: (name: string) => kept.delete(name),
    clear: () => kept.clear(),
  };
}

const nothing = () => undefined;

/** Addresses that the page has gone to. */
export const visited: string[] = [];

/** Streams of events that the page has opened. */
export const sources: EventSource[] = [];

/** Listeners of the window, or of the service worker, by type of event. */
export const listeners = new Map<string, (event: never) => void>();

Object.assign(globalThis, {
  window: globalThis,
  location: {
    search: "?site=yard",
    hash: "",
    pathname: "/",
    origin: "http://page",
    assign: (to: string) => visited.push(to),
  },
  history: { replaceState: nothing, pushState: nothing },
  self: globalThis,
  addEventListener: (type: string, listener: (event: never) => void) => listeners.set(type, listener),
  removeEventListener: nothing,
  localStorage: storage(),
  sessionStorage: storage(),
  matchMedia: () => ({ matches: false, addEventListener: nothing }),
  document: { documentElement: { dataset: {} } },
  EventSource: class {
    static readonly CLOSED = 2;
    readyState = 0;
    addEventListener = nothing;
    close = nothing;
    constructor(readonly url: string) {
      sources.push(this as unknown as EventSource);
    }
  },
  BroadcastChannel: class {
    postMessage = nothing;
    close = nothing;
  },
  Request: class extends Request {
    constructor(path: string | Request, init?: RequestInit) {
      super(typeof path === "string" ? `http://page${path}` : path, init);
    }
  },
});

/** Answers the page's requests with JSON, after those of `status` other than 200. Returns what ends it. */
export function answerWith(answer: (request: Request) => Promise<{ status?: number; body?: unknown }>): void {
  globalThis.fetch = async (input) => {
    const { status = 200, body = {} } = await answer(input as Request);
    return new Response(JSON.stringify(body), { status, headers: { "content-type": "application/json" } });
  };
}

export function require(condition: boolean, text: string): asserts condition {
  if (!condition) throw new Error(text);
}
