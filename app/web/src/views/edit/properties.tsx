/** Properties of the selected features: common values are shown, differing ones named as such. */
import { Trash2 } from "lucide-preact";
import { useEffect, useState } from "preact/hooks";
import type { Feature } from "../../map/features";
import { Button } from "../../ui/button";
import { same } from "./draft";
import type { Editor } from "./editor";
import { setProperty } from "./operations";

const CONNECTION = new Set(["source", "target"]);

export function Properties({ editor, features }: { editor: Editor; features: Feature[] }) {
  const isNetwork = features.some(({ layer }) => layer === "topology");
  const names = new Set<string>(["name"]);
  for (const { properties } of features.slice(0, 2000)) for (const name of Object.keys(properties)) names.add(name);
  const shown = [...names].filter(
    (name) => !(isNetwork && (CONNECTION.has(name) || name === "kind")) && name !== "datum",
  );
  const set = (name: string, value: unknown) => editor.run(setProperty(editor.draft, features, name, value));
  return (
    <div class="edit-properties">
      <h3>Properties</h3>
      {shown.map((name) => (
        <Property
          key={name}
          name={name}
          values={features.slice(0, 2000).map(({ properties }) => properties[name])}
          set={(value) => set(name, value)}
        />
      ))}
      <NewProperty set={set} />
    </div>
  );
}

function Property({ name, values, set }: { name: string; values: unknown[]; set: (value: unknown) => void }) {
  const first = values[0];
  const isMixed = values.some((value) => !same(value, first));
  const shown = isMixed || first === undefined ? "" : toText(name, first);
  const [text, setText] = useState(shown);
  useEffect(() => setText(shown), [shown]);
  const commit = () => {
    if (text === shown) return;
    set(text.trim() === "" ? undefined : fromText(name, text));
  };
  const isLong = shown.length > 40;
  const fields = {
    value: text,
    placeholder: isMixed ? "several values" : "",
    onInput: (event: { currentTarget: { value: string } }) => setText(event.currentTarget.value),
    onBlur: commit,
  };
  return (
    <div class="edit-property">
      <label>
        <span>{name}</span>
        {isLong ? (
          <textarea {...fields} rows={3} />
        ) : (
          <input
            {...fields}
            onKeyDown={(event) => {
              if (event.key === "Enter") commit();
              if (event.key === "Escape") setText(shown);
            }}
          />
        )}
      </label>
      {(isMixed || first !== undefined) && (
        <Button quiet icon={Trash2} label={`Remove ${name}`} onClick={() => set(undefined)} />
      )}
    </div>
  );
}

function NewProperty({ set }: { set: (name: string, value: unknown) => void }) {
  const [name, setName] = useState("");
  const [text, setText] = useState("");
  const submit = (event: Event) => {
    event.preventDefault();
    if (!name.trim() || !text.trim()) return;
    set(name.trim(), fromText(name.trim(), text));
    setName("");
    setText("");
  };
  return (
    <form class="edit-property" onSubmit={submit}>
      <input
        aria-label="New property"
        placeholder="speed_limit"
        value={name}
        list="edit-properties"
        onInput={(event) => setName(event.currentTarget.value)}
      />
      <datalist id="edit-properties">
        {["name", "speed_limit", "width", "action", "surface", "access", "orientation", "value", "expires"].map(
          (one) => (
            <option key={one} value={one} />
          ),
        )}
      </datalist>
      <input
        aria-label="Value of the new property"
        placeholder="0.8"
        value={text}
        onInput={(event) => setText(event.currentTarget.value)}
      />
      <Button type="submit" disabled={!name.trim() || !text.trim()}>
        Set
      </Button>
    </form>
  );
}

/** The text from which `fromText` reads a value, but for spaces at the ends of names. */
export function toText(name: string, value: unknown): string {
  return typeof value === "string" && (name === "name" || fromText(name, value) === value)
    ? value
    : JSON.stringify(value);
}

/** Reads JSON; anything else is a text, and so is what people call something. */
export function fromText(name: string, text: string): unknown {
  if (name === "name") return text.trim();
  try {
    return JSON.parse(text) as unknown;
  } catch {
    return text.trim();
  }
}
