/** What a site misses while its events do not arrive is read again (run by tests/web/test_modules.py). */
import { answerWith, require, sources } from "./in-node";
import { live } from "./api/events";
import { site } from "./site";

/** Version that the server has. */
let version = 1;
const asked: string[] = [];

answerWith(async ({ url }) => {
  const { pathname, search } = new URL(url);
  asked.push(pathname + search);
  if (pathname.endsWith("/channels") || pathname.endsWith("/layers")) return { body: [] };
  if (pathname.endsWith("/versions/latest")) return { body: { version, root: `root ${version}` } };
  if (pathname.includes("/layers/")) {
    const ids = new URLSearchParams(search).get("ids")?.split(",") ?? [];
    const features = ids
      .filter((id) => id !== "gone")
      .map((id) => ({ id, place: { type: "Point", coordinates: [0, 0] } }));
    return { body: { features } };
  }
  return { body: { name: "yard", version } };
});

/** Waits until the site shows the server's version. */
async function shown(): Promise<void> {
  while (site.value?.number !== version) await new Promise((resolve) => setTimeout(resolve));
}

function newest(): EventSource {
  const source = sources.at(-1);
  require(source !== undefined, "there is a stream");
  return source;
}

function fire(source: EventSource, event: "open" | "error", readyState: number): void {
  Object.assign(source, { readyState });
  (source[`on${event}`] as (() => void) | null)?.();
}

async function checkMissedEvents(): Promise<void> {
  await shown();
  const first = newest();
  fire(first, "open", 1);
  fire(first, "error", 0);
  require(!live.value, "the stream is lost");
  version = 2; // its event is not received
  fire(first, "open", 1);
  require(live.value, "the browser has opened it again");
  await shown();
  fire(first, "error", 2);
  while (newest() === first) await new Promise((resolve) => setTimeout(resolve));
  version = 1; // of a restored backup
  fire(newest(), "open", 1);
  await shown();
  require(!newest().url.includes("since"), "a refused stream begins anew");
}

async function checkReadFeatures(): Promise<void> {
  asked.length = 0;
  const ids = ["gone", ...Array.from({ length: 150 }, (_, index) => `n${index}`)];
  const found = await site.value?.readFeatures("topology", ids);
  require(found?.length === 150 && found[0]?.layer === "topology", "those that there are");
  require(asked.length === 2 &&
    asked.every((path) => path.includes("/versions/1/layers/topology?crs=local&ids=")), "in parts");
}

await checkMissedEvents();
await checkReadFeatures();
site.value?.close();
