/** Right clicks and long presses. Safari makes no menu event of a long press, so that one is timed here. */

const LONG_PRESS = 550;
const SLACK_PIXELS = 10;

export class MenuPress {
  /** Whether the press that is under way, or was last, has opened a menu: the click at its end means nothing. */
  isOpened = false;
  private timer = 0;
  private readonly stops: (() => void)[] = [];

  constructor(
    element: HTMLElement,
    private readonly open: (event: MouseEvent) => void,
  ) {
    let start: PointerEvent | null = null;
    this.listen(element, "pointerdown", (event) => {
      clearTimeout(this.timer);
      this.isOpened = false;
      start = event.isPrimary && event.pointerType === "touch" ? event : null;
      if (start) this.timer = window.setTimeout(() => this.openOnce(event), LONG_PRESS);
    });
    this.listen(element, "pointermove", (event) => {
      if (start && Math.hypot(event.clientX - start.clientX, event.clientY - start.clientY) > SLACK_PIXELS)
        clearTimeout(this.timer);
    });
    for (const name of ["pointerup", "pointercancel"] as const)
      this.listen(element, name, () => clearTimeout(this.timer));
    this.listen(element, "contextmenu", (event) => this.openOnce(event));
  }

  close(): void {
    clearTimeout(this.timer);
    for (const stop of this.stops) stop();
  }

  private openOnce(event: MouseEvent): void {
    clearTimeout(this.timer);
    if (this.isOpened) event.preventDefault();
    else this.open(event);
    this.isOpened = true;
  }

  private listen<Name extends keyof HTMLElementEventMap>(
    element: HTMLElement,
    name: Name,
    handler: (event: HTMLElementEventMap[Name]) => void,
  ): void {
    element.addEventListener(name, handler);
    this.stops.push(() => element.removeEventListener(name, handler));
  }
}
