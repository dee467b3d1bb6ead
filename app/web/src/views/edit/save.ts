/** Saving the changes as one version or in a draft; what others saved in the meantime is merged first. */
import { apiPath, asApiError, request, requestJson, type Schemas, type Version } from "../../api/client";
import type { Prefer } from "../history/merge-conflicts";
import { toWire } from "./draft";
import type { Editor } from "./editor";
import { summary } from "./words";

type ServerDraft = Schemas["DraftOut"];

/** number: of the new version, or revision of the draft. Nothing is left if others have saved the same, or theirs was chosen. */
export type Saved = { number: number; warnings: number } | "conflict" | "nothing left";

const MAX_ROUNDS = 5;

/** Sends first and merges when it is refused: a save whose answer was lost is answered again, not merged with itself.
 *
 * Throws ApiError. `resume` is called when conflicts that hold it up are decided. */
export async function save(editor: Editor, resume: () => void): Promise<Saved> {
  for (let round = 0; ; round++) {
    if (editor.count.peek() === 0) return "nothing left";
    try {
      const saved = await (editor.target.draft === null ? send(editor) : sendToDraft(editor, editor.target.draft));
      editor.saved(saved.number);
      void editor.site.refresh();
      return saved;
    } catch (error) {
      if (asApiError(error).status !== 412 || round >= MAX_ROUNDS) throw error;
      if (!(await mergeNewest(editor, resume, error))) return "conflict";
    }
  }
}

/** Returns whether nothing is left to decide. Throws an error if nothing newer can be read. */
async function mergeNewest(editor: Editor, resume: () => void, error: unknown): Promise<boolean> {
  const { head, site } = editor;
  await site.refresh();
  if (!head.isBehind) throw site.problem.peek() ?? error;
  return head.merge(resume);
}

/** What the server would say of the draft, without storing it. */
export async function dryRun(editor: Editor): Promise<Version> {
  return requestJson<Version>(apiPath(editor.site.path("edits")), {
    method: "POST",
    headers: { "content-type": "application/json" },
    body: bodyOf(editor, { dry_run: true }),
  });
}

async function send(editor: Editor): Promise<Exclude<Saved, string>> {
  const body = bodyOf(editor);
  const { version, warnings } = await requestJson<Version>(apiPath(editor.site.path("edits")), {
    method: "POST",
    headers: {
      "content-type": "application/json",
      "if-match": `"${editor.base.peek()}"`,
      // The same draft has the same key: a repeated save whose answer was lost is not saved twice.
      "idempotency-key": `edit-${editor.store.id}-${editor.base.peek()}-${hash(body)}`,
    },
    body,
  });
  return { number: version, warnings: warnings.length };
}

async function sendToDraft(editor: Editor, draft: string): Promise<Exclude<Saved, string>> {
  const changes = toWire(editor.draft.changes(), editor.draft.cells());
  const tag = `"${editor.target.ref}.${editor.base.peek()}"`;
  const path = apiPath(editor.site.path("drafts", draft, "edits"));
  const { revision } = await post<ServerDraft>(path, { changes }, { "if-match": tag });
  return { number: revision, warnings: 0 };
}

/** Makes the server's draft one version; what is not saved in it stays behind. Throws ApiError. */
export function commitDraft(editor: Editor, draft: string): Promise<Version> {
  const message = editor.message.peek().trim();
  // The same content has the same key: a repeated commit whose answer was lost is answered again.
  const key = `draft-${draft}-${editor.base.peek()}-${hash(message)}`;
  return post<Version>(apiPath(editor.site.path("drafts", draft, "commit")), { message }, { "idempotency-key": key });
}

/** Puts the server's draft on top of the newest version. Throws ApiError: 409 where both changed the same. */
export async function rebaseDraft(editor: Editor, draft: string, prefer?: Prefer): Promise<void> {
  await post<ServerDraft>(apiPath(editor.site.path("drafts", draft, "rebase")), { prefer });
  await editor.site.refresh();
}

/** Stores the changes as a draft on the server, to go on with on another machine. Throws ApiError.
 *
 * The server's draft begins with the newest version; the changes are merged with it first. Nothing is left of them if
 * others have saved the same, or theirs was chosen at all conflicts. */
export async function saveAsDraft(
  editor: Editor,
  name: string,
  resume: () => void,
): Promise<ServerDraft | "conflict" | "nothing left"> {
  const drafts = editor.site.path("drafts");
  for (let round = 0; ; round++) {
    if (editor.count.peek() === 0) return "nothing left";
    const made = await post<ServerDraft>(apiPath(drafts), name ? { name } : {});
    const remove = () => request(apiPath([...drafts, made.id]), { method: "DELETE" }).catch(() => undefined);
    if (made.base !== editor.base.peek()) {
      await remove();
      const error = new Error(`v${made.base} was saved in the meantime: try again`);
      if (round >= MAX_ROUNDS) throw error;
      if (!(await mergeNewest(editor, resume, error))) return "conflict";
      continue;
    }
    try {
      const changes = toWire(editor.draft.changes(), editor.draft.cells());
      return await post<ServerDraft>(apiPath([...drafts, made.id, "edits"]), { changes });
    } catch (error) {
      await remove();
      throw error;
    }
  }
}

function post<T>(path: string, body: object, headers: Record<string, string> = {}): Promise<T> {
  const sent = { "content-type": "application/json", ...headers };
  return requestJson<T>(path, { method: "POST", headers: sent, body: JSON.stringify(body) });
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
