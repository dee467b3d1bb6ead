/** The changes in words, a message, and saving. */
import { Crosshair, Undo2 } from "lucide-preact";
import { useEffect, useState } from "preact/hooks";
import { go } from "../../address";
import { type ApiError, asApiError, online, type Version } from "../../api/client";
import { type Feature } from "../../map/features";
import { expired } from "../../session";
import { Button } from "../../ui/button";
import { Dialog } from "../../ui/dialog";
import { Findings, Problem, sentence } from "../../ui/states";
import { count } from "../../ui/text";
import { notify } from "../../ui/toast";
import type { Desk } from "./desk";
import type { Editor } from "./editor";
import { MergeConflicts, type Prefer, useMerge } from "../history/merge-conflicts";
import { changesInWords } from "../history/words";
import { commitDraft, dryRun, rebaseDraft, save, saveAsDraft } from "./save";
import { type ChangeRow, cellTitle, summary } from "./words";

const SHOWN = 200;

export function Review({ desk }: { desk: Desk }) {
  const { editor } = desk;
  const busy = editor.sending.value;
  const [problem, setProblem] = useState<ApiError | null>(null);
  const close = () => {
    desk.review.value = false;
  };
  const isOpen = desk.review.value && editor.head.pending.value === null;
  useEffect(() => setProblem(null), [isOpen]);
  const run = async (work: () => Promise<void>) => {
    setProblem(null);
    try {
      await editor.whileSending(work);
    } catch (error) {
      setProblem(asApiError(error));
    }
  };
  const submit = () =>
    run(async () => {
      const words = editor.target.words(null);
      const result = await save(editor, () => void submit());
      if (result === "conflict") return;
      close();
      if (result === "nothing left") return notify("Nothing was saved: you have no changes to the newest version");
      const warnings = result.warnings ? `, with ${count(result.warnings, "warning")}` : "";
      notify(draft === null ? `Saved as v${result.number}${warnings}` : `Saved in ${words}`);
    });
  const keep = (): Promise<void> =>
    run(async () => {
      const kept = await saveAsDraft(editor, editor.message.peek().trim().slice(0, 100), () => void keep());
      if (kept === "conflict") return;
      editor.discard();
      close();
      if (kept === "nothing left") return notify("No draft was made: you have no changes to the newest version");
      notify(`Kept as the draft ${kept.name}`, { action: { label: "Drafts", run: () => go({ view: "history" }) } });
    });
  const commit = (id: string): Promise<void> =>
    run(async () => {
      const message = editor.message.peek();
      const unsaved = editor.count.peek() > 0;
      if (unsaved && (await save(editor, () => void commit(id))) === "conflict") return;
      editor.message.value = message; // saving has cleared it
      const made = await commitDraft(editor, id);
      editor.discard();
      close();
      notify(`Saved as v${made.version}`);
      go({ version: "latest" }, { replace: true });
    });
  const { draft, olderBase } = editor.target;
  const total = editor.count.value;
  const isCut = !online.value || expired.value;
  return (
    <Dialog
      open={isOpen}
      title="Review and save"
      onClose={close}
      wide
      actions={
        <>
          <DiscardButton editor={editor} busy={busy} close={close} />
          <span class="spacer" />
          <Button onClick={close}>Go on editing</Button>
          {draft === null ? (
            <Button busy={busy} disabled={total === 0 || isCut || editor.head.isBehind} onClick={() => void keep()}>
              Keep as a draft
            </Button>
          ) : (
            <Button
              busy={busy}
              disabled={isCut || olderBase !== null || (total === 0 && !savedChanges(editor).length)}
              onClick={() => void commit(draft)}
            >
              {total ? "Save and commit" : "Commit"}
            </Button>
          )}
          <Button main busy={busy} disabled={total === 0 || isCut} onClick={() => void submit()}>
            Save {count(total, "change")}
            {draft !== null && " in the draft"}
          </Button>
        </>
      }
    >
      {problem && !(problem.status === 401 && !expired.value) && <Problem error={problem} />}
      {!online.value && (
        <p class="note" role="status">
          Offline: your changes are kept on this device. Save when the server answers again.
        </p>
      )}
      {editor.head.isBehind && (
        <p class="note" role="status">
          {sentence(editor.target.words(editor.target.number))} was saved in the meantime. Saving merges your changes
          with it.
        </p>
      )}
      {draft !== null && (
        <DraftState editor={editor} busy={busy} run={run} rebase={(prefer) => rebaseDraft(editor, draft, prefer)} />
      )}
      <ChangeList editor={editor} close={close} />
      <Warnings editor={editor} open={isOpen} />
      <label class="field">
        <span>Message</span>
        <textarea
          rows={2}
          autofocus
          maxLength={1000}
          placeholder={summary(editor.groups.value, editor.cells.value)}
          value={editor.message.value}
          onInput={(event) => editor.setMessage(event.currentTarget.value)}
        />
        <small>What changed and why, for those who look at the history.</small>
      </label>
    </Dialog>
  );
}

interface DraftStateProps {
  editor: Editor;
  busy: boolean;
  run: (work: () => Promise<void>) => Promise<void>;
  rebase: (prefer?: Prefer) => Promise<void>;
}

