/** Drafts: what gathers in the page, in QGIS or on the command line until somebody commits it. */
import { GitMerge, Pencil, Save, Trash2 } from "lucide-preact";
import { useState } from "preact/hooks";
import { go } from "../../address";
import { apiPath, online, request, requestJson, type Schemas, type Version } from "../../api/client";
import { type Loaded, useLoaded } from "../../api/loaded";
import { can } from "../../session";
import type { Site } from "../../site";
import { Button } from "../../ui/button";
import { Dialog } from "../../ui/dialog";
import { Problem } from "../../ui/states";
import { Time } from "../../ui/text";
import { attempt, notify } from "../../ui/toast";
import { MergeConflicts, useMerge } from "./merge-conflicts";
import { changesInWords } from "./words";

type Draft = Schemas["DraftOut"];

export function Drafts({ site }: { site: Site }) {
  const isEditor = can("editor");
  const head = site.environment.value?.version;
  const drafts = useLoaded(
    async (signal) => (isEditor ? requestJson<Draft[]>(apiPath(site.path("drafts")), { signal }) : []),
    [site.name, head, isEditor],
  );
  const [left, setLeft] = useState<Draft | null>(null);
  if (drafts.problem) return <Problem error={drafts.problem} />;
  if (!drafts.data?.length) return null;
  return (
    <section class="history-part" aria-label="Drafts">
      <h2>Drafts</h2>
      <ul class="draft-list">
        {drafts.data.map((draft) => (
          <Row key={draft.id} site={site} draft={draft} drafts={drafts} onDelete={setLeft} />
        ))}
      </ul>
      <DeleteDialog site={site} draft={left} drafts={drafts} onClose={() => setLeft(null)} />
    </section>
  );
}

interface RowProps {
  site: Site;
  draft: Draft;
  drafts: Loaded<Draft[]>;
  onDelete: (draft: Draft) => void;
}

function Row({ site, draft, drafts, onDelete }: RowProps) {
  const [busy, setBusy] = useState(false);
  const changes = changesInWords(draft.changes);
  const mayWrite = draft.is_owner || can("admin");
  const run = async (work: () => Promise<void>) => {
    setBusy(true);
    await attempt(work);
    setBusy(false);
    drafts.reload();
  };
  const commit = async () => {
    const made = await post<Version>(site, draft, "commit", {}, { "if-match": `"${draft.base}"` });
    notify(`${draft.name} is saved as v${made.version}`, {
      action: { label: "Promote…", run: () => go({ promote: made.version }) },
    });
    go({ version: made.version });
    await site.refresh();
  };
  const { conflicts, merge } = useMerge(async (prefer) => {
    const moved = await post<Draft>(site, draft, "rebase", { prefer });
    notify(`${draft.name} builds on v${moved.base} now`);
  });
  return (
    <li>
      <div class="grow">
        <b>{draft.name}</b>
        <small>
          {draft.is_owner ? "yours" : draft.owner}, on v{draft.base}
          {draft.behind && ` (v${draft.head} was saved since)`}, <Time at={draft.changed} />
        </small>
        <small>{changes.length ? changes.join("; ") : "No changes yet"}</small>
      </div>
      <div class="actions">
        {changes.length > 0 && <Button onClick={() => go({ from: draft.base, to: draft.version })}>Review</Button>}
        {mayWrite && (
          <Button icon={Pencil} onClick={() => go({ view: "edit", version: draft.version })}>
            Continue editing
          </Button>
        )}
        {mayWrite && draft.behind && (
          <Button icon={GitMerge} busy={busy} disabled={!online.value} onClick={() => void run(() => merge())}>
            Merge with v{draft.head}
          </Button>
        )}
        {mayWrite && changes.length > 0 && !draft.behind && (
          <Button main icon={Save} busy={busy} disabled={!online.value} onClick={() => void run(commit)}>
            Commit
          </Button>
        )}
        {mayWrite && <Button quiet icon={Trash2} label={`Delete ${draft.name}`} onClick={() => onDelete(draft)} />}
      </div>
      {draft.behind && conflicts.length > 0 && (
        <MergeConflicts
          conflicts={conflicts}
          head={draft.head}
          busy={busy}
          onChoose={(prefer) => run(() => merge(prefer))}
        />
      )}
    </li>
  );
}

interface DeleteProps {
  site: Site;
  draft: Draft | null;
  drafts: Loaded<Draft[]>;
  onClose: () => void;
}

function DeleteDialog({ site, draft, drafts, onClose }: DeleteProps) {
  const remove = async () => {
    if (!draft) return;
    await attempt(() => request(apiPath(site.path("drafts", draft.id)), { method: "DELETE" }));
    onClose();
    drafts.reload();
  };
  return (
    <Dialog
      open={draft !== null}
      title={`Delete ${draft?.name ?? "the draft"}`}
      onClose={onClose}
      actions={
        <>
          <Button onClick={onClose}>Keep it</Button>
          <Button danger onClick={() => void remove()}>
            Delete for good
          </Button>
        </>
      }
    >
      <p>Its changes are lost: {draft && (changesInWords(draft.changes).join("; ") || "none")}.</p>
    </Dialog>
  );
}

function post<T>(
  site: Site,
  draft: Draft,
  what: string,
  body: object,
  headers: Record<string, string> = {},
): Promise<T> {
  return requestJson<T>(apiPath(site.path("drafts", draft.id, what)), {
    method: "POST",
    headers: { "content-type": "application/json", ...headers },
    body: JSON.stringify(body),
  });
}
