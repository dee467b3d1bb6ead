/** Kinds of zones, and how they are drawn: on the map and in its legend. */
import { colour } from "../theme";
import type { Paint } from "./feature-layer";
import type { Feature } from "./features";

/** Names of places, which limit nothing: drawn quietly, with their names. */
const AREA_KINDS = new Set(["room", "corridor", "door", "aisle", "row"]);

export type ZoneClass = "area" | "door" | "keepout" | "speed";

export function zoneKind({ properties }: Pick<Feature, "properties">): string {
  return String(properties.kind ?? "");
}

export function zoneClass(feature: Pick<Feature, "properties">): ZoneClass {
  const kind = zoneKind(feature);
  if (kind === "door") return "door";
  if (AREA_KINDS.has(kind)) return "area";
  return kind.includes("speed") ? "speed" : "keepout";
}

export function zonePaints(hasNames: boolean): Record<ZoneClass, Paint> {
  const area = { stroke: colour("object"), fill: tint("object", 8), width: 1, labels: hasNames };
  return {
    area,
    door: { ...area, fill: tint("object", 45) },
    speed: { stroke: colour("speed"), fill: tint("speed", 18), width: 1.5, dash: [6, 4] },
    keepout: { stroke: colour("keepout"), fill: tint("keepout", 20), width: 1.5 },
  };
}

function tint(name: string, percent: number): string {
  return `color-mix(in srgb, ${colour(name)} ${percent}%, transparent)`;
}
