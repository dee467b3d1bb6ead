/** State of the Edit view: the draft, what is selected, the tool and its options. */
import { computed, effect, signal } from "@preact/signals";
import { go, param } from "../../address";
import type { Feature, LayerName } from "../../map/features";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { count } from "../../ui/text";
import { notify } from "../../ui/toast";
import { type Change, type Command, Draft, EDITED_LAYERS, isEdge, isNode, keyOf } from "./draft";
import { type Choice, type Conflict, compare, type Merge, merged, withFreshIds } from "./merge";
import type { Outcome } from "./operations";
import type { SnapOptions } from "./snap";
import { DraftStore } from "./storage";
import { Transaction } from "./transaction";
import { groupsOf } from "./words";

export type ToolName = "select" | "path" | "split" | "zone" | "object" | "fence" | "cells" | "brush";

export const TOOLS: ToolName[] = ["select", "path", "split", "zone", "object", "fence", "cells", "brush"];

const PARTS: Record<string, string> = { topology: "network", location: "site", zones: "zones", objects: "edit" };

export interface Options {
  oneWay: boolean;
  /** New lanes take the action, speed and width that the lanes they continue have in common. */
  likeBefore: boolean;
  snap: SnapOptions;
  /** Snapping is released while true. */
  free: boolean;
  /** Each click adds to the selection; a drag in the void draws a box. */
  several: boolean;
  box: boolean;
  zoneKind: string;
  speed: number;
  objectShape: "point" | "area" | "line";
  objectKind: string;
  name: string;
  grid: string;
  cellValue: number;
  brush: number;
}

/** What was found when the site moved on, and waits for decisions. */
export interface Pending {
  merge: Merge;
  version: number;
  theirs: Feature[];
  author: string;
  choices: Map<string, Choice>;
  /** Continues what was interrupted, with the merged draft. */
  resume: (() => void) | null;
}

export interface Note {
  id: string;
  text: string;
  details?: string[];
}

const SETTINGS = "fleetmap-edit-options";

export class Editor {
  draft = new Draft([]);
  /** Version the draft builds on; null before it is loaded. */
  readonly base = signal<number | null>(null);
  /** Grows with each change of the draft. */
  readonly revision = signal(0);
  readonly selection = signal<ReadonlySet<string>>(new Set());
  /** Chosen vertex of the one selected area or bent lane. */
  readonly vertex = signal<{ key: string; outline: number; index: number } | null>(null);
  readonly tool = computed<ToolName>(() => TOOLS.find((name) => name === param("tool")) ?? "select");
  readonly options = signal<Options>(loadOptions());
  readonly notes = signal<Note[]>([]);
  readonly message = signal("");
  readonly pending = signal<Pending | null>(null);
  /** Where the draft is: on this device, or not (the device has no room). */
  readonly stored = signal<"kept" | "saving" | "failed">("kept");
  readonly ready = signal(false);
  copied: Feature[] = [];

  readonly changes = computed(() => {
    this.revision.value;
    return this.draft.changes();
  });
  readonly cells = computed(() => {
    this.revision.value;
    return this.draft.cells();
  });
  readonly selected = computed<Feature[]>(() => {
    this.revision.value;
    return [...this.selection.value].map((key) => this.draft.get(key)).filter((feature) => feature !== undefined);
  });
  readonly groups = computed(() => groupsOf(this.changes.value));
  /** Number of changes as people count them: a two-way street is one. */
  readonly count = computed(
    () => this.groups.value.reduce((sum, { rows }) => sum + rows.length, 0) + this.cells.value.length,
  );

  private readonly isLatest = computed(() => param("version") === "latest");
  private readonly store: DraftStore;
  private readonly stops: (() => void)[] = [];

  constructor(
    readonly site: Site,
    readonly map: SiteMap,
  ) {
    this.store = new DraftStore(site.name);
    this.stops.push(
      effect(() => localStorage.setItem(SETTINGS, JSON.stringify(this.options.value))),
      effect(() => this.followSite()),
      effect(() => {
        this.revision.value;
        if (this.ready.value) map.shown.value = this.draft.features();
      }),
    );
  }

