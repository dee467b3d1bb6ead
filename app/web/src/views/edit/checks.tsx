/** Checks while drawing: what the changes break, with repairs. */
import { signal } from "@preact/signals";
import { useEffect, useState } from "preact/hooks";
import { asApiError, isAbort, online } from "../../api/client";
import { Button } from "../../ui/button";
import { sentence } from "../../ui/states";
import { count } from "../../ui/text";
import { check, type Finding, type Findings, featuresOf, fixCommand } from "./findings";
import { keyOf } from "./draft";
import type { Editor } from "./editor";

const PAUSE = 1000;
const SHOWN = 30;

/** Whether the server has no checks: an older one. */
const missing = signal(false);

export function Checks({ editor }: { editor: Editor }) {
  const [findings, setFindings] = useState<Findings | null>(null);
  const revision = editor.revision.value;
  const level = editor.site.level.value;
  const isOnline = online.value;
  const total = editor.count.value;
  useEffect(() => {
    if (!isOnline || missing.value || total === 0) {
      setFindings(null);
      return;
    }
    const control = new AbortController();
    const timer = setTimeout(() => {
      check(editor, control.signal).then(setFindings, (error) => {
        if (isAbort(error)) return;
        const { status } = asApiError(error);
        if (status === 404 || status === 405) missing.value = true;
      });
    }, PAUSE);
    return () => {
      clearTimeout(timer);
      control.abort();
    };
  }, [editor, revision, level, isOnline, total]);
  if (!findings) return null;
  const { found, old } = findings;
  return (
    <section class="edit-checks" aria-label="Checks">
      <h2>
        Checks{" "}
        <span
          class={found.some(({ severity }) => severity === "error") ? "chip bad" : found.length ? "chip warn" : "chip"}
        >
          {found.length ? count(found.length, "new finding") : "nothing new"}
        </span>
      </h2>
      <ul>
        {found.slice(0, SHOWN).map((finding, index) => (
          <Row key={`${finding.rule}${finding.ids[0]}${index}`} editor={editor} finding={finding} />
        ))}
      </ul>
      {found.length > SHOWN && <p class="muted">and {found.length - SHOWN} more</p>}
      {old.length > 0 && (
        <p class="muted">
          {count(old.length, "finding")} of {editor.target.words(editor.base.value)} as before: see Checks.
        </p>
      )}
    </section>
  );
}

function Row({ editor, finding }: { editor: Editor; finding: Finding }) {
  const show = () => {
    const features = featuresOf(editor.draft, finding);
    editor.select(features.map(keyOf));
    if (features.length) editor.map.fitFeatures(features);
    else if (finding.where) {
      const [x, y] = finding.where;
      editor.map.fit([x - 5, y - 5, x + 5, y + 5]);
    }
  };
  return (
    <li>
      <button type="button" class="row" onClick={show}>
        <span class={`edit-severity ${finding.severity}`} aria-label={finding.severity} role="img" />
        <span class="grow">{sentence(finding.detail)}</span>
      </button>
      {finding.fix && (
        <Button
          label={finding.fix.title}
          onClick={() => editor.run(fixCommand(editor.draft, finding, editor.site.frame.peek()))}
        >
          Fix
        </Button>
      )}
    </li>
  );
}
