/** The features of the draft as a list: to search, and for those who do not use a pointer. */
import { useState } from "preact/hooks";
import { keyOf } from "./draft";
import type { Editor } from "./editor";
import { titleOf } from "./words";
import { SearchField } from "../../ui/search-field";

const SHOWN = 60;

export function DraftList({ editor }: { editor: Editor }) {
  const [text, setText] = useState("");
  const [open, setOpen] = useState(false);
  editor.revision.value;
  const level = editor.site.level.value;
  const wanted = text.trim().toLowerCase();
  const found = open
    ? editor.draft
        .features()
        .filter(
          (feature) =>
            feature.level === level &&
            (!wanted || `${titleOf(feature)} ${String(feature.properties.kind)}`.toLowerCase().includes(wanted)),
        )
    : [];
  return (
    <details class="feature-list" onToggle={(event) => setOpen(event.currentTarget.open)}>
      <summary>Features</summary>
      <SearchField label="Search features" hint="Search by name, id or kind" value={text} onInput={setText} />
      <ul class="rows">
        {found.slice(0, SHOWN).map((feature) => (
          <li key={keyOf(feature)}>
            <button
              type="button"
              class="row"
              aria-pressed={editor.selection.value.has(keyOf(feature))}
              onClick={(event) => {
                editor.select(editor.wholeOf(feature), { toggle: event.shiftKey || editor.options.peek().several });
                editor.map.reveal(feature);
              }}
            >
              <span class="grow">{titleOf(feature)}</span>
            </button>
          </li>
        ))}
      </ul>
      {found.length > SHOWN && <p class="muted">{found.length - SHOWN} more: search to find them.</p>}
    </details>
  );
}
