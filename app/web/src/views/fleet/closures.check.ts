/** A street that could be closed in one direction only is closed by a repetition (run by tests/web/test_modules.py). */
import { answerWith, require } from "../../in-node";
import { close } from "./closures";
import type { FleetStore } from "./store";
import type { Overlay } from "./types";

/** Ends of the closures that the server has, by edge. */
const ends = new Map<string, string>();
let isFull = true;
/** Edges whose closure is over, with the status that a change of its end gets. */
const over = new Map<string, number>();

answerWith(async (request) => {
  const { expires, edge } = (await request.json()) as { expires: string; edge?: string };
  const closed = edge ?? new URL(request.url).pathname.split("/").at(-1) ?? "";
  require(request.method === (edge ? "POST" : "PATCH"), "an end is changed, a closure reported");
  if (closed === "b_a" && isFull) return { status: 503, body: { status: 503, detail: "busy" } };
  const status = over.get(closed);
  if (request.method === "PATCH" && status) return { status, body: { status, detail: "it is over" } };
  over.delete(closed);
  ends.set(closed, expires);
  return { body: { id: closed, expires } };
});

const site = { name: "yard", path: (...parts: string[]) => ["environments", "yard", ...parts] };
const store = { site, putOverlay: () => undefined } as unknown as FleetStore;

const done = new Map<string, Overlay>();
const wanted = { edges: ["a_b", "b_a"], detail: "", done };
const failed = await close(store, { ...wanted, expires: "2030-01-01T10:00:00Z" }).catch(() => null);
require(failed === null && ends.size === 1, "the second direction is refused");
isFull = false;
const made = await close(store, { ...wanted, expires: "2030-01-01T12:00:00Z" });
require(String(made.map(({ id }) => id)) === "a_b,b_a", "both directions are closed once");
require([...ends.values()].every((end) => end === "2030-01-01T12:00:00Z"), "both end as was said at last");

// The first direction ends before the second one is reported.
for (const status of [404, 409]) {
  ends.clear();
  done.clear();
  isFull = true;
  await close(store, { ...wanted, expires: "2030-01-01T10:00:00Z" }).catch(() => null);
  isFull = false;
  over.set("a_b", status);
  ends.delete("a_b");
  const again = await close(store, { ...wanted, expires: "2030-01-01T12:00:00Z" }).catch(() => null);
  require(again?.length === 2 &&
    ends.has("a_b") &&
    ends.has("b_a"), `both directions are closed after ${status} for the first`);
}
