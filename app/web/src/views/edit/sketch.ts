/** What is drawn over the map while editing: the selection, what moves, the snapped place, cells. */
import { effect, signal } from "@preact/signals";
import type { FeatureLayer, FeatureStyle } from "../../map/feature-layer";
import type { Feature, Geometry, Position } from "../../map/features";
import type { SiteMap } from "../../map/site-map";
import { colour, theme } from "../../theme";
import { type CellEdit, isEdge, isNode } from "./draft";
import type { Editor } from "./editor";
import { outlinesOf } from "./geometry";
import type { Snapped } from "./snap";

export type Mark =
  "line" | "area" | "corner" | "node" | "edge" | "place" | "snap" | "cross" | "free" | "occupied" | "unknown";

export function mark(kind: Mark, geometry: Geometry, id = ""): Feature {
  return { id: `${kind}${id}`, layer: "drawn", level: "", part: "", geometry, properties: { mark: kind } };
}

export function point(kind: Mark, at: readonly number[]): Feature {
  return mark(kind, { type: "Point", coordinates: [...at] });
}

/** Shows where a click would be, and what attracts it. */
export function marksOf({ at, kind }: Snapped): Feature[] {
  return [point(kind === "free" || kind === "grid" ? "place" : "snap", at)];
}

export function cellKind(value: number): Mark {
  return value === 255 ? "unknown" : value >= 50 ? "occupied" : "free";
}

const PAINTS: FeatureStyle = {
  classOf: (feature) => String(feature.properties.mark ?? ""),
  paints: () => {
    const accent = colour("accent");
    const soft = `color-mix(in srgb, ${accent} 22%, transparent)`;
    return {
      occupied: { fill: colour("ink"), stroke: accent, width: 1 },
      free: { fill: colour("ground"), stroke: accent, width: 1 },
      unknown: { fill: "rgb(128 128 128 / 60%)", stroke: accent, width: 1, dash: [3, 3] },
      area: { stroke: accent, fill: soft, width: 2 },
      edge: { stroke: accent, width: 3 },
      line: { stroke: accent, width: 2, dash: [6, 5] },
      node: { dot: 9, dotColour: accent },
      middle: { dot: 6, dotColour: colour("halo"), sign: "ring", stroke: accent },
      corner: { dot: 9, dotColour: accent },
      place: { dot: 7, dotColour: accent },
      snap: { sign: "ring", stroke: accent },
      cross: { sign: "plus", stroke: accent },
    };
  },
};

const SELECTION: FeatureStyle = {
  classOf: (feature) => String(feature.properties.mark ?? "selected"),
  paints: () => {
    const accent = colour("accent");
    return {
      outline: { stroke: accent, width: 4 },
      selected: { stroke: accent, width: 4, dot: 13, fill: `color-mix(in srgb, ${accent} 12%, transparent)` },
      line: { stroke: accent, width: 4, arrows: true },
      corner: { dot: 10, dotColour: accent },
      middle: { dot: 6, dotColour: accent },
      node: { dot: 16, dotColour: accent },
    };
  },
};

export class Sketch {
  /** What the tool draws now. */
  readonly marks = signal<readonly Feature[]>([]);
  private readonly layers: FeatureLayer[];
  private readonly stops: (() => void)[] = [];

  constructor(
    private readonly editor: Editor,
    private readonly map: SiteMap,
  ) {
    const cells = map.addLayer(PAINTS, 4);
    const selection = map.addLayer(SELECTION, 25);
    const sketch = map.addLayer(PAINTS, 30, { prompt: true });
    selection.prompt = true;
    this.layers = [cells, selection, sketch];
    this.stops.push(
      effect(() => cells.setFeatures(cellMarks(this.editor.cells.value, this.map.site.level.value))),
      effect(() => selection.setFeatures(this.hidden.value ? [] : this.selectionMarks())),
      effect(() => sketch.setFeatures(this.marks.value)),
      effect(() => {
        theme.value;
        requestAnimationFrame(() => {
          for (const layer of this.layers) layer.repaint();
        });
      }),
    );
  }

  /** Whether the selection is drawn by the tool, because it moves. */
  readonly hidden = signal(false);

  close(): void {
    for (const stop of this.stops) stop();
    for (const layer of this.layers) this.map.removeLayer(layer);
  }

  private selectionMarks(): Feature[] {
    const features = this.editor.selected.value;
    const vertex = this.editor.vertex.value;
    const isDirected = (feature: Feature) => isEdge(feature) && !this.editor.draft.twinOf(feature);
    const out: Feature[] = features.map((feature) => {
      const look = isDirected(feature) ? "line" : feature.layer === "location" ? "outline" : "selected";
      return { ...feature, properties: { ...feature.properties, mark: look } };
    });
    for (const [index, { at, middle }] of handlesOf(features).entries()) {
      out.push({ ...point("corner", at), id: `handle${index}`, properties: { mark: middle ? "middle" : "corner" } });
    }
    const chosen = vertex && features[0] && outlinesOf(features[0].geometry)[vertex.outline]?.points[vertex.index];
    if (chosen) out.push(point("node", chosen));
    return out;
  }
}

export interface Handle {
  at: Position;
  outline: number;
  /** Index of the vertex, or of the one that a middle is put before. */
  index: number;
  middle: boolean;
}

const MAX_HANDLES = 400;

/** Returns the vertices of the one selected feature that can be dragged, and the middles between them. */
export function handlesOf(features: readonly Feature[]): Handle[] {
  const shapes = features.filter((feature) => !isNode(feature));
  const first = shapes[0];
  const isStreet = shapes.length === 2 && isEdge(first);
  if (!first || features.length !== shapes.length || (shapes.length !== 1 && !isStreet)) return [];
  const out: Handle[] = [];
  for (const [outline, { points, closed }] of outlinesOf(first.geometry).entries()) {
    if (points.length > MAX_HANDLES) continue;
    points.forEach((at, index) => {
      const isEnd = !closed && (index === 0 || index === points.length - 1);
      if (!(isEdge(first) && isEnd)) out.push({ at: at as Position, outline, index, middle: false });
      const next = points[index + 1] ?? (closed ? points[0] : undefined);
      if (!next) return;
      const middle: Position = [((at[0] ?? 0) + (next[0] ?? 0)) / 2, ((at[1] ?? 0) + (next[1] ?? 0)) / 2];
      out.push({ at: middle, outline, index: index + 1, middle: true });
    });
  }
  return out;
}

function cellMarks(cells: readonly CellEdit[], level: string): Feature[] {
  return cells
    .filter((one) => one.level === level)
    .flatMap(({ polygons, value, id }) =>
      polygons.map((coordinates, index) => mark(cellKind(value), { type: "Polygon", coordinates }, `${id}-${index}`)),
    );
}
