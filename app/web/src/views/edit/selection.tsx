/** What is selected: what can be done with it, its exact place, its properties. */
import { useEffect, useState } from "preact/hooks";
import { type Feature, linesOf, nameOf } from "../../map/features";
import { Button } from "../../ui/button";
import { count, metres } from "../../ui/text";
import { ACTIONS } from "./actions";
import { isEdge, isNode, keyOf } from "./draft";
import type { Editor } from "./editor";
import { lengthOf } from "./geometry";
import { place, setLength } from "./operations";
import { Properties } from "./properties";
import { placeOf } from "./transaction";

const GENERAL = new Set(["all", "copy", "paste", "undo", "redo"]);

export function Selection({ editor }: { editor: Editor }) {
  const features = editor.selected.value;
  const actions = ACTIONS.filter((action) => !GENERAL.has(action.id) && action.fits(editor));
  if (!features.length) return null;
  return (
    <section class="edit-selection" aria-label="Selection">
      <h2>{titleOf(editor, features)}</h2>
      <Direction editor={editor} features={features} />
      <div class="actions">
        {actions.map((action) => (
          <Button
            key={action.id}
            danger={action.id === "delete"}
            label={`${action.title} (${action.key})`}
            onClick={() => action.run(editor)}
          >
            {action.title}
          </Button>
        ))}
      </div>
      <Place editor={editor} features={features} />
      <Properties editor={editor} features={features} />
    </section>
  );
}

function titleOf(editor: Editor, features: Feature[]): string {
  const [first, second] = features;
  if (!first) return "";
  if (features.length === 1 && isEdge(first) && editor.draft.twinOf(first))
    return `One direction, ${String(first.properties.source)} → ${String(first.properties.target)}`;
  if (features.length === 1) return first.layer === "location" ? "Fence" : `${kindOf(first)} ${nameOf(first)}`;
  if (features.length === 2 && isEdge(first) && second && editor.draft.twinOf(first) === second)
    return `Two-way street ${String(first.properties.source)} – ${String(first.properties.target)}`;
  const nodes = features.filter(isNode).length;
  const lanes = features.filter(isEdge).length;
  const others = features.length - nodes - lanes;
  return [nodes && count(nodes, "node"), lanes && count(lanes, "lane"), others && count(others, "other feature")]
    .filter(Boolean)
    .join(", ");
}

export function kindOf(feature: Feature): string {
  if (isNode(feature)) return "Node";
  if (isEdge(feature)) return "One-way lane";
  const kind = String(feature.properties.kind ?? "");
  if (feature.layer === "zones") return `Zone (${kind})`;
  return kind ? kind[0]?.toUpperCase() + kind.slice(1) : "Object";
}

/** Both directions of a street, or one of them. */
function Direction({ editor, features }: { editor: Editor; features: Feature[] }) {
  const lane = features[0];
  const other = isEdge(lane) ? editor.draft.twinOf(lane) : undefined;
  if (!lane || !other || features.length > 2 || (features.length === 2 && features[1] !== other)) return null;
  const [forth, back] = String(lane.id) < String(other.id) ? [lane, other] : [other, lane];
  const chosen = features.length === 2 ? "both" : lane.id;
  const text = (edge: Feature) => `${String(edge.properties.source)} → ${String(edge.properties.target)}`;
  return (
    <fieldset class="edit-direction">
      <legend class="visually-hidden">Direction</legend>
      {[
        { id: "both", title: "Both directions", keys: [keyOf(forth), keyOf(back)] },
        { id: forth.id, title: text(forth), keys: [keyOf(forth)] },
        { id: back.id, title: text(back), keys: [keyOf(back)] },
      ].map(({ id, title, keys }) => (
        <label key={id} class="check">
          <input type="radio" name="direction" checked={chosen === id} onChange={() => editor.select(keys)} />
          {title}
        </label>
      ))}
    </fieldset>
  );
}

function Place({ editor, features }: { editor: Editor; features: Feature[] }) {
  const [first] = features;
  if (!first) return null;
  const lanes = features.filter(isEdge);
  if (features.length === 1 && first.geometry.type === "Point") {
    const [x = 0, y = 0] = placeOf(first);
    return (
      <div class="edit-fields">
        <Metres label="x, metres" value={x} set={(value) => editor.run(place(editor.draft, first, value, y))} />
        <Metres label="y, metres" value={y} set={(value) => editor.run(place(editor.draft, first, x, value))} />
      </div>
    );
  }
  const isStreet = lanes.length === features.length && (lanes.length === 1 || lanes.length === 2);
  const line = linesOf(first.geometry)[0];
  if (isStreet && line && line.length === 2) {
    return (
      <div class="edit-fields">
        <Metres
          label={`Length, metres (${String(first.properties.target)} moves)`}
          value={lengthOf(line)}
          set={(value) => editor.run(setLength(editor.draft, first, value))}
        />
      </div>
    );
  }
  const total = lanes
    .filter((lane) => {
      const twin = editor.draft.twinOf(lane);
      return !twin || lane.id < twin.id || !features.some((other) => other === twin);
    })
    .reduce((sum, lane) => sum + linesOf(lane.geometry).reduce((part, one) => part + lengthOf(one), 0), 0);
  return total ? <p class="muted">{metres(total)} of lanes</p> : null;
}

/** A length that can be typed; Enter or leaving the field sets it. */
function Metres({ label, value, set }: { label: string; value: number; set: (value: number) => void }) {
  const exact = String(Math.round(value * 1e6) / 1e6);
  const [text, setText] = useState(exact);
  useEffect(() => setText(exact), [exact]);
  const commit = () => {
    const next = Number(text.trim().replace(",", "."));
    if (text.trim() === "" || !Number.isFinite(next)) setText(exact);
    else if (text.trim() !== exact) set(next);
  };
  return (
    <label class="field">
      <span>{label}</span>
      <input
        inputMode="decimal"
        value={text}
        onInput={(event) => setText(event.currentTarget.value)}
        onBlur={commit}
        onKeyDown={(event) => {
          if (event.key === "Enter") commit();
          if (event.key === "Escape") setText(exact);
        }}
      />
    </label>
  );
}
