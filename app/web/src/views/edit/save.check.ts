/** What is edited while a save or a decision is pending is not lost (run by tests/web/test_modules.py). */
import { answerWith, require } from "../../in-node";
import { signal } from "@preact/signals";
import type { Feature } from "../../map/features";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { keyOf } from "./draft";
import { Editor } from "./editor";
import * as operations from "./operations";
import { save, saveAsDraft } from "./save";
import { DraftStore, type StoredDraft } from "./storage";

/** What the device keeps. */
let stored: StoredDraft | null = null;
DraftStore.prototype.load = async () => stored;
DraftStore.prototype.save = async () => undefined;
DraftStore.prototype.clear = async () => undefined;

function node(id: string, x: number, properties: Record<string, unknown> = {}): Feature {
  const geometry: Feature["geometry"] = { type: "Point", coordinates: [x, 0] };
  const all = { kind: "node", ...properties };
  return { id, layer: "topology", level: "ground", part: "network", geometry, properties: all };
}

/** A site that shows features as version 1. elsewhere: those beyond the loaded extent. */
function siteOf(features: Feature[], partial: string[] = [], elsewhere: Feature[] = []) {
  return {
    name: "yard",
    features: signal(features),
    version: signal<object>({ version: 1, message: "" }),
    environment: signal({ version: 1 }),
    partial: signal(partial),
    parts: signal([]),
    level: signal("ground"),
    problem: signal(null),
    path: (...parts: (string | number)[]) => ["environments", "yard", ...parts],
    refresh: async (): Promise<void> => undefined,
    readFeatures: async (_: string, ids: string[]) => elsewhere.filter(({ id }) => ids.includes(id)),
  };
}

type TestSite = ReturnType<typeof siteOf>;

/** Ben saves version 2. */
function saveOfBen(site: TestSite, features: Feature[]): void {
  site.environment.value = { version: 2 };
  site.version.value = { version: 2, author: "ben", message: "" };
  site.features.value = features;
}

async function open(site: TestSite): Promise<Editor> {
  const editor = new Editor(site as unknown as Site, { shown: signal(null) } as unknown as SiteMap, "latest");
  while (!editor.ready.value) await new Promise((resolve) => setTimeout(resolve));
  return editor;
}

const A = keyOf(node("a", 0));
const B = keyOf(node("b", 0));

function move(editor: Editor, key: string, x: number): boolean {
  const feature = editor.draft.get(key);
  return feature !== undefined && editor.run(operations.place(editor.draft, feature, x, 0));
}

function placeOf(editor: Editor, key: string): unknown {
  return (editor.draft.get(key)?.geometry as { coordinates: number[] } | undefined)?.coordinates[0];
}

async function checkWhileSaving(): Promise<void> {
  const editor = await open(siteOf([node("a", 0), node("b", 10)]));
  move(editor, A, 5);
  let isMoved = true;
  answerWith(async () => {
    isMoved = move(editor, B, 77);
    editor.undo();
    return { status: 201, body: { version: 2, warnings: [] } };
  });
  await editor.whileSending(async () => void (await save(editor, () => undefined)));
  require(!isMoved, "an edit during a save is refused");
  require(placeOf(editor, B) === 10, "what is drawn as saved is saved");
  require(placeOf(editor, A) === 5, "an undo during a save is refused");
  require(move(editor, B, 77) && editor.count.value === 1, "after the save edits go on");
}

/** Opens an editor in which conflicts wait: Ben and I have moved the same node. */
async function openInConflict(): Promise<Editor> {
  const site = siteOf([node("a", 0), node("b", 10)]);
  const editor = await open(site);
  move(editor, A, 1);
  saveOfBen(site, [node("a", 2), node("b", 10)]);
  require(!(await editor.head.merge(null)), "the same node is a conflict");
  return editor;
}

async function checkWhileDeciding(): Promise<void> {
  const editor = await openInConflict();
  require(!move(editor, B, 77), "an edit while conflicts are listed is refused");
  editor.undo();
  const [conflict] = editor.head.pending.value?.merge.conflicts ?? [];
  require(conflict !== undefined, "the conflict is listed");
  editor.head.choose(conflict, "mine");
  require(editor.head.pending.value !== null, "the decision is kept");
  editor.head.finish(editor.head.pending.value);
  require(placeOf(editor, A) === 1, "mine is kept");
  require(move(editor, B, 77) && editor.count.value === 2, "after the decision edits go on");
}

/** A layer that is shown by extent: what was edited is in another extent, or not loaded yet. */
async function checkRestoredElsewhere(): Promise<void> {
  const first = await open(siteOf([node("a", 0), node("b", 10)], ["topology"]));
  first.run(operations.remove(first.draft, [node("a", 0)]));
  move(first, B, 20);
  stored = {
    head: { id: "", site: "yard", version: 1, position: 2, message: "", time: 0 },
    log: structuredClone(first.draft.log),
  };
  const site = siteOf([node("far", 9000)], ["topology"]);
  const second = await open(site);
  stored = null;
  require(second.count.value === 2, "both changes are restored");
  site.features.value = [node("a", 0), node("b", 10)];
  require(second.count.value === 2, "both changes are there when their extent is loaded");
  require(placeOf(second, A) === undefined && placeOf(second, B) === 20, "the map shows them");
}

