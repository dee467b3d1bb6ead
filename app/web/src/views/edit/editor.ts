/** State of the Edit view: the draft, what is selected, the tool and its options. */
import { computed, effect, signal } from "@preact/signals";
import { go, param } from "../../address";
import type { Feature, LayerName } from "../../map/features";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { notify } from "../../ui/toast";
import { type Change, type Command, core, Draft, isEdge, keyOf, same } from "./draft";
import { Head } from "./head";
import type { Outcome } from "./operations";
import { keepOptions, loadOptions, type Options, type ToolName, TOOLS } from "./options";
import { DraftStore } from "./storage";
import { Target } from "./target";
import { Transaction } from "./transaction";
import { groupsOf } from "./words";

const PARTS: Record<string, string> = { topology: "network", location: "site", zones: "zones", objects: "edit" };

export interface Note {
  id: string;
  text: string;
  details?: string[];
}

export class Editor {
  draft = new Draft([]);
  /** Version the draft builds on, or revision of the server's draft that it adds to; null before it is loaded. */
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
  /** Where the draft is: on this device, or not (the device has no room). */
  readonly stored = signal<"kept" | "saving" | "failed">("kept");
  readonly ready = signal(false);
  /** Whether the draft is being sent or merged. */
  readonly sending = signal(false);
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

  readonly head = new Head(this);
  readonly store: DraftStore;
  readonly target: Target;
  private readonly stops: (() => void)[] = [];

  constructor(
    readonly site: Site,
    readonly map: SiteMap,
    ref: string,
  ) {
    this.target = new Target(site, ref);
    this.store = new DraftStore(this.target.draft === null ? site.name : `${site.name} ${ref}`);
    this.stops.push(
      effect(() => keepOptions(this.options.value)),
      effect(() => this.head.follow()),
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

  newDraft(features: Iterable<Feature>, log?: Command[], position?: number): Draft {
    const draft = new Draft(features, log, position);
    if (this.site.partial.peek().length) draft.idMark = `-${this.store.id.slice(0, 5)}-`;
    return draft;
  }

  /** Goes on with another draft, or with one whose version has grown. */
  setDraft(draft: Draft, base: number): void {
    this.draft = draft;
    this.base.value = base;
    this.changed();
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

  /** Why the draft must stay as it is: what is changed now would be in no request and in no merge. Empty: it may change. */
  get hold(): string {
    if (this.sending.peek()) return "Your changes are being saved or merged: wait for the answer of the server";
    return this.head.pending.peek() ? "Decide the conflicts first, or choose “Later”" : "";
  }

  /** Does an operation, or says why it cannot be done. Selects what is given, or keeps what is left. */
  run(outcome: Outcome, select?: string[]): boolean {
    if (this.refuse()) return false;
    if (typeof outcome === "string") {
      notify(outcome);
      return false;
    }
    if (!this.draft.execute(outcome)) return false;
    this.keep(this.draft.position - 1);
    this.lastStep.value = "";
    if (select) this.select(select);
    this.changed();
    return true;
  }

  /** Keeps the draft as it is while it is sent or merged. */
  async whileSending(work: () => Promise<void>): Promise<void> {
    this.sending.value = true;
    try {
      await work();
    } finally {
      this.sending.value = false;
    }
  }

  /** Says why the draft must stay as it is, if it must. */
  refuse(): boolean {
    const { hold } = this;
    if (hold) notify(hold);
    return hold !== "";
  }

  undo(): void {
    if (this.refuse()) return;
    const command = this.draft.undo();
    if (command) this.afterStep(command, `Undone: ${command.title}`);
  }

  redo(): void {
    if (this.refuse()) return;
    const command = this.draft.redo();
    if (command) this.afterStep(command, `Done again: ${command.title}`);
  }

  /** What was undone or done again last, for those who hear the page. */
  readonly lastStep = signal("");

  private afterStep(command: Command, text: string): void {
    this.keep(null);
    this.lastStep.value = text;
    this.changed();
    if (this.selection.peek().size) return; // what was selected is worked on further
    // Lanes that only follow their nodes are not selected.
    const edits = command.edits.filter(({ from, to }) => !same(core(from), core(to)));
    const features = edits.map(({ key }) => this.draft.get(key)).filter((feature) => feature !== undefined);
    this.select(features.slice(0, 50).flatMap((feature) => this.wholeOf(feature)));
  }

  private changed(): void {
    this.revision.value = this.revision.peek() + 1;
    const left = [...this.selection.peek()].filter((key) => this.draft.get(key));
    if (left.length !== this.selection.peek().size) this.select(left);
  }

  setMessage(text: string): void {
    this.message.value = text;
    this.keep(null);
  }

  /** Writes the draft to the device. */
  keep(from: number | null): void {
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
    edits.tie();
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
    this.message.value = "";
    this.setDraft(this.newDraft(this.site.features.peek()), this.target.number ?? 0);
    this.keep(0);
  }

  /** The changes are saved: what is drawn is what the server holds. */
  saved(version: number): void {
    this.message.value = "";
    this.notes.value = this.notes.peek().filter(({ id }) => id === "merged");
    this.setDraft(this.newDraft(this.draft.features()), version);
    this.keep(0);
  }

  selectFromAddress(): void {
    const wanted = param("feature");
    const level = this.site.level.peek();
    const found = wanted && this.draft.features().find(({ id, level: own }) => id === wanted && own === level);
    if (found) this.selection.value = new Set(this.wholeOf(found));
  }

  note(id: string, text: string, details?: string[]): void {
    this.notes.value = [...this.notes.peek().filter((note) => note.id !== id), { id, text, details }];
  }

  dismiss(id: string): void {
    this.notes.value = this.notes.peek().filter((note) => note.id !== id);
  }
}
