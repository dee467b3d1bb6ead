// Keeps the page and the last maps seen readable while the server does not answer. All requests go to the server first,
// but for files whose names contain their hash.
const SHELL = "shell-1";
const MAPS = "maps-1";
const MAX_ENTRIES = 3000;
const LONGEST_SILENCE = 10_000; // milliseconds
const KEPT = /^\/api\/v1\/(session$|environments(\/|$)|robots$|formats$)/;
const NOT_KEPT = /\/versions\/[^/]+\/(maps\/[^/]+|sources\/|manifest|reports\/)/;

self.addEventListener("install", (event) => {
  event.waitUntil(
    caches
      .open(SHELL)
      .then((cache) => cache.addAll(["/", "/icon.svg"]))
      .then(() => self.skipWaiting()),
  );
});

self.addEventListener("activate", (event) => {
  event.waitUntil(self.clients.claim());
});

self.addEventListener("fetch", (event) => {
  const { request } = event;
  const url = new URL(request.url);
  if (request.method !== "GET" || url.origin !== self.location.origin) return;
  if (request.mode === "navigate" && url.pathname === "/") event.respondWith(fromServer(request, SHELL, "/"));
  else if (url.pathname.startsWith("/assets/") || url.pathname === "/icon.svg") event.respondWith(fromCache(request));
  else if (KEPT.test(url.pathname) && !NOT_KEPT.test(url.pathname))
    event.respondWith(fromServer(request, MAPS, request));
});

async function fromCache(request) {
  const cache = await caches.open(SHELL);
  const hit = await cache.match(request);
  if (hit) return hit;
  const response = await fetch(request);
  if (response.ok) await cache.put(request, response.clone());
  return response;
}

async function fromServer(request, name, key) {
  const response = await fetch(request).catch((error) => error);
  const isResponse = response instanceof Response;
  if (isResponse && !(await isSilent(response))) {
    if (response.ok) void keep(name, key, response.clone());
    return response;
  }
  const hit = await (await caches.open(name)).match(key, { ignoreVary: true });
  if (!hit && isResponse) return response;
  if (!hit) throw response;
  const headers = new Headers(hit.headers);
  headers.set("fleetmap-offline", "1"); // the page says so
  return new Response(hit.body, { status: hit.status, headers });
}

// As isSilent of src/api/client.ts: whether a proxy says that the server does not answer, not only that it was slow.
async function isSilent({ status, headers }) {
  const isOfProxy = !headers.get("content-type")?.startsWith("application/problem+json");
  if (![502, 503, 504].includes(status) || !isOfProxy) return false;
  if (status !== 504) return true;
  const signal = AbortSignal.timeout(LONGEST_SILENCE);
  return fetch("/healthz", { cache: "no-store", signal }).then(
    ({ ok }) => !ok,
    () => true,
  );
}

async function keep(name, key, response) {
  try {
    const cache = await caches.open(name);
    await cache.put(key, response);
    if (name !== MAPS || Math.random() > 0.02) return;
    const keys = await cache.keys();
    await Promise.all(keys.slice(0, Math.max(0, keys.length - MAX_ENTRIES)).map((old) => cache.delete(old)));
  } catch {
    // The disk may be full: then nothing is kept.
  }
}
