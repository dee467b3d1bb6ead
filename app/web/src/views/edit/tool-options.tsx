/** Options of the tool in use, and points typed in metres. */
import { useState } from "preact/hooks";
import type { Position } from "../../map/features";
import { Button } from "../../ui/button";
import type { Desk } from "./desk";
import type { Editor } from "./editor";
import type { ToolName } from "./options";
import { AreaTool } from "./tools/area";
import { PathTool } from "./tools/path";

const HINTS: Record<ToolName, string> = {
  select: "Click a node, lane or area. Drag moves it; drop a node onto another to merge them, onto a lane to join it.",
  path: "Click in the void for a node and a lane to it, on a node to connect it, on a lane to split it. Enter ends.",
  split: "Click on a lane where it is to be split.",
  zone: "Click the corners. Click the first again, or press Enter, to finish.",
  object: "Click where it stands, or its corners; Enter finishes.",
  fence: "Click the corners of the place where robots may drive. It replaces the fence.",
  cells: "Click the corners of an area: all cells in it get the value.",
  brush: "Drag over cells to give them the value.",
};

export function ToolOptions({ desk }: { desk: Desk }) {
  const { editor } = desk;
  const name = editor.tool.value;
  const tool = desk.tool.value;
  return (
    <section class="edit-options" aria-label="Options of the tool">
      <p class="muted">{HINTS[name]}</p>
      {name === "path" && <PathOptions editor={editor} />}
      {name === "zone" && <ZoneOptions editor={editor} />}
      {name === "object" && <ObjectOptions editor={editor} />}
      {(name === "cells" || name === "brush") && <CellOptions editor={editor} withBrush={name === "brush"} />}
      {tool instanceof PathTool && <PointForm add={(at) => tool.addAt(at)} finish={() => tool.finish()} />}
      {tool instanceof AreaTool && (
        <PointForm
          add={(at) => tool.addAt(at)}
          finish={() => tool.finish()}
          count={tool.points.value.length}
          undo={() => tool.back()}
        />
      )}
    </section>
  );
}

function PathOptions({ editor }: { editor: Editor }) {
  const { oneWay, likeBefore } = editor.options.value;
  return (
    <div>
      <label class="check">
        <input
          type="checkbox"
          checked={oneWay}
          onChange={(event) => editor.set({ oneWay: event.currentTarget.checked })}
        />
        One-way lanes
      </label>
      <label class="check">
        <input
          type="checkbox"
          checked={likeBefore}
          onChange={(event) => editor.set({ likeBefore: event.currentTarget.checked })}
        />
        Action, speed and width as the lanes they continue
      </label>
    </div>
  );
}

function PointForm(props: { add: (at: Position) => void; finish: () => void; count?: number; undo?: () => void }) {
  const [x, setX] = useState("");
  const [y, setY] = useState("");
  const isWhole = [x, y].every((text) => text.trim() !== "" && Number.isFinite(Number(text)));
  const submit = (event: Event) => {
    event.preventDefault();
    if (isWhole) props.add([Number(x), Number(y)]);
  };
  return (
    <form class="edit-point" onSubmit={submit}>
      <label class="field">
        <span>x, metres</span>
        <input inputMode="decimal" value={x} onInput={(event) => setX(event.currentTarget.value)} />
      </label>
      <label class="field">
        <span>y, metres</span>
        <input inputMode="decimal" value={y} onInput={(event) => setY(event.currentTarget.value)} />
      </label>
      <Button type="submit" disabled={!isWhole}>
        Add point
      </Button>
      {props.count !== undefined && props.count > 0 && (
        <Button onClick={props.undo} label="Take back the last point">
          Back
        </Button>
      )}
      {props.count !== 0 && <Button onClick={props.finish}>Finish</Button>}
    </form>
  );
}

