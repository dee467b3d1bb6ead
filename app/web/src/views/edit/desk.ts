/** Puts the editor, the tools, the pointer and the keys together for as long as the view is open. */
import { effect, signal } from "@preact/signals";
import type { Position } from "../../map/features";
import type { SiteMap } from "../../map/site-map";
import type { Site } from "../../site";
import { isTyping } from "../site-view";
import { actionFor, nudge } from "./actions";
import { Editor } from "./editor";
import type { ToolName } from "./options";
import { EditPointer } from "./pointer";
import { point, Sketch } from "./sketch";
import { AreaTool } from "./tools/area";
import { BrushTool } from "./tools/brush";
import { PathTool } from "./tools/path";
import { SelectTool } from "./tools/select";
import { SplitTool } from "./tools/split";
import type { Context, Tool } from "./tools/tool";

export const TOOL_KEYS: Record<string, ToolName> = {
  s: "select",
  a: "path",
  x: "split",
  z: "zone",
  o: "object",
  f: "fence",
  c: "cells",
  b: "brush",
};

const ARROWS: Record<string, [number, number]> = {
  ArrowLeft: [-1, 0],
  ArrowRight: [1, 0],
  ArrowUp: [0, 1],
  ArrowDown: [0, -1],
};

export class Desk {
  readonly editor: Editor;
  readonly sketch: Sketch;
  readonly review = signal(false);
  readonly help = signal(false);
  /** Whether the cross in the middle of the map is the pointer, because the keyboard moves the map. */
  readonly cross = signal(false);
  readonly tool = signal<Tool>(null as unknown as Tool);
  private readonly pointer: EditPointer;
  private readonly stops: (() => void)[] = [];

  constructor(
    readonly site: Site,
    readonly map: SiteMap,
    ref: string,
  ) {
    this.editor = new Editor(site, map, ref);
    this.sketch = new Sketch(this.editor, map);
    const context: Context = { editor: this.editor, map, sketch: this.sketch };
    const take = () => true;
    this.pointer = new EditPointer(
      this.editor,
      map,
      () => this.tool.peek(),
      () => map.picker === take,
    );
    map.map.addInteraction(this.pointer);
    this.stops.push(
      map.takePicks(take),
      effect(() => {
        const name = this.editor.tool.value;
        this.tool.peek()?.close();
        this.tool.value = create(name, context);
      }),
      effect(() => this.drawCross()),
      effect(() => {
        if (map.selected.value) map.selected.value = null; // the draft has a selection of its own
      }),
      listen(window, "keydown", (event) => this.key(event as KeyboardEvent)),
      listen(map.map.getViewport(), "pointermove", () => {
        this.cross.value = false;
      }),
      listen(map.map.getViewport(), "contextmenu", (event) => event.preventDefault()),
      () => {
        map.map.removeInteraction(this.pointer);
        this.pointer.stop();
        this.pointer.dispose();
      },
    );
  }

  close(): void {
    this.tool.peek().close();
    for (const stop of this.stops) stop();
    this.sketch.close();
    this.map.hideFeatures([]);
    this.editor.close();
  }

  private drawCross(): void {
    if (!this.cross.value) return;
    this.map.resolution.value;
    const centre = this.map.map.getView().getCenter() as Position | undefined;
    if (centre) this.tool.peek().move(this.crossPress(centre));
    this.sketch.marks.value = [...this.sketch.marks.peek(), ...(centre ? [point("cross", centre)] : [])];
  }

  private crossPress(at: Position) {
    return this.pointer.pressAt(at, false, { shiftKey: false, ctrlKey: false, metaKey: false, altKey: false });
  }

  private key(event: KeyboardEvent): void {
    if (isTyping(event) || document.querySelector("dialog[open]")) return;
    const onMap = event.target === this.map.map.getTargetElement();
    const isButton = (event.target as HTMLElement).closest("button, a, summary, input, select") !== null;
    if (this.commandKey(event) || this.toolKey(event) || this.arrowKey(event, onMap)) {
      event.preventDefault();
      return;
    }
    if (isButton) return;
    if (event.key === "Enter") this.tool.peek().finish();
    else if (event.key === " " && onMap) this.pressCross();
    else return;
    event.preventDefault();
  }

  private commandKey(event: KeyboardEvent): boolean {
    const control = event.ctrlKey || event.metaKey;
    const letter = event.key.length === 1 ? event.key.toUpperCase() : event.key;
    if (control && letter === "Z" && event.shiftKey) this.editor.redo();
    else if (control && letter === "S") this.review.value = true;
    else if (event.key === "?") this.help.value = true;
    else if (event.key === "Escape") this.escape();
    else if (event.key === "Backspace") {
      if (!this.tool.peek().back()) this.act("Delete");
    } else if (letter === "G" && !control) {
      const { snap } = this.editor.options.peek();
      this.editor.set({ snap: { ...snap, grid: !snap.grid } });
    } else return this.act(`${control ? "Ctrl+" : ""}${event.shiftKey ? "Shift+" : ""}${letter}`);
    return true;
  }

  private act(key: string): boolean {
    const action = actionFor(this.editor, key);
    if (!action || (key === "C" && !action.fits(this.editor))) return false;
    if (key === "Ctrl+C" && String(getSelection())) return false; // text is copied
    action.run(this.editor);
    return true;
  }

  private toolKey(event: KeyboardEvent): boolean {
    if (event.ctrlKey || event.metaKey || event.altKey || event.shiftKey) return false;
    const name = TOOL_KEYS[event.key.toLowerCase()];
    if (!name) return false;
    this.editor.setTool(name);
    return true;
  }

  private arrowKey(event: KeyboardEvent, onMap: boolean): boolean {
    const arrow = ARROWS[event.key];
    if (!arrow || (!onMap && event.target !== document.body)) return false;
    if (!event.shiftKey) {
      if (onMap) this.cross.value = true;
      setTimeout(() => this.drawCross(), 180);
      return false;
    }
    nudge(this.editor, ...arrow);
    return true;
  }

  private pressCross(): void {
    this.cross.value = true;
    const centre = this.map.map.getView().getCenter() as Position | undefined;
    if (centre) this.tool.peek().click(this.crossPress(centre));
    this.drawCross();
  }

  private escape(): void {
    if (this.tool.peek().cancel()) return;
    if (this.editor.tool.peek() !== "select") this.editor.setTool("select");
    else this.editor.select([]);
  }
}

function create(name: ToolName, context: Context): Tool {
  switch (name) {
    case "path":
      return new PathTool(context);
    case "split":
      return new SplitTool(context);
    case "brush":
      return new BrushTool(context);
    case "select":
      return new SelectTool(context);
    default:
      return new AreaTool(context, name);
  }
}

function listen(target: EventTarget | undefined, type: string, run: (event: Event) => void): () => void {
  target?.addEventListener(type, run);
  return () => target?.removeEventListener(type, run);
}
