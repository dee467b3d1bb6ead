/** A layer that is painted once onto a canvas somewhat larger than the view, and moved by the compositor while the
 * view moves: panning costs no drawing, however much is on the map. */

import Layer from "ol/layer/Layer";
import type { FrameState } from "ol/Map";
import { compose, create, makeInverse, multiply, type Transform, toString as toCss } from "ol/transform";
import ViewHint from "ol/ViewHint";

/** Share of the view that is painted beyond each of its sides. */
const MARGIN = 0.25;
const MAX_PIXELS = 16e6;
const PAUSE = 120;

/** The view for which a layer is painted: the transform turns local metres into pixels of the canvas. */
export interface PaintedView {
  center: [number, number];
  resolution: number;
  rotation: number;
  /** Size in CSS pixels. */
  width: number;
  height: number;
  /** Pixels of the canvas per CSS pixel. */
  ratio: number;
  transform: Transform;
  /** Box in local metres: min x, min y, max x, max y. */
  extent: [number, number, number, number];
}

export abstract class PaintedLayer extends Layer {
  /** Whether a change is painted in the next frame: for few features that follow the pointer. */
  prompt = false;
  private readonly canvas = document.createElement("canvas");
  private readonly holder = document.createElement("div");
  private painted: PaintedView | null = null;
  private stale = true;
  private paintedAt = 0;
  private timer = 0;

  constructor(options: ConstructorParameters<typeof Layer>[0] = {}) {
    super(options);
    this.holder.className = "painted-layer";
    this.holder.append(this.canvas);
  }

  /** Draws all that is to be seen in a view. */
  protected abstract paint(context: CanvasRenderingContext2D, view: PaintedView): void;

  /** Whether there is nothing to draw: then the layer costs nothing. */
  protected isEmpty(): boolean {
    return false;
  }

  /** Asks for another painting, because the content has changed. */
  repaint(): void {
    this.stale = true;
    this.changed();
  }

  /** Shows only a part of the layer: shares of the map's width from its left side. */
  clip(from: number, to: number): void {
    const isWhole = from <= 0 && to >= 1;
    this.holder.style.clipPath = isWhole ? "" : `inset(0 ${(1 - to) * 100}% 0 ${from * 100}%)`;
  }

  override render(frame: FrameState): HTMLElement {
    this.holder.hidden = this.isEmpty();
    if (this.holder.hidden) {
      this.canvas.width = this.canvas.height = 0;
      this.painted = null;
      return this.holder;
    }
    const { center, resolution, rotation } = frame.viewState;
    const [width = 0, height = 0] = frame.size;
    const isMoving = Boolean(frame.viewHints[ViewHint.ANIMATING] || frame.viewHints[ViewHint.INTERACTING]);
    if (this.needsPainting(frame, isMoving)) {
      const since = performance.now() - this.paintedAt;
      if (since > PAUSE || (this.prompt && this.stale) || !this.painted || (!isMoving && !this.stale))
        this.paintNow(frame);
      else if (!this.timer) {
        this.timer = window.setTimeout(() => {
          this.timer = 0;
          this.changed();
        }, PAUSE - since);
      }
    }
    const view = this.painted;
    if (view) {
      // Screen ← local ← canvas
      const matrix = compose(
        create(),
        width / 2,
        height / 2,
        1 / resolution,
        -1 / resolution,
        -rotation,
        -(center[0] ?? 0),
        -(center[1] ?? 0),
      );
      const onto = compose(
        create(),
        view.width / 2,
        view.height / 2,
        1 / view.resolution,
        -1 / view.resolution,
        -view.rotation,
        -view.center[0],
        -view.center[1],
      );
      multiply(matrix, makeInverse(create(), onto));
      if (view.resolution === resolution && view.rotation === rotation) {
        matrix[4] = Math.round(matrix[4] ?? 0); // whole pixels stay sharp
        matrix[5] = Math.round(matrix[5] ?? 0);
      }
      this.canvas.style.transform = toCss(matrix);
      this.holder.style.opacity = String(this.getOpacity());
    }
    return this.holder;
  }

  private needsPainting(frame: FrameState, isMoving: boolean): boolean {
    const view = this.painted;
    if (!view || this.stale) return true;
    const { resolution, rotation, center } = frame.viewState;
    const [width = 0, height = 0] = frame.size;
    const zoom = view.resolution / resolution;
    const isSharp = zoom === 1 && view.rotation === rotation && view.ratio === ratioFor(frame);
    if (!isMoving && !isSharp) return true;
    const x = Math.abs((center[0] ?? 0) - view.center[0]) / resolution;
    const y = Math.abs((center[1] ?? 0) - view.center[1]) / resolution;
    const slackX = (view.width * zoom - width) / 2;
    const slackY = (view.height * zoom - height) / 2;
    return zoom > 3 || Math.hypot(x, y) > Math.max(0, Math.min(slackX, slackY));
  }

  private paintNow(frame: FrameState): void {
    const { center, resolution, rotation } = frame.viewState;
    const [frameWidth = 0, frameHeight = 0] = frame.size;
    const width = Math.round(frameWidth * (1 + 2 * MARGIN));
    const height = Math.round(frameHeight * (1 + 2 * MARGIN));
    const ratio = ratioFor(frame);
    const [x, y] = [center[0] ?? 0, center[1] ?? 0];
    const transform = compose(
      create(),
      (width * ratio) / 2,
      (height * ratio) / 2,
      ratio / resolution,
      -ratio / resolution,
      -rotation,
      -x,
      -y,
    );
    const [sin, cos] = [Math.abs(Math.sin(rotation)), Math.abs(Math.cos(rotation))];
    const halfX = ((width * cos + height * sin) * resolution) / 2;
    const halfY = ((width * sin + height * cos) * resolution) / 2;
    const view: PaintedView = {
      center: [x, y],
      resolution,
      rotation,
      width,
      height,
      ratio,
      transform,
      extent: [x - halfX, y - halfY, x + halfX, y + halfY],
    };
    const { canvas } = this;
    const [columns, rows] = [Math.round(width * ratio), Math.round(height * ratio)];
    if (canvas.width !== columns || canvas.height !== rows) {
      canvas.width = columns;
      canvas.height = rows;
      canvas.style.width = `${width}px`;
      canvas.style.height = `${height}px`;
    }
    const context = canvas.getContext("2d");
    if (!context) return;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, columns, rows);
    this.stale = false;
    this.paint(context, view);
    this.painted = view;
    this.paintedAt = performance.now();
  }

  protected override disposeInternal(): void {
    clearTimeout(this.timer);
    this.holder.remove();
    super.disposeInternal();
  }
}

function ratioFor(frame: FrameState): number {
  const [width = 1, height = 1] = frame.size;
  const pixels = width * height * (1 + 2 * MARGIN) ** 2;
  return Math.min(frame.pixelRatio, Math.sqrt(MAX_PIXELS / pixels));
}
