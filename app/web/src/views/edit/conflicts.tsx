/** What two people changed alike: mine, theirs or both, one by one on the map. */
import { useEffect, useState } from "preact/hooks";
import { boxOf, type Feature, joinBoxes } from "../../map/features";
import { colour } from "../../theme";
import { Button } from "../../ui/button";
import { count } from "../../ui/text";
import type { Editor } from "./editor";
import type { Pending } from "./head";
import { type Choice, type Conflict, canKeepBoth, changedFields, SHAPE, twinOf } from "./merge";
import { titleOf } from "./words";

const CHOICES: { choice: Choice; title: string }[] = [
  { choice: "mine", title: "Keep mine" },
  { choice: "theirs", title: "Keep theirs" },
  { choice: "both", title: "Keep both" },
];

export function Conflicts({ editor, pending }: { editor: Editor; pending: Pending }) {
  const all = pending.merge.conflicts;
  // Both directions of a street are decided at once.
  const conflicts = all.filter((one, index) => all.indexOf(twinOf(one, all) ?? one) >= index);
  const [at, setAt] = useState(0);
  const conflict = conflicts[Math.min(at, conflicts.length - 1)];
  const open = conflicts.filter(({ key }) => !pending.choices.has(key)).length;
  useEffect(() => {
    if (conflict) return showOnMap(editor, conflict);
  }, [editor, conflict]);
  if (!conflict) return null;
  const decide = (choice: Choice) => {
    editor.head.choose(conflict, choice);
    const next = conflicts.findIndex(({ key }, index) => index > at && !pending.choices.has(key));
    if (next >= 0) setAt(next);
  };
  return (
    <section class="edit-conflicts" aria-label="Conflicts">
      <h2>
        {count(conflicts.length, "conflict")} with {editor.target.words(pending.version)} by {pending.author}
      </h2>
      <p class="muted">
        Both of you changed the same. Choose for each; all else is merged. On the map yours is orange, theirs purple.
      </p>
      <ol class="rows">
        {conflicts.map((one, index) => (
          <li key={one.key}>
            <button type="button" class="row" aria-current={one === conflict} onClick={() => setAt(index)}>
              <span class="grow">{nameOf(one)}</span>
              <small>{CHOICES.find(({ choice }) => choice === pending.choices.get(one.key))?.title ?? "open"}</small>
            </button>
          </li>
        ))}
      </ol>
      <div class="edit-conflict" role="group" aria-label={nameOf(conflict)}>
        <dl>
          <dt>Mine</dt>
          <dd>{said(conflict, conflict.mine)}</dd>
          <dt>Theirs</dt>
          <dd>{said(conflict, conflict.theirs)}</dd>
        </dl>
        <div class="actions">
          {CHOICES.filter(({ choice }) => choice !== "both" || canKeepBoth(conflict)).map(({ choice, title }) => (
            <Button key={choice} pressed={pending.choices.get(conflict.key) === choice} onClick={() => decide(choice)}>
              {title}
            </Button>
          ))}
        </div>
      </div>
      <div class="actions">
        <Button
          main
          disabled={open > 0}
          onClick={() => {
            const { resume } = pending;
            editor.head.finish(pending);
            resume?.();
          }}
        >
          {open > 0 ? `${open} still open` : pending.resume ? "Merge and save" : "Merge"}
        </Button>
        <Button
          onClick={() => {
            editor.head.pending.value = null;
          }}
        >
          Later
        </Button>
      </div>
    </section>
  );
}

function nameOf({ before, mine, theirs }: Conflict): string {
  const feature = mine ?? theirs ?? before;
  return feature ? titleOf(feature) : "";
}

/** Says what someone has made of the fields that both changed. */
function said({ before, fields }: Conflict, after: Feature | null): string {
  if (!after) return "deleted";
  if (!before) return "added";
  const names = fields.length ? fields : changedFields(before, after);
  const parts = names.map((name) => {
    if (name !== SHAPE) {
      const value = JSON.stringify(after.properties[name]);
      return value === undefined ? `without ${name}` : `${name} = ${value.slice(0, 60)}`;
    }
    const at = after.geometry.type === "Point" ? after.geometry.coordinates.slice(0, 2) : null;
    return at ? `moved to ${at.map((value) => value.toFixed(3)).join(", ")}` : "another shape";
  });
  return parts.join(", ") || "unchanged";
}

/** Draws both forms and moves the map there. */
function showOnMap(editor: Editor, { mine, theirs, before }: Conflict): () => void {
  const { map } = editor;
  const tagged = (feature: Feature | null, side: string): Feature[] =>
    feature ? [{ ...feature, id: side, properties: { ...feature.properties, name: side, side } }] : [];
  const layer = map.addLayer(
    {
      classOf: (feature) => String(feature.properties.side),
      paints: () => ({
        theirs: { stroke: colour("robot"), width: 4, dot: 14, dash: [6, 4], labels: true },
        mine: { stroke: colour("accent"), width: 3, dot: 9, labels: true },
      }),
    },
    40,
  );
  const features = [...tagged(theirs, "theirs"), ...tagged(mine, "mine")];
  layer.setFeatures(features.length ? features : tagged(before, "mine"));
  const box = joinBoxes([mine, theirs, before].filter((one) => one !== null).map(({ geometry }) => boxOf(geometry)));
  if (box) {
    const margin = Math.max(1, box[2] - box[0], box[3] - box[1]) / 3;
    map.fit([box[0] - margin, box[1] - margin, box[2] + margin, box[3] + margin]);
  }
  return () => map.removeLayer(layer);
}
