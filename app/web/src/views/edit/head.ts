/** The version that a draft builds on: loaded, restored, and met by newer ones of others. */
import { signal } from "@preact/signals";
import type { DryRun, Version } from "../../api/client";
import type { Feature, LayerName } from "../../map/features";
import { sentence } from "../../ui/states";
import { count } from "../../ui/text";
import type { Site } from "../../site";
import { type Command, type Draft, EDITED_LAYERS, isEdge, keyOf, same } from "./draft";
import type { Editor } from "./editor";
import { type Choice, type Conflict, compare, type Merge, merged, twinOf, withFreshIds } from "./merge";
import type { StoredDraft } from "./storage";
import { numberOf } from "./target";
import { titleOf } from "./words";

/** What was found when the site moved on, and waits for decisions. */
export interface Pending {
  merge: Merge;
  /** Whether they have changed nothing that the draft's history touches: then it stays as it is. */
  keepsHistory: boolean;
  version: number;
  theirs: Feature[];
  author: string;
  choices: Map<string, Choice>;
  /** Continues what was interrupted, with the merged draft. */
  resume: (() => void) | null;
}

export class Head {
  readonly pending = signal<Pending | null>(null);

  constructor(private readonly editor: Editor) {}

  /** Whether there is a newer content than that which the draft builds on. */
  get isBehind(): boolean {
    const { target, base } = this.editor;
    return target.number !== null && base.value !== null && target.number > base.value;
  }

  /** Takes up what the site shows; called again when it changes. */
  follow(): void {
    const { site, target, base } = this.editor;
    const { content } = target;
    const features = site.features.value;
    if (!content) return; // it is being loaded
    if (base.peek() === null) void this.start(features, numberOf(content));
    else this.meet(features, numberOf(content), this.authorOf(content));
  }

  /** Who made what the site shows: that of a draft is its owner, not who edited it last. */
  private authorOf(content: Version | DryRun | null): string {
    return (content?.version !== null && content?.author) || "someone else";
  }

  private async start(features: Feature[], version: number): Promise<void> {
    const { editor } = this;
    editor.setDraft(editor.newDraft(features), version);
    const stored = await editor.store.load().catch(() => null);
    // The site may have moved on, and the draft have another id.
    editor.setDraft(editor.newDraft(editor.site.features.peek()), editor.target.number ?? version);
    if (stored && stored.head.position + stored.log.length > 0) this.restore(stored);
    editor.ready.value = true;
    editor.selectFromAddress();
  }

  private restore({ head, log }: StoredDraft): void {
    const { editor } = this;
    const features = editor.site.features.peek();
    const version = editor.target.number ?? 0;
    editor.message.value = head.message;
    editor.setDraft(editor.newDraft(featuresBefore(features, log), log, head.position), head.version);
    const total = editor.count.value;
    const made = head.version === version ? "" : `, made on ${editor.target.olderWords(head.version)}`;
    if (total) editor.note("restored", `Restored ${count(total, "change")}, kept on this device${made}.`);
    if (made) this.meet(features, version, this.authorOf(editor.target.content));
  }

  /** Meets the site's features, which may be those of a newer version. */
  private meet(features: Feature[], version: number, author: string): void {
    const { editor } = this;
    const base = editor.base.peek() ?? version;
    if (version === base) {
      editor.draft.addBase(features); // more was loaded of the same version
      editor.setDraft(editor.draft, base);
    } else if (!editor.draft.log.length) editor.setDraft(editor.newDraft(features), version);
    else {
      const what = editor.target.words(version);
      editor.note("moved", `${sentence(what)} was saved by ${author}. Your changes will be merged when you save.`);
    }
  }

  /** Merges the draft with the site's newest version; asks where both changed the same. Returns whether it is done.
   *
   * Throws ApiError if what is beyond the loaded extent cannot be read. */
  async merge(resume: (() => void) | null): Promise<boolean> {
    const { site, target, draft, base } = this.editor;
    const version = target.number;
    if (version === null || version === base.peek()) return true;
    const author = this.authorOf(target.content);
    const theirs = site.features.peek().filter(({ layer }) => EDITED_LAYERS.includes(layer as LayerName));
    const byKey = new Map(theirs.map((feature) => [keyOf(feature), feature]));
    await addUnseen(byKey, site, draft);
    const changes = draft.changes();
    const fresh = withFreshIds(changes, byKey);
    const merge = compare(fresh, byKey);
    // What was changed back counts, too: the log would set it to what it was.
    const isUntouched = draft.log.every(({ edits }) =>
      edits.every(({ key }) => same(draft.before(key) ?? null, byKey.get(key) ?? null)),
    );
    const keepsHistory = isUntouched && fresh.every((change, index) => change === changes[index]);
    const all = [...byKey.values()];
    const pending: Pending = { merge, keepsHistory, version, theirs: all, author, choices: new Map(), resume };
    if (merge.conflicts.length) {
      this.pending.value = pending;
      return false;
    }
    this.finish(pending);
    return true;
  }

  /** Decides a conflict, and that of the other direction of the same street. */
  choose(conflict: Conflict, choice: Choice): void {
    const pending = this.pending.peek();
    if (!pending) return;
    const choices = new Map(pending.choices).set(conflict.key, choice);
    const twin = twinOf(conflict, pending.merge.conflicts);
    if (twin) choices.set(twin.key, choice);
    this.pending.value = { ...pending, choices };
  }

  finish({ merge, keepsHistory, version, theirs, choices, author }: Pending): void {
    const { editor } = this;
    const old = editor.draft;
    const words = editor.target.words(version);
    const title = `Your changes, merged with ${words}`;
    let details: string[] = [];
    if (keepsHistory) editor.setDraft(editor.newDraft(theirs, old.log, old.position), version);
    else {
      const { command, notes } = merged(theirs, merge, choices, (key) => old.before(key), title);
      details = [...merge.joined.map((feature) => `${titleOf(feature)} has the changes of both`), ...notes];
      const draft = editor.newDraft(theirs);
      draft.execute({ title, edits: [], ...command, cells: old.cells() });
      editor.setDraft(draft, version);
    }
    this.pending.value = null;
    editor.dismiss("moved");
    editor.note("merged", `Merged with ${words}, saved by ${author}.`, details);
    editor.keep(0);
  }
}

/** Returns the features that a log of changes began with: those of an older version, or not loaded yet, are known from it. */
function featuresBefore(features: readonly Feature[], log: readonly Command[]): Iterable<Feature> {
  const older = new Map(features.map((feature) => [keyOf(feature), feature]));
  const first = new Map<string, Feature | null>();
  for (const { edits } of log) for (const { key, from } of edits) if (!first.has(key)) first.set(key, from);
  for (const [key, from] of first) {
    if (from) older.set(key, from);
    else older.delete(key);
  }
  return older.values();
}

/** Reads what a draft has changed, and the nodes of its lanes, where they are beyond the loaded extent. Throws ApiError. */
async function addUnseen(theirs: Map<string, Feature>, site: Site, draft: Draft): Promise<void> {
  for (const layer of site.partial.peek()) {
    const ids = new Set<string>();
    for (const { edits } of draft.log) {
      for (const feature of edits.flatMap(({ from, to }) => [from, to])) {
        if (feature?.layer !== layer) continue;
        const ends = isEdge(feature) ? [feature.properties.source, feature.properties.target] : [];
        for (const id of [feature.id, ...ends.map(String)]) if (!theirs.has(keyOf({ ...feature, id }))) ids.add(id);
      }
    }
    for (const feature of await site.readFeatures(layer, [...ids])) theirs.set(keyOf(feature), feature);
  }
}