/** What Ben has changed beyond the loaded extent is his. */
async function checkMergedElsewhere(): Promise<void> {
  const elsewhere = [node("a", 0, { speed_limit: 0.3 })];
  const site = siteOf([node("a", 0), node("b", 10)], ["topology"], elsewhere);
  const editor = await open(site);
  editor.run(operations.setProperty(editor.draft, [node("a", 0)], "name", "Gate"));
  saveOfBen(site, [node("far", 9000)]);
  require(await editor.head.merge(null), "different properties are joined");
  const { name, speed_limit } = editor.draft.get(A)?.properties ?? {};
  require(name === "Gate" && speed_limit === 0.3, "the properties of both are kept");
  require(editor.notes.value.some(({ details }) => details?.length === 1), "the note says so");
}

async function checkDeletedElsewhere(): Promise<void> {
  const site = siteOf([node("a", 0)], ["topology"]);
  const editor = await open(site);
  move(editor, A, 5);
  saveOfBen(site, [node("far", 9000)]);
  require(!(await editor.head.merge(null)), "what they have deleted elsewhere is a conflict");
}

/** The server's draft begins with a version that the page does not show yet. */
async function checkKeptAsDraft(): Promise<void> {
  const site = siteOf([node("a", 0), node("b", 10)]);
  const editor = await open(site);
  editor.run(operations.setProperty(editor.draft, [node("a", 0)], "name", "Gate"));
  site.refresh = async () => saveOfBen(site, [node("a", 0, { speed_limit: 0.3 }), node("b", 10)]);
  const sent: string[] = [];
  let edits = "";
  answerWith(async (request) => {
    const { pathname } = new URL(request.url);
    sent.push(`${request.method} ${pathname.split("/yard/")[1]}`);
    if (pathname.endsWith("edits")) edits = await request.text();
    return { body: { id: `d${sent.length}`, base: 2, name: "draft 1" } };
  });
  const kept = await saveAsDraft(editor, "", () => undefined);
  require(typeof kept === "object", "different properties are no conflict");
  require(String(sent) ===
    "POST drafts,DELETE drafts/d1,POST drafts,POST drafts/d3/edits", `the draft is made again after the merge: ${String(sent)}`);
  require(edits.includes("0.3") && edits.includes("Gate"), `the properties of both are kept: ${edits}`);
}

/** Others have saved the same in the meantime: the server refuses edits without changes. */
async function checkNothingLeft(): Promise<void> {
  const site = siteOf([node("a", 0), node("b", 10)]);
  const editor = await open(site);
  editor.run(operations.setProperty(editor.draft, [node("a", 0)], "name", "Gate"));
  site.refresh = async () => saveOfBen(site, [node("a", 0, { name: "Gate" }), node("b", 10)]);
  const sent: string[] = [];
  answerWith(async (request) => {
    sent.push(`${request.method} ${new URL(request.url).pathname.split("/yard/")[1]}`);
    return { body: { id: "d", base: 2, name: "draft 1" } };
  });
  require((await saveAsDraft(editor, "", () => undefined)) === "nothing left", "no draft is kept");
  require(String(sent) === "POST drafts,DELETE drafts/d", `no edits are sent, no draft stays: ${String(sent)}`);
}

/** Theirs is chosen at all conflicts, and the save goes on. */
async function checkAllTheirs(): Promise<void> {
  const editor = await openInConflict();
  const { pending } = editor.head;
  for (const conflict of pending.value?.merge.conflicts ?? []) editor.head.choose(conflict, "theirs");
  if (pending.value) editor.head.finish(pending.value);
  answerWith(async () => ({ status: 422, body: { status: 422, detail: "no changes" } }));
  const saved = await save(editor, () => undefined).catch(() => null);
  require(saved === "nothing left", "nothing is sent, and nothing said to be saved");
}

/** What I have changed and changed back is theirs. */
async function checkChangedBack(): Promise<void> {
  const site = siteOf([node("a", 0), node("b", 10)]);
  const editor = await open(site);
  move(editor, A, 5);
  move(editor, A, 0);
  move(editor, B, 20);
  saveOfBen(site, [node("a", 2), node("b", 10)]);
  require(await editor.head.merge(null), "different nodes are no conflict");
  require(placeOf(editor, A) === 2 && placeOf(editor, B) === 20, "each has the place that one of them gave it");
}

async function checkHistoryStays(): Promise<void> {
  const site = siteOf([node("a", 0), node("b", 10)]);
  const editor = await open(site);
  move(editor, A, 5);
  move(editor, A, 6);
  saveOfBen(site, [node("a", 0), node("b", 11)]);
  require(await editor.head.merge(null), "different nodes are no conflict");
  editor.undo();
  require(placeOf(editor, A) === 5 && placeOf(editor, B) === 11, "single steps can be undone after a merge");
}

await checkChangedBack();
await checkHistoryStays();
await checkKeptAsDraft();
await checkNothingLeft();
await checkAllTheirs();
await checkRestoredElsewhere();
await checkMergedElsewhere();
await checkDeletedElsewhere();
await checkWhileSaving();
await checkWhileDeciding();
