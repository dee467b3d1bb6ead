/** Robots on the map: the standing is told by colour and by shape, the heading by a nose. */
import { apply } from "ol/transform";
import type { Position } from "../../map/features";
import { PaintedLayer, type PaintedView } from "../../map/painted";
import { colour } from "../../theme";
import type { Standing } from "./status";

export interface Marker {
  robot: string;
  at: Position;
  /** Radians from the x axis, counter-clockwise; null: not reported. */
  yaw: number | null;
  standing: Standing;
  isSelected: boolean;
}

const SIZE = 8;
const MAX_LABELS = 120;
const FONT = "600 12px system-ui, sans-serif";
const COLOURS: Record<Standing, string> = {
  current: "added",
  behind: "changed",
  failed: "deleted",
  silent: "fence",
};

export class RobotLayer extends PaintedLayer {
  private markers: readonly Marker[] = [];

  setMarkers(markers: readonly Marker[]): void {
    this.markers = markers;
    this.repaint();
  }

  /** The nearest robot within some metres of a point. */
  near(point: Position, reach: number): string | null {
    let best = reach;
    let found: string | null = null;
    for (const { robot, at } of this.markers) {
      const distance = Math.hypot(at[0] - point[0], at[1] - point[1]);
      if (distance > best) continue;
      best = distance;
      found = robot;
    }
    return found;
  }

  protected override paint(context: CanvasRenderingContext2D, view: PaintedView): void {
    const { ratio, extent } = view;
    const [halo, ink] = [colour("halo"), colour("ink")];
    const visible = this.markers.filter(
      ({ at: [x, y] }) => x >= extent[0] && x <= extent[2] && y >= extent[1] && y <= extent[3],
    );
    // Calm ones first: what needs attention is drawn above.
    const order: Standing[] = ["current", "silent", "behind", "failed"];
    visible.sort(
      (a, b) => Number(a.isSelected) - Number(b.isSelected) || order.indexOf(a.standing) - order.indexOf(b.standing),
    );
    const scale = visible.length > MAX_LABELS && view.resolution > 0.02 ? 0.6 : 1;
    for (const marker of visible) {
      const [x = 0, y = 0] = apply(view.transform, [...marker.at]);
      context.setTransform(ratio * scale, 0, 0, ratio * scale, x, y);
      drawMarker(context, marker, view.rotation, colour(COLOURS[marker.standing]), halo);
    }
    context.setTransform(1, 0, 0, 1, 0, 0);
    // Too many names are noise: then only those that an operator looks for are written.
    const named =
      visible.length > MAX_LABELS
        ? visible.filter(({ isSelected, standing }) => isSelected || standing === "failed")
        : visible;
    drawNames(context, view, named.reverse(), halo, ink);
  }
}

function drawMarker(
  context: CanvasRenderingContext2D,
  marker: Marker,
  rotation: number,
  paint: string,
  halo: string,
): void {
  context.lineJoin = "round";
  if (marker.isSelected) {
    context.beginPath();
    context.arc(0, 0, SIZE * 2, 0, 2 * Math.PI);
    context.lineWidth = 3;
    context.strokeStyle = colour("accent");
    context.stroke();
  }
  if (marker.yaw !== null) {
    context.save();
    context.rotate(rotation - marker.yaw); // pixels grow downwards
    context.beginPath();
    context.moveTo(SIZE * 1.9, 0);
    context.lineTo(SIZE * 0.6, SIZE * 0.8);
    context.lineTo(SIZE * 0.6, -SIZE * 0.8);
    context.closePath();
    fill(context, paint, halo);
    context.restore();
  }
  context.beginPath();
  outline(context, marker.standing);
  if (marker.standing === "silent") {
    context.lineWidth = 5;
    context.strokeStyle = halo;
    context.stroke();
    context.fillStyle = halo;
    context.fill();
    context.lineWidth = 2.5;
    context.strokeStyle = paint;
    context.stroke();
  } else fill(context, paint, halo);
  if (marker.standing === "failed") drawCross(context, halo);
}

function outline(context: CanvasRenderingContext2D, standing: Standing): void {
  if (standing === "behind") corners(context, SIZE * 1.15, 4, 0);
  else if (standing === "failed") corners(context, SIZE * 1.2, 4, Math.PI / 4);
  else context.arc(0, 0, SIZE * 0.85, 0, 2 * Math.PI);
}

function corners(context: CanvasRenderingContext2D, size: number, number: number, turn: number): void {
  for (let index = 0; index < number; index++) {
    const angle = turn + (2 * Math.PI * index) / number;
    if (index) context.lineTo(Math.cos(angle) * size, Math.sin(angle) * size);
    else context.moveTo(Math.cos(angle) * size, Math.sin(angle) * size);
  }
  context.closePath();
}

function fill(context: CanvasRenderingContext2D, paint: string, halo: string): void {
  context.lineWidth = 3;
  context.strokeStyle = halo;
  context.stroke();
  context.fillStyle = paint;
  context.fill();
}

function drawCross(context: CanvasRenderingContext2D, halo: string): void {
  const size = SIZE * 0.45;
  context.beginPath();
  context.moveTo(-size, -size);
  context.lineTo(size, size);
  context.moveTo(size, -size);
  context.lineTo(-size, size);
  context.lineWidth = 2;
  context.strokeStyle = halo;
  context.stroke();
}

/** Writes names beside the robots, where they do not cover each other; those that need attention first. */
function drawNames(
  context: CanvasRenderingContext2D,
  view: PaintedView,
  markers: readonly Marker[],
  halo: string,
  ink: string,
): void {
  const { ratio } = view;
  const taken: [number, number, number, number][] = [];
  context.scale(ratio, ratio);
  context.font = FONT;
  context.textBaseline = "middle";
  context.lineJoin = "round";
  context.lineWidth = 3.5;
  context.strokeStyle = halo;
  context.fillStyle = ink;
  for (const { robot, at, isSelected } of markers) {
    if (taken.length >= MAX_LABELS) break;
    const [px = 0, py = 0] = apply(view.transform, [...at]);
    const [x, y] = [px / ratio + SIZE * 2.2, py / ratio];
    const name = robot.length > 40 ? `${robot.slice(0, 39)}…` : robot;
    const box: [number, number, number, number] = [x - 2, y - 9, x + context.measureText(name).width + 2, y + 9];
    const covers = taken.some(
      (other) => box[0] < other[2] && box[2] > other[0] && box[1] < other[3] && box[3] > other[1],
    );
    if (covers && !isSelected) continue;
    taken.push(box);
    context.strokeText(name, x, y);
    context.fillText(name, x, y);
  }
  context.setTransform(1, 0, 0, 1, 0, 0);
}
