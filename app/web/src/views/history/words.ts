/** What versions changed, as people say it. No DOM. */
import type { Version } from "../../api/client";
import { count, whole } from "../../ui/text";

export const LAYER_NAMES: Record<string, string> = {
  topology: "Network",
  objects: "Objects",
  zones: "Zones",
  location: "Fence",
  occupancy: "Grid",
  imagery: "Picture",
  voxels: "Voxels",
  resources: "Files",
};

const VECTOR = ["topology", "objects", "zones", "location"];
const CELLS: [string, string][] = [
  ["blocked", "blocked"],
  ["freed", "freed"],
  ["unknown", "unknown now"],
  ["other", "changed"],
];

type Counts = Record<string, unknown>;

/** Returns the changes of a version, one entry for each layer or grid. */
export function changesInWords(changes: Counts): string[] {
  const out: string[] = [];
  for (const [layer, value] of Object.entries(changes)) {
    if (typeof value !== "object" || value === null) continue;
    if (VECTOR.includes(layer)) push(out, LAYER_NAMES[layer] ?? layer, countsInWords(value as Counts));
    else if (layer === "occupancy") {
      for (const [name, cells] of Object.entries(value)) push(out, name, cellsInWords(cells as Counts));
    } else if (layer in LAYER_NAMES) {
      for (const [name, counts] of Object.entries(value)) {
        push(out, `${LAYER_NAMES[layer]} “${name}”`, countsInWords(counts as Counts) || "changed");
      }
    } else if (layer === "datum") out.push("Position on earth changed");
    else if (layer === "levels") out.push("Levels changed");
    else out.push(`${layer[0]?.toUpperCase()}${layer.slice(1).replaceAll("_", " ")} changed`);
  }
  return out;
}

export function cellsInWords(cells: Counts): string {
  const words = CELLS.filter(([key]) => numberOf(cells[key])).map(
    ([key, word]) => `${count(numberOf(cells[key]), "cell")} ${word}`,
  );
  return words.join(", ");
}

/** Counts may be numbers, or the ids themselves (of a comparison). */
export function countsInWords(counts: Counts): string {
  const words = ["added", "changed", "deleted"]
    .filter((key) => numberOf(counts[key]))
    .map((key) => `${whole(numberOf(counts[key]))} ${key}`);
  if (words.length === 0 && counts.document) words.push("document changed");
  return words.join(", ");
}

function numberOf(value: unknown): number {
  return Array.isArray(value) ? value.length : typeof value === "number" ? value : 0;
}

function push(out: string[], title: string, words: string): void {
  if (words) out.push(`${title}: ${words}`);
}

/** How changed layers came about, if this version brought layers that are not from files or drawn by hand. */
export function marksOf(version: Version, parent: Version | undefined): string[] {
  const marks = new Set<string>();
  for (const layer of Object.keys(version.changes)) {
    const information = version.information[layer];
    if (information !== "derived" && information !== "generated") continue;
    if (parent && parent.information[layer] !== information) marks.add(information);
  }
  return [...marks].sort();
}

/** Name of a reference to a version, as people read it. */
export function refName(ref: string): string {
  return /^\d+$/.test(ref) ? `v${ref}` : ref.startsWith("dry:") ? "dry run" : ref.startsWith("draft:") ? "draft" : ref;
}
