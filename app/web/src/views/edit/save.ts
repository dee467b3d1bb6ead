/** Saving a draft as one version; what others saved in the meantime is merged first. */
import { apiPath, asApiError, request, requestJson, type Schemas, type Version } from "../../api/client";
import { toWire } from "./draft";
import type { Editor } from "./editor";
import { summary } from "./words";

export type Saved = { version: Version } | "conflict";

const MAX_ROUNDS = 5;

/** Sends first and merges when it is refused: a save whose answer was lost is answered again, not merged with itself.
 *
 * Throws ApiError. `resume` is called when conflicts that hold it up are decided. */
export async function save(editor: Editor, resume: () => void): Promise<Saved> {
  for (let round = 0; ; round++) {
    try {
      const version = await send(editor);
      editor.saved(version.version ?? 0);
      void editor.site.refresh();
      return { version };
    } catch (error) {
      if (asApiError(error).status !== 412 || round >= MAX_ROUNDS) throw error;
      await editor.site.refresh();
      const { head, site } = editor;
      if (!head.isBehind) throw site.problem.peek() ?? error;
      if (!head.merge(resume)) return "conflict";
      const version = site.version.peek() as Version;
      if (editor.count.peek() === 0) return { version }; // others have saved the same
    }
  }
}

/** What the server would say of the draft, without storing it. */
export async function dryRun(editor: Editor): Promise<Version> {
  return requestJson<Version>(apiPath(editor.site.path("edits")), {
    method: "POST",
    headers: { "content-type": "application/json" },
    body: bodyOf(editor, { dry_run: true }),
  });
}

async function send(editor: Editor): Promise<Version> {
  const body = bodyOf(editor);
  return requestJson<Version>(apiPath(editor.site.path("edits")), {
    method: "POST",
    headers: {
      "content-type": "application/json",
      "if-match": `"${editor.base.peek()}"`,
      // The same draft has the same key: a repeated save whose answer was lost is not saved twice.
      "idempotency-key": `edit-${editor.store.id}-${editor.base.peek()}-${hash(body)}`,
    },
    body,
  });
}

/** Stores the changes as a draft on the server, to go on with on another machine. Throws ApiError. */
export async function saveAsDraft(editor: Editor, name: string): Promise<Schemas["DraftOut"]> {
  const send = <T>(path: string, body: unknown) =>
    requestJson<T>(path, {
      method: "POST",
      headers: { "content-type": "application/json" },
      body: JSON.stringify(body),
    });
  const drafts = editor.site.path("drafts");
  const made = await send<Schemas["DraftOut"]>(apiPath(drafts), name ? { name } : {});
  try {
    const changes = toWire(editor.draft.changes(), editor.draft.cells());
    return await send<Schemas["DraftOut"]>(apiPath([...drafts, made.id, "edits"]), { changes });
  } catch (error) {
    await request(apiPath([...drafts, made.id]), { method: "DELETE" }).catch(() => undefined);
    throw error;
  }
}

function bodyOf(editor: Editor, more: Record<string, unknown> = {}): string {
  const [changes, cells] = [editor.draft.changes(), editor.draft.cells()];
  const message = editor.message.peek().trim() || summary(editor.groups.peek(), cells);
  return JSON.stringify({ message, changes: toWire(changes, cells), ...more });
}

/** FNV-1a, twice with different seeds. */
function hash(text: string): string {
  let [one, two] = [0x811c9dc5, 0x01000193];
  for (let index = 0; index < text.length; index++) {
    const code = text.charCodeAt(index);
    one = Math.imul(one ^ code, 0x01000193);
    two = Math.imul(two ^ code, 0x5bd1e995);
  }
  return `${(one >>> 0).toString(16)}${(two >>> 0).toString(16)}${text.length.toString(16)}`;
}