function ZoneOptions({ editor }: { editor: Editor }) {
  const options = editor.options.value;
  return (
    <div class="edit-fields">
      <label class="field">
        <span>Kind of zone</span>
        <select value={options.zoneKind} onChange={(event) => editor.set({ zoneKind: event.currentTarget.value })}>
          <option value="keepout">Keepout</option>
          <option value="speed">Speed limit</option>
          <option value="preferred">Preferred</option>
        </select>
      </label>
      {options.zoneKind === "speed" && (
        <NumberField
          label="Speed limit, m/s"
          value={options.speed}
          least={0.01}
          step={0.1}
          set={(speed) => editor.set({ speed })}
        />
      )}
      <NameField editor={editor} />
    </div>
  );
}

function NameField({ editor }: { editor: Editor }) {
  return (
    <label class="field">
      <span>Name (optional)</span>
      <input
        value={editor.options.value.name}
        maxLength={256}
        onInput={(event) => editor.set({ name: event.currentTarget.value })}
      />
    </label>
  );
}

function ObjectOptions({ editor }: { editor: Editor }) {
  const options = editor.options.value;
  return (
    <div class="edit-fields">
      <label class="field">
        <span>Shape</span>
        <select
          value={options.objectShape}
          onChange={(event) => editor.set({ objectShape: event.currentTarget.value as typeof options.objectShape })}
        >
          <option value="area">Area</option>
          <option value="line">Line</option>
          <option value="point">Point</option>
        </select>
      </label>
      <label class="field">
        <span>Kind</span>
        <input
          value={options.objectKind}
          list="edit-kinds"
          maxLength={64}
          onInput={(event) => editor.set({ objectKind: event.currentTarget.value })}
        />
      </label>
      <datalist id="edit-kinds">
        {kindsOf(editor).map((kind) => (
          <option key={kind} value={kind} />
        ))}
      </datalist>
      <NameField editor={editor} />
    </div>
  );
}

function kindsOf(editor: Editor): string[] {
  const kinds = new Set<string>(["obstacle", "building", "wall", "poi", "region"]);
  for (const { layer, properties } of editor.draft.features())
    if (layer === "objects" && typeof properties.kind === "string") kinds.add(properties.kind);
  return [...kinds].slice(0, 60);
}

function CellOptions({ editor, withBrush }: { editor: Editor; withBrush: boolean }) {
  const options = editor.options.value;
  const grids = editor.site.rasters.value.filter(({ layer }) => layer === "occupancy").map(({ name }) => name);
  const grid = grids.includes(options.grid) ? options.grid : grids.includes("map") ? "map" : (grids[0] ?? "");
  if (grid !== options.grid) queueMicrotask(() => editor.set({ grid }));
  return (
    <div class="edit-fields">
      <label class="field">
        <span>Grid</span>
        <select value={grid} onChange={(event) => editor.set({ grid: event.currentTarget.value })}>
          {grids.map((name) => (
            <option key={name}>{name}</option>
          ))}
        </select>
      </label>
      <label class="field">
        <span>Value</span>
        <select
          value={String(options.cellValue)}
          onChange={(event) => editor.set({ cellValue: Number(event.currentTarget.value) })}
        >
          <option value="100">Occupied (100)</option>
          <option value="0">Free (0)</option>
          <option value="255">Unknown</option>
        </select>
      </label>
      {withBrush && (
        <NumberField
          label="Brush, metres across"
          value={options.brush}
          least={0.01}
          step={0.1}
          set={(brush) => editor.set({ brush })}
        />
      )}
    </div>
  );
}

interface NumberFieldProps {
  label: string;
  value: number;
  least?: number;
  step?: number;
  set: (value: number) => void;
}

export function NumberField({ label, value, least, step, set }: NumberFieldProps) {
  return (
    <label class="field">
      <span>{label}</span>
      <input
        type="number"
        value={value}
        min={least}
        step={step}
        onChange={(event) => {
          const next = event.currentTarget.valueAsNumber;
          if (Number.isFinite(next) && (least === undefined || next >= least)) set(next);
          else event.currentTarget.value = String(value);
        }}
      />
    </label>
  );
}