  close(): void {
    for (const stop of this.stops) stop();
    this.store.close();
    this.map.shown.value = null;
  }

  private newDraft(features: Iterable<Feature>, log?: Command[], position?: number): Draft {
    const draft = new Draft(features, log, position);
    if (this.site.partial.peek().length) draft.idMark = `-${this.store.id.slice(0, 5)}-`;
    return draft;
  }

  get draftId(): string {
    return this.store.id;
  }

  set(options: Partial<Options>): void {
    this.options.value = { ...this.options.peek(), ...options };
  }

  setTool(name: ToolName): void {
    go({ tool: name === "select" ? null : name }, { replace: true });
  }

  /** Level and part that a new feature of a layer belongs to. */
  placeFor(layer: LayerName): { level: string; part: string } {
    const level = this.site.level.peek();
    const parts = this.site.parts.peek().filter((part) => part.layer === layer && part.level === level);
    const usual = PARTS[layer] ?? "";
    const only = layer === "topology" && parts.length === 1 ? parts[0]?.name : undefined;
    return { level, part: only ?? usual };
  }

  select(keys: Iterable<string>, { add = false, toggle = false } = {}): void {
    const next = new Set(add || toggle ? this.selection.peek() : []);
    const list = [...keys];
    const remove = toggle && list.every((key) => next.has(key));
    for (const key of list) {
      if (remove) next.delete(key);
      else next.add(key);
    }
    this.selection.value = next;
    this.vertex.value = null;
    const first = next.size === 1 ? this.draft.get([...next][0] ?? "") : undefined;
    go({ feature: first?.id ?? null }, { replace: true });
  }

  /** Keys of a feature as it is seen: a two-way street is both of its edges. */
  wholeOf(feature: Feature): string[] {
    const twin = isEdge(feature) ? this.draft.twinOf(feature) : undefined;
    return twin ? [keyOf(feature), keyOf(twin)] : [keyOf(feature)];
  }

  /** Does an operation, or says why it cannot be done. Selects what is given, or keeps what is left. */
  run(outcome: Outcome, select?: string[]): boolean {
    if (typeof outcome === "string") {
      notify(outcome, { kind: "failed" });
      return false;
    }
    if (!this.draft.execute(outcome)) return false;
    this.keep(this.draft.position - 1);
    if (select) this.select(select);
    this.changed();
    return true;
  }

  undo(): void {
    const command = this.draft.undo();
    if (command) this.afterStep(command, `Undone: ${command.title}`);
  }

  redo(): void {
    const command = this.draft.redo();
    if (command) this.afterStep(command, `Done again: ${command.title}`);
  }

  readonly lastStep = signal("");

  private afterStep(command: Command, text: string): void {
    this.keep(null);
    this.lastStep.value = text;
    const keys = command.edits.map(({ key }) => key).filter((key) => this.draft.get(key));
    this.select(keys.slice(0, 50));
    this.changed();
  }

  private changed(): void {
    this.revision.value += 1;
    const left = [...this.selection.peek()].filter((key) => this.draft.get(key));
    if (left.length !== this.selection.peek().size) this.select(left);
  }

  setMessage(text: string): void {
    this.message.value = text;
    this.keep(null);
  }

  /** Writes the draft to the device. */
  private keep(from: number | null): void {
    const { position, log } = this.draft;
    this.stored.value = "saving";
    const head = { version: this.base.peek() ?? 0, position, message: this.message.peek() };
    const work = log.length ? this.store.save(head, log, from) : this.store.clear();
    work.then(
      () => {
        this.stored.value = "kept";
      },
      () => {
        this.stored.value = "failed";
      },
    );
  }

  /** Takes back some of the changes only; what depends on them goes with them. */
  revert(changes: Change[]): void {
    const edits = new Transaction(this.draft);
    for (const { before, after } of changes) {
      if (before) edits.put(before);
      else if (after) edits.remove(after);
    }
    for (const { to } of edits.edits()) {
      // A lane that comes back needs its nodes; lanes of a node that goes back follow it.
      if (isEdge(to)) for (const end of ["source", "target"] as const) this.bringBack(edits, to, end);
    }
    for (const { to } of edits.edits()) {
      if (isNode(to)) for (const edge of edits.edgesOf(to)) edits.put(edits.tied(edge));
      else if (isEdge(to)) edits.put(edits.tied(to));
    }
    this.run(edits.command("Take back"));
  }

