/** A raster of the map, drawn from tiles in its own pixel frame: turned rasters stay exact. */
import { apply, create, makeInverse, multiply, type Transform } from "ol/transform";
import { PaintedLayer, type PaintedView } from "./painted";
import type { Tiles } from "./tiles";

export class RasterLayer extends PaintedLayer {
  constructor(
    readonly tiles: Tiles,
    zIndex: number,
  ) {
    super({ zIndex });
    tiles.onTile = () => this.repaint();
  }

  protected override paint(context: CanvasRenderingContext2D, view: PaintedView): void {
    const { set } = this.tiles;
    const [a, b, c, d, e, f] = set.transform;
    const toLocal: Transform = [a, d, b, e, c, f];
    const cell = Math.hypot(a, d);
    const top = set.levels - 1;
    const z = Math.max(0, Math.min(top, top - Math.floor(Math.log2(view.resolution / view.ratio / cell) + 0.25)));
    const scale = 2 ** (top - z);
    const width = Math.ceil(set.width / scale);
    const height = Math.ceil(set.height / scale);
    const box = pixelBox(view, toLocal).map((value) => value / scale) as [number, number, number, number];
    const columns = range(box[0], box[2], width, set.tile);
    const rows = range(box[1], box[3], height, set.tile);
    if (columns.length === 0 || rows.length === 0) return;
    const [left, upper] = [(columns[0] ?? 0) * set.tile, (rows[0] ?? 0) * set.tile];
    const right = Math.min(width, ((columns.at(-1) ?? 0) + 1) * set.tile);
    const lower = Math.min(height, ((rows.at(-1) ?? 0) + 1) * set.tile);
    const sheet = new OffscreenCanvas(right - left, lower - upper);
    const pen = sheet.getContext("2d");
    if (!pen) return;
    const wanted = new Set<string>();
    for (const row of rows) {
      for (const column of columns) {
        wanted.add(`${z}/${row}/${column}`);
        const bitmap = this.tiles.get(z, row, column);
        const [x, y] = [column * set.tile - left, row * set.tile - upper];
        if (bitmap) pen.drawImage(bitmap, x, y);
        else this.drawCoarser(pen, z, row, column, x, y);
      }
    }
    this.tiles.cancelExcept(wanted);
    const matrix = multiply(create(), view.transform);
    multiply(matrix, toLocal);
    multiply(matrix, [scale, 0, 0, scale, left * scale, upper * scale]);
    context.setTransform(...(matrix as [number, number, number, number, number, number]));
    // Cells are seen as cells when close; far off, smoothing hides the steps between the overviews.
    context.imageSmoothingEnabled = view.resolution / view.ratio > (cell * scale) / 2;
    context.drawImage(sheet, 0, 0);
    context.setTransform(1, 0, 0, 1, 0, 0);
  }

  /** Fills the place of a missing tile from an overview that is there. */
  private drawCoarser(
    pen: OffscreenCanvasRenderingContext2D,
    z: number,
    row: number,
    column: number,
    x: number,
    y: number,
  ) {
    const { tile } = this.tiles.set;
    for (let up = 1; up <= z; up++) {
      const part = tile / 2 ** up;
      const bitmap = this.tiles.peek(z - up, row >> up, column >> up);
      if (!bitmap || part < 1) continue;
      const mask = 2 ** up - 1;
      pen.drawImage(bitmap, (column & mask) * part, (row & mask) * part, part, part, x, y, tile, tile);
      return;
    }
  }
}

/** Returns the box of the view in pixels of the raster: min column, min row, max column, max row. */
function pixelBox(view: PaintedView, toLocal: Transform): [number, number, number, number] {
  const inverse = makeInverse(create(), multiply(multiply(create(), view.transform), toLocal));
  const [w, h] = [view.width * view.ratio, view.height * view.ratio];
  const corners = [
    [0, 0],
    [w, 0],
    [0, h],
    [w, h],
  ].map((corner) => apply(inverse, corner));
  const xs = corners.map((corner) => corner[0] ?? 0);
  const ys = corners.map((corner) => corner[1] ?? 0);
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
}

function range(low: number, high: number, size: number, tile: number): number[] {
  const first = Math.max(0, Math.floor(low / tile));
  const last = Math.min(Math.ceil(size / tile) - 1, Math.floor(high / tile));
  return Array.from({ length: Math.max(0, last - first + 1) }, (_, index) => first + index);
}
