/** Tools and their options; these are kept on the device. */
import type { SnapOptions } from "./snap";

export type ToolName = "select" | "path" | "split" | "zone" | "object" | "fence" | "cells" | "brush";

export const TOOLS: ToolName[] = ["select", "path", "split", "zone", "object", "fence", "cells", "brush"];

export interface Options {
  oneWay: boolean;
  /** New lanes take the action, speed and width that the lanes they continue have in common. */
  likeBefore: boolean;
  snap: SnapOptions;
  /** Snapping is released while true. */
  free: boolean;
  /** Each click adds to the selection; a drag in the void draws a box. */
  several: boolean;
  box: boolean;
  zoneKind: string;
  speed: number;
  objectShape: "point" | "area" | "line";
  objectKind: string;
  name: string;
  grid: string;
  cellValue: number;
  brush: number;
}

const SETTINGS = "fleetmap-edit-options";

export function loadOptions(): Options {
  const usual: Options = {
    oneWay: false,
    likeBefore: true,
    snap: { nodes: true, edges: true, angles: true, grid: false, step: 0.5 },
    free: false,
    several: false,
    box: false,
    zoneKind: "keepout",
    speed: 0.5,
    objectShape: "area",
    objectKind: "obstacle",
    name: "",
    grid: "",
    cellValue: 100,
    brush: 0.5,
  };
  try {
    const kept = JSON.parse(localStorage.getItem(SETTINGS) ?? "{}") as Partial<Options>;
    return { ...usual, ...kept, snap: { ...usual.snap, ...kept.snap }, free: false, several: false, box: false };
  } catch {
    return usual;
  }
}

export function keepOptions(options: Options): void {
  localStorage.setItem(SETTINGS, JSON.stringify(options));
}