  private bringBack(edits: Transaction, edge: Feature, end: "source" | "target"): void {
    if (edits.endOf(edge, end)) return;
    const node = this.draft.before(keyOf({ ...edge, id: String(edge.properties[end]) }));
    if (node) edits.put(node);
  }

  dropCells(id: string): void {
    this.run({ title: "Take back cells", edits: [], dropCells: [id] });
  }

  /** Throws all changes away. */
  discard(): void {
    this.draft = this.newDraft(this.site.features.peek());
    this.base.value = this.site.number;
    this.message.value = "";
    this.selection.value = new Set();
    this.keep(0);
    this.revision.value += 1;
  }

  /** The draft has become a version: what is drawn is what the server holds. */
  saved(version: number): void {
    this.draft = this.newDraft(this.draft.features());
    this.base.value = version;
    this.message.value = "";
    this.notes.value = this.notes.peek().filter(({ id }) => id === "merged");
    this.keep(0);
    this.revision.value += 1;
  }

  note(id: string, text: string, details?: string[]): void {
    this.notes.value = [...this.notes.peek().filter((note) => note.id !== id), { id, text, details }];
  }

  dismiss(id: string): void {
    this.notes.value = this.notes.peek().filter((note) => note.id !== id);
  }

  // The site: its version is the draft's base, until someone saves another one.

  private followSite(): void {
    const version = this.site.version.value;
    const features = this.site.features.value;
    const head = this.site.environment.value?.version;
    if (!this.isLatest.value || !version || version.version === null || head === undefined) return;
    if (version.version !== head) return; // it is being loaded
    if (this.base.peek() === null) void this.start(features, version.version);
    else this.meet(features, version.version, version.author);
  }

  private async start(features: Feature[], version: number): Promise<void> {
    this.base.value = version;
    this.draft = this.newDraft(features);
    const stored = await this.store.load().catch(() => null);
    this.base.value = this.site.number ?? version;
    this.draft = this.newDraft(this.site.features.peek()); // the site may have moved on, and the draft have another id
    if (stored && stored.head.position + stored.log.length > 0) this.restore(stored);
    this.ready.value = true;
    this.revision.value += 1;
    this.selectFromAddress();
  }

  private restore({
    head,
    log,
  }: {
    head: { version: number; position: number; message: string };
    log: Command[];
  }): void {
    const features = this.site.features.peek();
    const version = this.site.number ?? 0;
    this.message.value = head.message;
    if (head.version === version) {
      this.draft = this.newDraft(features, log, head.position);
      this.base.value = version;
      this.noteRestored("");
      return;
    }
    // It builds on an older version: its features before each command are known from the log.
    const older = new Map(features.map((feature) => [keyOf(feature), feature]));
    const first = new Map<string, Feature | null>();
    for (const { edits } of log) for (const { key, from } of edits) if (!first.has(key)) first.set(key, from);
    for (const [key, from] of first) {
      if (from) older.set(key, from);
      else older.delete(key);
    }
    this.draft = this.newDraft(older.values(), log, head.position);
    this.base.value = head.version;
    this.noteRestored(`, made on v${head.version}`);
    this.meet(features, version, this.site.version.peek()?.author ?? "");
  }

  private noteRestored(more: string): void {
    const number =
      groupsOf(this.draft.changes()).reduce((sum, { rows }) => sum + rows.length, 0) + this.draft.cells().length;
    if (number) this.note("restored", `Restored ${count(number, "change")}, kept on this device${more}.`);
  }

  private selectFromAddress(): void {
    const wanted = param("feature");
    const level = this.site.level.peek();
    const found = wanted && this.draft.features().find(({ id, level: own }) => id === wanted && own === level);
    if (found) this.selection.value = new Set(this.wholeOf(found));
  }

