/** What a tool hears of the pointer and the keys. */
import type { Feature, Position } from "../../../map/features";
import type { SiteMap } from "../../../map/site-map";
import type { Editor } from "../editor";
import type { Sketch } from "../sketch";
import { type Snapped, snap } from "../snap";

export interface Press {
  /** Place in local metres. */
  at: Position;
  /** What lies there, points first. */
  hits: Feature[];
  touch: boolean;
  /** Shift, Ctrl or the button for several. */
  adds: boolean;
  shift: boolean;
  /** Alt or the button that releases snapping. */
  free: boolean;
  /** Metres within which something counts as touched. */
  reach: number;
}

export interface Context {
  editor: Editor;
  map: SiteMap;
  sketch: Sketch;
}

export abstract class Tool {
  constructor(protected readonly context: Context) {}

  protected get editor(): Editor {
    return this.context.editor;
  }

  /** A press that the tool takes as the start of a drag: the map then does not pan. */
  down(_press: Press): boolean {
    return false;
  }

  drag(_press: Press): void {}

  /** The end of a drag that the tool has taken. */
  drop(_press: Press): void {}

  click(_press: Press): void {}

  /** A second click at the same place. */
  double(_press: Press): void {}

  /** Right click, or a long press. */
  menu(press: Press): void {
    const hit = press.hits[0];
    if (hit) this.editor.select(this.editor.wholeOf(hit), { toggle: true });
  }

  move(_press: Press): void {}

  /** Enter. */
  finish(): void {}

  /** Backspace: takes back the last point. Returns whether there was one. */
  back(): boolean {
    return false;
  }

  /** Ends what is under way. Returns whether there was something. */
  cancel(): boolean {
    return false;
  }

  close(): void {
    this.cancel();
    this.context.sketch.marks.value = [];
  }

  protected snap(
    press: Press,
    more: { from?: Position; before?: Position; without?: ReadonlySet<string> } = {},
  ): Snapped {
    const { snap: options, free } = this.editor.options.peek();
    if (press.free || free) return { at: press.at, kind: "free" };
    const [x, y] = press.at;
    const reach = press.reach * 1.2;
    const near = this.context.map.index.inBox([x - reach, y - reach, x + reach, y + reach]);
    return snap(press.at, options, { near, reach: press.reach, ...more });
  }
}