/** What the draft holds already, and the version that it must be merged with before it is committed. */
function DraftState({ editor, busy, run, rebase }: DraftStateProps) {
  const saved = savedChanges(editor);
  const { olderBase } = editor.target;
  const head = editor.site.environment.value?.version;
  const { conflicts, merge } = useMerge(rebase);
  return (
    <>
      <p class="muted">Saved in the draft: {saved.join("; ") || "nothing yet"}.</p>
      {olderBase !== null && conflicts.length > 0 && (
        <MergeConflicts conflicts={conflicts} head={head} busy={busy} onChoose={(prefer) => run(() => merge(prefer))} />
      )}
      {olderBase !== null && conflicts.length === 0 && (
        <div class="note" role="status">
          <p class="grow">
            The draft was made from v{olderBase}, and v{head} was saved since. Merge it with v{head} before you commit
            it.
          </p>
          <Button busy={busy} disabled={!online.value || expired.value} onClick={() => void run(() => merge())}>
            Merge with v{head}
          </Button>
        </div>
      )}
    </>
  );
}

function savedChanges(editor: Editor): string[] {
  return changesInWords(editor.target.content?.changes ?? {});
}

function DiscardButton({ editor, busy, close }: { editor: Editor; busy: boolean; close: () => void }) {
  const [asked, setAsked] = useState(false);
  if (editor.count.value === 0) return null;
  return (
    <Button
      danger
      busy={busy}
      onClick={() => {
        if (!asked) return setAsked(true);
        editor.discard();
        setAsked(false);
        close();
      }}
    >
      {asked ? "Discard all for good" : "Discard all"}
    </Button>
  );
}

function ChangeList({ editor, close }: { editor: Editor; close: () => void }) {
  const groups = editor.groups.value;
  const cells = editor.cells.value;
  if (!groups.length && !cells.length)
    return <p class="muted">Nothing has changed {editor.target.draft === null ? "yet" : "since it was saved"}.</p>;
  const show = (features: Feature[], keys: string[]) => {
    editor.select(keys.filter((key) => editor.draft.get(key)));
    editor.map.fitFeatures(features);
    close();
  };
  return (
    <>
      {groups.map(({ layer, rows }) => (
        <section key={layer} class="edit-changes" aria-label={`${layer}: changes`}>
          <h3>
            {layer} <small>{count(rows.length, "change")}</small>
          </h3>
          <ul>
            {rows.slice(0, SHOWN).map((row) => (
              <Row key={row.change.key} row={row} editor={editor} show={show} />
            ))}
          </ul>
          {rows.length > SHOWN && <p class="muted">and {rows.length - SHOWN} more</p>}
        </section>
      ))}
      {cells.length > 0 && (
        <section class="edit-changes" aria-label="Cells: changes">
          <h3>
            Cells <small>{count(cells.length, "change")}</small>
          </h3>
          <ul>
            {cells.map((cell) => (
              <li key={cell.id}>
                <span class="chip changed">changed</span>
                <span class="grow">{cellTitle(cell)}</span>
                <Button
                  quiet
                  icon={Undo2}
                  label={`Take back: ${cellTitle(cell)}`}
                  onClick={() => editor.dropCells(cell.id)}
                />
              </li>
            ))}
          </ul>
        </section>
      )}
    </>
  );
}

interface RowProps {
  row: ChangeRow;
  editor: Editor;
  show: (features: Feature[], keys: string[]) => void;
}

function Row({ row, editor, show }: RowProps) {
  const { before, after } = row.change;
  const revert = () => editor.revert(editor.changes.peek().filter(({ key }) => row.keys.includes(key)));
  return (
    <li>
      <span class={`chip ${row.kind}`}>{row.kind}</span>
      <span class="grow">
        {row.title}
        {row.detail && <small>{row.detail}</small>}
      </span>
      <Button
        quiet
        icon={Crosshair}
        label={`Show ${row.title} on the map`}
        onClick={() =>
          show(
            [after ?? before].filter((one) => one !== null),
            row.keys,
          )
        }
      />
      <Button quiet icon={Undo2} label={`Take back: ${row.title}`} onClick={revert} />
    </li>
  );
}

/** What the server would warn of; a server without dry runs says nothing. */
function Warnings({ editor, open }: { editor: Editor; open: boolean }) {
  const [answer, setAnswer] = useState<{ warnings: Version["warnings"]; problem: ApiError | null } | null>(null);
  const revision = editor.revision.value;
  useEffect(() => {
    setAnswer(null);
    if (!open || editor.target.draft !== null || editor.count.peek() === 0 || !online.peek() || editor.head.isBehind)
      return;
    let isOver = false;
    dryRun(editor).then(
      ({ warnings }) => {
        if (!isOver) setAnswer({ warnings, problem: null });
      },
      (error) => {
        const problem = asApiError(error);
        if (!isOver && problem.status === 422 && !problem.message.includes("dry_run"))
          setAnswer({ warnings: [], problem });
      },
    );
    return () => {
      isOver = true;
    };
  }, [open, revision, editor]);
  if (answer?.problem) return <Problem error={answer.problem} />;
  if (!answer?.warnings?.length) return null;
  return (
    <div class="note" role="status">
      <b>The server would warn:</b>
      <Findings items={answer.warnings} />
    </div>
  );
}
