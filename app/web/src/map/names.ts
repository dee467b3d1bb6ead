/** Names of features, written where they do not cover each other. */
import { apply } from "ol/transform";
import type { FeatureLayer } from "./feature-layer";
import { type Box, boxOf, type Feature, nameOf } from "./features";
import { PaintedLayer, type PaintedView } from "./painted";

const MAX_NAMES = 250;
const FONT = "500 12px system-ui, sans-serif";

/** Writes the names of several layers above all of them: no node covers the name of its row. */
export class NamesLayer extends PaintedLayer {
  /** layers: those whose names are more important come first. */
  constructor(
    private readonly layers: readonly FeatureLayer[],
    zIndex: number,
  ) {
    super({ zIndex });
    for (const layer of layers) {
      layer.isNamedAbove = true;
      layer.on(["change", "change:opacity", "change:visible"], () => this.repaint());
    }
  }

  protected override paint(context: CanvasRenderingContext2D, view: PaintedView): void {
    const taken: Box[] = [];
    for (const layer of this.layers) {
      if (!layer.getVisible()) continue;
      context.globalAlpha = layer.getOpacity();
      writeNames(context, view, layer.named(view), taken);
    }
    context.globalAlpha = 1;
  }
}

/** Writes names beside their features. taken: boxes, in CSS pixels, that have one already; new ones are added. */
export function writeNames(
  context: CanvasRenderingContext2D,
  view: PaintedView,
  features: readonly Feature[],
  taken: Box[] = [],
): void {
  if (features.length > MAX_NAMES * 4) return;
  const { ratio } = view;
  context.scale(ratio, ratio);
  context.font = FONT;
  context.textBaseline = "middle";
  context.lineWidth = 3;
  const colours = getComputedStyle(document.documentElement);
  context.strokeStyle = colours.getPropertyValue("--map-halo") || "#fff";
  context.fillStyle = colours.getPropertyValue("--map-ink") || "#000";
  const end = taken.length + MAX_NAMES;
  for (const feature of features) {
    if (taken.length >= end) break;
    const box = boxOf(feature.geometry);
    const [px = 0, py = 0] = apply(view.transform, [(box[0] + box[2]) / 2, (box[1] + box[3]) / 2]);
    const name = nameOf(feature).slice(0, 40);
    const [x, y] = [px / ratio + 7, py / ratio];
    const place: Box = [x - 2, y - 8, x + context.measureText(name).width + 2, y + 8];
    if (taken.some((other) => overlap(place, other))) continue;
    taken.push(place);
    context.strokeText(name, x, y);
    context.fillText(name, x, y);
  }
  context.setTransform(1, 0, 0, 1, 0, 0);
}

function overlap(a: Box, b: Box): boolean {
  return a[0] < b[2] && a[2] > b[0] && a[1] < b[3] && a[3] > b[1];
}
