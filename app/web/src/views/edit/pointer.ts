/** Hands the gestures on the map to the tool: press, drag, click, long press; two fingers stay the map's. */
import Interaction from "ol/interaction/Interaction";
import type MapBrowserEvent from "ol/MapBrowserEvent";
import type { Position } from "../../map/features";
import { isHidden, type SiteMap } from "../../map/site-map";
import type { Editor } from "./editor";
import type { Press, Tool } from "./tools/tool";

const MOUSE = { reach: 9, move: 4 };
const TOUCH = { reach: 20, move: 10 };
const LONG_PRESS = 550;
const DOUBLE = 350;

interface Down {
  id: number;
  x: number;
  y: number;
  taken: boolean;
  moved: boolean;
  touch: boolean;
  timer: number;
}

export class EditPointer extends Interaction {
  private down: Down | null = null;
  private readonly fingers = new Set<number>();
  private lastClick = { time: 0, x: 0, y: 0 };
  private frame = 0;

  constructor(
    private readonly editor: Editor,
    private readonly siteMap: SiteMap,
    private readonly tool: () => Tool,
    /** Whether this view has the pointer; measuring may have it. */
    private readonly isFree: () => boolean,
  ) {
    super();
  }

  override handleEvent(event: MapBrowserEvent<PointerEvent>): boolean {
    const { originalEvent: source } = event;
    if (!source || !this.isFree()) return true;
    if (this.editor.hold && !this.down) {
      if ((event.type as string) === "singleclick") this.editor.refuse();
      return true;
    }
    switch (event.type as string) {
      case "pointerdown":
        return this.press(source);
      case "pointerdrag":
        return this.dragged(source);
      case "pointerup":
        return this.released(source);
      case "pointermove":
        if (!this.down) this.hover(source);
        return true;
      case "dblclick":
        return false; // tools have their own double click; it must not zoom
      case "contextmenu":
        source.preventDefault();
        this.tool().menu(this.pressOf(source));
        return false;
      default:
        return true;
    }
  }

  private press(source: PointerEvent): boolean {
    this.fingers.add(source.pointerId);
    if (this.fingers.size > 1) {
      this.abort();
      return true;
    }
    if (source.button !== 0) return true;
    const touch = source.pointerType === "touch";
    const taken = this.tool().down(this.pressOf(source));
    const down: Down = {
      id: source.pointerId,
      x: source.clientX,
      y: source.clientY,
      taken,
      moved: false,
      touch,
      timer: 0,
    };
    if (touch) down.timer = window.setTimeout(() => this.longPress(source), LONG_PRESS);
    this.down = down;
    return !taken;
  }

  private longPress(source: PointerEvent): void {
    if (!this.down || this.down.moved) return;
    this.abort();
    this.tool().menu(this.pressOf(source));
  }

  private dragged(source: PointerEvent): boolean {
    const { down } = this;
    if (!down || source.pointerId !== down.id) return true;
    const off = Math.hypot(source.clientX - down.x, source.clientY - down.y);
    if (!down.moved && off < (down.touch ? TOUCH : MOUSE).move) return !down.taken;
    if (!down.moved) clearTimeout(down.timer);
    down.moved = true;
    if (!down.taken) return true;
    this.inFrame(() => {
      if (this.down === down) this.tool().drag(this.pressOf(source));
    });
    return false;
  }

  private released(source: PointerEvent): boolean {
    this.fingers.delete(source.pointerId);
    const { down } = this;
    if (!down || source.pointerId !== down.id) return true;
    clearTimeout(down.timer);
    cancelAnimationFrame(this.frame);
    this.frame = 0;
    this.down = null;
    const press = this.pressOf(source);
    if (down.moved) {
      if (down.taken) {
        this.tool().drag(press);
        this.tool().drop(press);
      }
      return true;
    }
    if (down.taken) this.tool().cancel();
    this.clicked(source, press);
    return true;
  }

  private clicked(source: PointerEvent, press: Press): void {
    const before = this.lastClick;
    const near = Math.hypot(source.clientX - before.x, source.clientY - before.y) < (press.touch ? 24 : 6);
    const isDouble = source.timeStamp - before.time < DOUBLE && near;
    this.lastClick = { time: isDouble ? 0 : source.timeStamp, x: source.clientX, y: source.clientY };
    if (isDouble) this.tool().double(press);
    else this.tool().click(press);
  }

  private hover(source: PointerEvent): void {
    if (source.pointerType === "touch") return;
    this.inFrame(() => this.tool().move(this.pressOf(source)));
  }

  private inFrame(run: () => void): void {
    cancelAnimationFrame(this.frame);
    this.frame = requestAnimationFrame(run);
  }

  private abort(): void {
    if (!this.down) return;
    clearTimeout(this.down.timer);
    this.down = null;
    this.tool().cancel();
  }

  private pressOf(source: PointerEvent): Press {
    const at = this.siteMap.positionOf(source);
    return this.pressAt(at, source.pointerType === "touch", source);
  }

  /** What a press at a place means; also for the cross that the keyboard moves. */
  pressAt(
    at: Position,
    touch: boolean,
    keys: { shiftKey: boolean; ctrlKey: boolean; metaKey: boolean; altKey: boolean },
  ) {
    const pixels = (touch ? TOUCH : MOUSE).reach;
    const reach = pixels * (this.siteMap.map.getView().getResolution() ?? 1);
    const options = this.editor.options.peek();
    const hits = this.siteMap.index.near(at, reach).filter(({ layer }) => !isHidden(layer));
    return {
      at,
      hits,
      touch,
      reach,
      shift: keys.shiftKey,
      adds: keys.shiftKey || keys.ctrlKey || keys.metaKey || options.several,
      free: keys.altKey || options.free,
    };
  }

  /** Ends with a map that is closed in the middle of a gesture. */
  stop(): void {
    this.abort();
    cancelAnimationFrame(this.frame);
  }
}