  /** Meets the site's features, which may be those of a newer version. */
  private meet(features: Feature[], version: number, author: string): void {
    const base = this.base.peek() ?? version;
    if (version === base) {
      this.draft.addBase(features); // more was loaded of the same version
      this.revision.value = this.revision.peek() + 1;
      return;
    }
    if (!this.draft.log.length) {
      this.draft = this.newDraft(features);
      this.base.value = version;
      this.revision.value = this.revision.peek() + 1;
      const left = [...this.selection.peek()].filter((key) => this.draft.get(key));
      this.selection.value = new Set(left);
      return;
    }
    this.note(
      "moved",
      `v${version} was saved by ${author || "someone else"}. Your changes will be merged when you save.`,
    );
  }

  get isBehind(): boolean {
    const { number } = this.site;
    return number !== null && this.base.value !== null && number > this.base.value;
  }

  /** Merges the draft with the site's newest version; asks where both changed the same. Returns whether it is done. */
  mergeWithHead(resume: (() => void) | null): boolean {
    const version = this.site.number;
    if (version === null || version === this.base.peek()) return true;
    const theirs = this.site.features.peek().filter(({ layer }) => EDITED_LAYERS.includes(layer as LayerName));
    const byKey = new Map(theirs.map((feature) => [keyOf(feature), feature]));
    for (const layer of this.site.partial.peek()) addUnseen(byKey, this.draft, layer);
    const changes = this.draft.changes();
    const fresh = withFreshIds(changes, byKey);
    const merge = compare(fresh, byKey);
    if (fresh.some((change, index) => change !== changes[index])) merge.keepsHistory = false;
    const author = this.site.version.peek()?.author || "someone else";
    const pending: Pending = { merge, version, theirs: [...byKey.values()], author, choices: new Map(), resume };
    if (merge.conflicts.length) {
      this.pending.value = pending;
      return false;
    }
    this.finishMerge(pending);
    return true;
  }

  choose(conflict: Conflict, choice: Choice): void {
    const pending = this.pending.peek();
    if (!pending) return;
    this.pending.value = { ...pending, choices: new Map(pending.choices).set(conflict.key, choice) };
  }

  finishMerge(pending: Pending): void {
    const { merge, version, theirs, choices, author } = pending;
    const cells = this.draft.cells();
    const old = this.draft;
    let details: string[] = [];
    if (merge.keepsHistory && !merge.conflicts.length) this.draft = this.newDraft(theirs, old.log, old.position);
    else {
      const result = merged(theirs, merge, choices, (key) => old.before(key), `Your changes, merged with v${version}`);
      details = result.notes;
      this.draft = this.newDraft(theirs);
      const command: Command = { title: "", edits: [], ...result.command, cells };
      this.draft.execute({ ...command, title: `Your changes, merged with v${version}` });
    }
    this.base.value = version;
    this.pending.value = null;
    this.dismiss("moved");
    this.note("merged", `Merged with v${version}, saved by ${author}.`, details);
    this.keep(0);
    this.selection.value = new Set([...this.selection.peek()].filter((key) => this.draft.get(key)));
    this.revision.value += 1;
  }
}

/** Features beyond the loaded extent count as unchanged. */
function addUnseen(theirs: Map<string, Feature>, draft: Draft, layer: LayerName): void {
  for (const { key, before } of draft.changes()) {
    if (before && before.layer === layer && !theirs.has(key)) theirs.set(key, before);
  }
}

function loadOptions(): Options {
  const usual: Options = {
    oneWay: false,
    likeBefore: true,
    snap: { nodes: true, edges: true, angles: true, grid: false, step: 0.5 },
    free: false,
    several: false,
    box: false,
    zoneKind: "keepout",
    speed: 0.5,
    objectShape: "area",
    objectKind: "obstacle",
    name: "",
    grid: "",
    cellValue: 100,
    brush: 0.5,
  };
  try {
    const kept = JSON.parse(localStorage.getItem(SETTINGS) ?? "{}") as Partial<Options>;
    return { ...usual, ...kept, snap: { ...usual.snap, ...kept.snap }, free: false, several: false, box: false };
  } catch {
    return usual;
  }
}
