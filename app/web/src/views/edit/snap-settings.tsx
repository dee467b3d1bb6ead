/** What attracts the pointer. */
import type { Editor } from "./editor";
import { NumberField } from "./tool-options";

const TARGETS = [
  { key: "nodes", title: "Nodes and corners" },
  { key: "edges", title: "Lanes and outlines" },
  { key: "angles", title: "45° from the last point" },
  { key: "grid", title: "Grid of metres (G)" },
] as const;

export function SnapSettings({ editor }: { editor: Editor }) {
  const { snap } = editor.options.value;
  return (
    <details class="edit-snap">
      <summary>Snapping</summary>
      <div class="edit-fields">
        {TARGETS.map(({ key, title }) => (
          <label key={key} class="check">
            <input
              type="checkbox"
              checked={snap[key]}
              onChange={(event) => editor.set({ snap: { ...snap, [key]: event.currentTarget.checked } })}
            />
            {title}
          </label>
        ))}
        <NumberField
          label="Grid, metres"
          value={snap.step}
          least={0.001}
          step={0.1}
          set={(step) => editor.set({ snap: { ...snap, step } })}
        />
      </div>
    </details>
  );
}
